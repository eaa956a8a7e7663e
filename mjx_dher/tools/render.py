"""Rendering of episodes without a screen, as a video or as stills.

Functions import the modules that draw, because these are slow to import.
"""

import contextlib
import copy
import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher import lookup
from mjx_dher.system import files, outputs, private_api, signals, subprocesses
from mjx_dher.validation import check_all

MOST_FPS = 50  # largest frame rate of a file, the limit of GIF
HOLD_SECONDS = 0.4  # display time of an episode's last frame, to compare object and goal
STILLS = 5  # pictures side by side in a .png
SIZES = range(64, 2049, 2)  # allowed widths and heights, pixels; H.264 requires even ones
GL = ("egl", "osmesa", "glfw")  # values of MUJOCO_GL on Linux, in the order in which they are tried
GL_SECONDS = 60.0  # time limit of a test
_DRAWN: set[str] = set()  # backends that have drawn in a child process
GOAL_RADIUS = 0.03  # m; visible around an object at the goal
GOAL_RGBA = (1.0, 0.1, 0.1, 0.6)
GHOST_OPACITY = 0.85

# Options of ffmpeg by format. GIF uses one palette and no dithering, so that constant pixels cost nothing.
_PALETTE = "split[a][b];[a]palettegen=stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
FORMATS = {
    ".mp4": ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"],
    ".gif": ["-filter_complex", _PALETTE, "-f", "gif"],
    ".png": ["-frames:v", "1", "-c:v", "png", "-f", "image2pipe"],
}


def check_output(out: Path, width: int, height: int, overwrite: bool) -> None:
    """Raises ValueError early for invalid arguments."""
    sizes = [(_check_size, "width", width), (_check_size, "height", height)]
    check_all((outputs.check_file, out, FORMATS, overwrite), *sizes)


def _check_size(field: str, value: int) -> None:
    if value not in SIZES:
        raise ValueError(f"{field} must be an even integer from {SIZES[0]} to {SIZES[-1]}; got {value}")


def ffmpeg() -> str:
    """Path of ffmpeg, which writes the pictures. Raises ValueError if it is not installed."""
    lookup.require_extra("writing pictures", "imageio_ffmpeg", "video")
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        return get_ffmpeg_exe()
    except RuntimeError as error:
        raise ValueError(f"writing pictures needs ffmpeg: {error}") from error


def choose_gl() -> str:
    """Sets MUJOCO_GL to the first backend that can draw without a screen here, and returns its name.

    If the user has set MUJOCO_GL, only that one is tested. Each is tested once per process. Raises ValueError if none works.
    """
    requested = os.environ.get("MUJOCO_GL")
    if not requested and sys.platform != "linux":
        return "system"  # macOS and Windows have one backend, and it needs no screen
    failed = []
    for name in [requested] if requested else GL:
        failure = None if name in _DRAWN else try_gl(name)
        if failure is None:
            _DRAWN.add(name)
            os.environ["MUJOCO_GL"] = name
            return name
        failed.append(f"{name} ({failure})")
    raise ValueError(
        f"MuJoCo cannot draw here; tried MUJOCO_GL={', '.join(failed)}. Install EGL or OSMesa"
        " (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri, or libosmesa6)"
    )


def try_gl(name: str, seconds: float = GL_SECONDS) -> str | None:
    """Reason in one line why MuJoCo cannot draw with MUJOCO_GL=`name`, or None if it can.

    A child process tests it, because MuJoCo chooses a backend only when imported, and a failed attempt may crash.
    """
    probe = "import mujoco as m\nwith m.Renderer(m.MjModel.from_xml_string('<mujoco/>'), 16, 16) as r: r.render()"
    variables = {"MUJOCO_GL": name, "MESA_SHADER_CACHE_DISABLE": "true"}  # no cache is needed
    return subprocesses.ask([sys.executable, "-P", "-c", probe], variables, seconds).failure


def check_drawable(env: Any) -> None:
    """Raises ValueError unless `env` has the attributes that `record_episodes` and `draw_frames` need."""
    import jax

    start = jax.eval_shape(env.reset, jax.random.key(0))
    if not (hasattr(env, "model") and hasattr(getattr(start, "physics", None), "qpos")):
        name = getattr(env, "name", type(env).__name__)
        raise ValueError(
            f"{name} cannot be rendered: it needs a MuJoCo model (attribute `model`) and states with `physics.qpos`"
        )


def goal_marks(env: Any, qpos: np.ndarray, goal: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Marks of a goal [G]: the environment's `goal_marks`, else a ball at a goal of size 3, else none.

    A mark is a body, or -1 for a ball, its position [3] in m, and its orientation [4] (w, x, y, z).
    """
    if hasattr(env, "goal_marks"):
        return env.goal_marks(qpos, goal)
    return [(-1, np.asarray(goal), np.array([1.0, 0.0, 0.0, 0.0]))] if np.shape(goal) == (3,) else []


def geom_rgba(model: Any, geom: int) -> np.ndarray:
    """Colour [4] of a geom: its material's if it has none."""
    rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    return model.mat_rgba[material] if material >= 0 and np.array_equal(rgba, (0.5, 0.5, 0.5, 1.0)) else rgba


def ghost_rgba(own: np.ndarray) -> np.ndarray:
    """Colour [4] of a geom as a goal: its own, and translucent, so that the sides of an object differ."""
    return np.array([*own[:3], GHOST_OPACITY])


def record_episodes(
    env: Any, act: Callable[[Any, Any], Any], seed: int, num_episodes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plays whole episodes in a batch and returns the data to draw them.

    Args:
      env: an environment with a MuJoCo `model` and states with `physics.qpos`.
      act: (observations [N, ...], key) -> actions [N, A].
      seed: seed of starts, goals and the keys of `act`.

    Returns:
      qpos [N, T+1, nq] in the layout of the model, desired goals [N, G], and success at the end [N].

    Raises:
      ValueError: the environment cannot be drawn.
    """
    import jax

    from mjx_dher.rollout import record_rollout

    check_drawable(env)

    @jax.jit
    def run(key: Any) -> tuple[Any, Any, Any]:
        reset_key, act_key = jax.random.split(key)
        keys = jax.random.split(act_key, env.episode_length)
        policy = lambda own_key, obs: act(obs, own_key)  # noqa: E731
        played = record_rollout(env, policy, reset_key, num_episodes, lambda state: state.physics.qpos, keys)
        return played[2], played[0].desired_goal, played[1].success

    return jax.device_get(run(jax.random.key(seed)))


def film(env: Any, qpos: np.ndarray, goals: np.ndarray, width: int, height: int, fps: float) -> Iterator[np.ndarray]:
    """Yields frames [height, width, 3] uint8 of all episodes, each last one for `HOLD_SECONDS`. Arguments as in `stills`."""
    for episode, goal in zip(qpos, goals):
        for frame in draw_frames(env, episode, goal, width, height):
            yield frame
        for _ in range(round(HOLD_SECONDS * fps)):
            yield frame


def stills(env: Any, qpos: np.ndarray, goals: np.ndarray, width: int, height: int) -> np.ndarray:
    """Draws pictures of the first episode side by side, from start to end: [height, STILLS * width, 3] uint8. Configurations
    are [N, T+1, nq] and goals [N, G]. Each picture has this width and height, in pixels.
    """
    # Closer together at the start, where a trained policy moves most.
    chosen = (np.linspace(0, 1, STILLS) ** 2 * (qpos.shape[1] - 1)).round().astype(int)
    return np.concatenate(list(draw_frames(env, qpos[0, chosen], goals[0], width, height)), axis=1)


def draw_frames(env: Any, qpos: Iterable[np.ndarray], goal: np.ndarray, width: int, height: int) -> Iterator[np.ndarray]:
    """Yields a picture [height, width, 3] uint8 of each configuration [nq]. Arguments as in `Painter`."""
    with contextlib.closing(Painter(env, width, height)) as painter:
        for configuration in qpos:
            yield painter.draw(configuration, goal)


class Painter:
    """Draws configurations of a model. Close it before the program ends.

    Args:
      env: an environment with a `mujoco.MjModel` as `model`. Its camera "front" is used if it exists, else a free camera.
      width, height: size of a picture in pixels.

    Raises:
      ValueError: MuJoCo cannot draw in this process.
    """

    def __init__(self, env: Any, width: int, height: int):
        import mujoco

        model = copy.copy(env.model)  # the environment's buffer size must not change
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._env, self._model, self._data = env, model, mujoco.MjData(model)
        backend = choose_gl()
        try:
            with private_api.drawing_with(backend):
                self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # from any drawing library
            raise ValueError(f"MuJoCo cannot draw in this process with MUJOCO_GL={backend}: {error}") from error

    def draw(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Picture [height, width, 3] uint8 of a configuration [nq], with the goal [G] as a red ball or a translucent body."""
        import mujoco

        self._data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._model, self._data)  # with cameras, tendons and flexes
        front = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, "front")  # -1, a free camera, if there is none
        self._renderer.update_scene(self._data, camera=front)
        for body, pos, quat in goal_marks(self._env, np.asarray(qpos), np.asarray(goal)):
            if body < 0:
                self._add_geom(mujoco.mjtGeom.mjGEOM_SPHERE, np.array([GOAL_RADIUS, 0, 0]), pos, quat, GOAL_RGBA)
                continue
            first = self._model.body_geomadr[body]
            for geom in range(first, first + self._model.body_geomnum[body]):
                own = geom_rgba(self._model, geom)
                if own[3] == 0 or self._model.geom_group[geom] > 2:  # not drawn in the body either
                    continue
                place, turn = np.zeros(3), np.zeros(4)
                frame = self._model.geom_pos[geom], self._model.geom_quat[geom]
                mujoco.mju_mulPose(place, turn, np.asarray(pos, float), np.asarray(quat, float), *frame)
                mesh = 2 * int(self._model.geom_dataid[geom])  # the mesh itself; the odd number after it is its convex hull
                look = self._model.geom_type[geom], self._model.geom_size[geom]
                self._add_geom(*look, place, turn, ghost_rgba(own), mesh)
        return self._renderer.render()

    def _add_geom(self, kind: Any, size: np.ndarray, pos: np.ndarray, quat: np.ndarray, rgba: Any, mesh: int = -1) -> None:
        import mujoco

        scene, mat = self._renderer.scene, np.zeros(9)
        if scene.ngeom == scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mju_quat2Mat(mat, quat)
        mujoco.mjv_initGeom(geom, kind, size, np.asarray(pos, float), mat, np.array(rgba, np.float32))
        geom.dataid, geom.transparent, geom.emission = max(mesh, -1), True, 0.5 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else 0.2
        scene.ngeom += 1

    def close(self) -> None:
        self._renderer.close()


def write_frames(out: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes frames, [height, width, 3] uint8 each, in the format of the suffix of `out`.

    Above `MOST_FPS` frames per second, some are left out. After an error an existing file is unchanged.
    (imageio_ffmpeg.write_frames does not report a failure of ffmpeg at the end.) Raises ValueError if the file cannot be
    written. The message includes ffmpeg's.
    """
    frames = iter(frames)
    first = next(frames)
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.shape[1]}x{first.shape[0]}", "-r", str(fps), "-i", "-"]
    kept = ["-r", str(MOST_FPS)] if fps > MOST_FPS else []
    with files.atomic_write(out) as partial:
        command = [ffmpeg(), "-v", "error", *source, *kept, *FORMATS[out.suffix.lower()], "-y", f"file:{partial.absolute()}"]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stderr=pipe, start_new_session=True) as process:
            assert process.stdin is not None
            with signals.cleaning(process.kill):  # still running only if a frame could not be drawn
                with contextlib.suppress(BrokenPipeError):  # ffmpeg has failed; the reason is in its output
                    for frame in itertools.chain([first], frames):
                        process.stdin.write(np.ascontiguousarray(frame).data)
                _, message = process.communicate()
        if process.returncode != 0:
            reason = message.decode(errors="replace").strip() or f"ffmpeg ended with status {process.returncode}"
            raise ValueError(f"out: cannot write {out} ({reason})")
