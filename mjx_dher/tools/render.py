"""Episodes as pictures: a policy played in its environment, drawn by MuJoCo without a screen, written as a video or as stills.

The modules that draw are slow to import, so the functions import them; `choose_gl` must come before MuJoCo does.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.host import files

FPS = 25  # an action lasts 40 ms: pictures in real time
HOLD = 10  # frames that the end of an episode stays, so that the eye can compare object and goal
STILLS = 5  # pictures side by side in a .png
SIZES = range(64, 2049, 2)  # even, as H.264 takes nothing else
GL = ("egl", "osmesa", "glfw")  # ways to draw on Linux, as MUJOCO_GL names them, in the order in which they are tried
GL_SECONDS = 60.0  # that trying one may take
GOAL_RADIUS = 0.03  # m, so that it shows through an object that has reached it
GOAL_RGBA = (1.0, 0.1, 0.1, 0.6)

# How ffmpeg writes each format. GIF: one palette for all frames and no dithering, so that what rests costs nothing.
FORMATS = {
    ".mp4": ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"],
    ".gif": [
        "-filter_complex",
        "split[a][b];[a]palettegen=stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle",
    ],
    ".png": ["-frames:v", "1"],
}


def check(out: Path, width: int, height: int, overwrite: bool) -> None:
    """Refuses what cannot be written, before anything slow has happened.

    Raises:
      ValueError: names each argument at fault and what is allowed.
    """
    problems = []
    try:
        files.check_file(out, FORMATS, overwrite)
    except ValueError as error:
        problems.append(str(error))
    for field, value in (("width", width), ("height", height)):
        if value not in SIZES:
            problems.append(f"{field} must be an even integer from {SIZES[0]} to {SIZES[-1]}; got {value}")
    if problems:
        raise ValueError("\n".join(problems))


def ffmpeg() -> str:
    """The program that writes pictures.

    Raises:
      ValueError: it is not installed.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise ValueError(f'writing pictures needs the extra "video": pip install -e ".[video]" ({error})') from error


def choose_gl() -> str:
    """Makes MuJoCo draw with what works here without a screen, by setting MUJOCO_GL; returns its name.

    A MUJOCO_GL that the user has set is taken, if it works.

    Raises:
      ValueError: none works, or MuJoCo was imported before anything was chosen.
    """
    asked = os.environ.get("MUJOCO_GL")
    if not asked and "mujoco" in sys.modules:
        raise ValueError("MuJoCo has been imported already: set MUJOCO_GL (egl or osmesa) before the program starts")
    if not asked and sys.platform != "linux":
        return "system"  # macOS and Windows have one way to draw, and it needs no screen
    tried = []
    for name in [asked] if asked else GL:
        why_not = try_gl(name)
        if why_not is None:
            os.environ["MUJOCO_GL"] = name
            return name
        tried.append(f"{name} ({why_not})")
    raise ValueError(
        f"MuJoCo cannot draw here; tried MUJOCO_GL={', '.join(tried)}. Install EGL or OSMesa"
        " (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri, or libosmesa6)"
    )


def try_gl(name: str, seconds: float = GL_SECONDS) -> str | None:
    """Why MuJoCo cannot draw here with MUJOCO_GL=`name`, in one line; None where it can.

    Tried in a process of its own, because MuJoCo decides once, at its import, and a failed attempt may crash.
    """
    probe = "import mujoco as m\nwith m.Renderer(m.MjModel.from_xml_string('<mujoco/>'), 16, 16) as r: r.render()"
    environment = {**os.environ, "MUJOCO_GL": name, "MESA_SHADER_CACHE_DISABLE": "true"}  # nothing is worth keeping
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", probe], env=environment, capture_output=True, text=True, check=False, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return f"did not end within {seconds:g} s"
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["crashed"])[-1]


def check_drawable(env: Any) -> None:
    """Raises ValueError unless `env` has what `play` and `draw` need."""
    import jax

    start = jax.eval_shape(env.reset, jax.random.key(0))
    places = hasattr(getattr(start, "physics", None), "qpos") and start.obs["desired_goal"].shape == (3,)
    if not (hasattr(env, "model") and places):
        name = getattr(env, "name", type(env).__name__)
        raise ValueError(
            f"{name} cannot be rendered: it needs a MuJoCo model (attribute `model`), states with `physics.qpos` and goals of"
            " size 3"
        )


def play(env: Any, act: Callable[[Any, Any], Any], seed: int, num_episodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whole episodes side by side, as what is needed to draw them.

    Args:
      env: an environment with a MuJoCo `model`, whose states have `physics.qpos`, and whose goals are places.
      act: (observations leading with [N], key) -> actions [N, A].
      seed: of starts, goals and the keys of `act`.
      num_episodes: N.

    Returns:
      qpos [N, T+1, nq] in the layout of the model, desired goals [N, 3] in m, success at the end [N].

    Raises:
      ValueError: the environment cannot be drawn.
    """
    import jax
    import jax.numpy as jnp

    check_drawable(env)

    def step(state, key):
        following = jax.vmap(env.step)(state, act(state.obs, key))
        return following, following.physics.qpos

    @jax.jit
    def run(key):
        reset_key, act_key = jax.random.split(key)
        first = jax.vmap(env.reset)(jax.random.split(reset_key, num_episodes))
        last, qpos = jax.lax.scan(step, first, jax.random.split(act_key, env.episode_length))
        return jnp.concatenate([first.physics.qpos[None], qpos]), first.obs["desired_goal"], last.success

    qpos, goals, success = jax.device_get(run(jax.random.key(seed)))
    return np.moveaxis(qpos, 0, 1), goals, success


def film(model: Any, qpos: np.ndarray, goals: np.ndarray, width: int, height: int) -> Iterator[np.ndarray]:
    """The frames [height, width, 3] uint8 of all episodes, N * (T + 1 + HOLD). Arguments as in `stills`."""
    for episode, goal in zip(qpos, goals):
        for frame in draw(model, episode, goal, width, height):
            yield frame
        for _ in range(HOLD):
            yield frame


def stills(model: Any, qpos: np.ndarray, goals: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pictures of the first episode, its start to its end, side by side: [height, STILLS * width, 3] uint8.

    Args:
      model: the environment's `mujoco.MjModel`.
      qpos: [N, T+1, nq].
      goals: [N, 3] m.
      width, height: of one picture, pixels.
    """
    # Closer together at first, when a trained policy does most of what it does.
    chosen = (np.linspace(0, 1, STILLS) ** 2 * (qpos.shape[1] - 1)).round().astype(int)
    return np.concatenate(list(draw(model, qpos[0, chosen], goals[0], width, height)), axis=1)


def draw(model: Any, qpos: Iterable[np.ndarray], goal: np.ndarray, width: int, height: int) -> Generator[np.ndarray]:
    """A picture [height, width, 3] uint8 of each configuration, with the goal as a red ball.

    Args:
      model: the environment's `mujoco.MjModel`, with a camera "front".
      qpos: [nq] each.
      goal: [3] m.
      width, height: pixels.
    """
    import mujoco

    model = copy.copy(model)  # its buffer's size is set below; the environment keeps its own
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, height, width) as renderer:
        for configuration in qpos:
            data.qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera="front")
            scene = renderer.scene
            ball = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(
                ball,
                mujoco.mjtGeom.mjGEOM_SPHERE,
                np.array([GOAL_RADIUS, 0, 0]),
                np.asarray(goal, float),
                np.eye(3).ravel(),
                np.array(GOAL_RGBA, np.float32),
            )
            ball.transparent, ball.emission = True, 0.5
            scene.ngeom += 1
            yield renderer.render()


def write(out: Path, frames: Iterable[np.ndarray]) -> None:
    """Writes `frames`, [height, width, 3] uint8 each, in the format that `out` ends in.

    What was there stays whole until the new file is.

    Raises:
      ValueError: it cannot be written.
    """
    partial = out.with_name(f".{out.stem}.partial{out.suffix}")
    frames = iter(frames)
    first = next(frames)
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.shape[1]}x{first.shape[0]}", "-r", str(FPS), "-i", "-"]
    command = [ffmpeg(), "-v", "error", *source, *FORMATS[out.suffix.lower()], "-y", str(partial)]
    try:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdin is not None
            try:
                with contextlib.suppress(BrokenPipeError):  # it gave up, and says why
                    for frame in itertools.chain([first], frames):
                        process.stdin.write(np.ascontiguousarray(frame).data)
                _, complaint = process.communicate()
            finally:
                process.kill()  # still there only if a frame could not be drawn
        if process.returncode != 0:
            raise ValueError(f"out: cannot write {out} ({complaint.decode(errors='replace').strip()})")
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
