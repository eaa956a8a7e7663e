import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from conftest import ROOT, names, refuses, save_policy

from mjx_dher import RunSpec, cli, policy
from mjx_dher.runs.folder import run_folder
from mjx_dher.tools import render

NO_GL = 77  # exit status of SCRIPT where nothing can draw

# In a process of its own: MuJoCo chooses how to draw when it is imported, which other tests have done.
SCRIPT = """
import sys
from pathlib import Path
import numpy as np
from mjx_dher import cli, envs
from mjx_dher.tools import render

folder = Path(sys.argv[1])
try:
    render.choose_gl()
except ValueError as error:
    print(error)
    sys.exit(77)
import jax

def picture(env, qpos, goal):
    return next(render.draw_frames(env, [qpos], goal, 320, 240))

if sys.argv[2] == "commands":
    small = ["--width", "96", "--height", "64"]
    codes = [
        cli.main(["render", str(folder / "run"), "--out", str(folder / "run.gif"), "--episodes", "2", *small]),
        cli.main(["render", "--env", "reach", "--out", str(folder / "reach.png"), "--episodes", "1", *small]),
    ]
    assert codes == [0, 0]
    sys.exit()

frames = {}
for name in ('pick_and_place', 'push', 'reach', 'slide'):
    env = envs.make(name, engine="native")
    state = env.reset(jax.random.key(0))
    frames[name] = picture(env, np.asarray(state.physics.qpos), np.asarray(state.obs["desired_goal"]))

env = envs.make("push", engine="native")
qpos = np.array(env.reset(jax.random.key(0)).physics.qpos)
place = env._object_qpos.start
for key, shift in (("near", 0.1), ("far", -0.1)):  # along x, away from the robot and towards it
    frames["goal_" + key] = picture(env, qpos, np.array([1.3 + shift, 0.6, 0.425]))
    qpos[place : place + 2] = 1.3 + shift, 0.6
    frames["object_" + key] = picture(env, qpos, np.array([1.3, 0.9, 0.425]))

import mujoco, types
tendon = '''<mujoco><worldbody><light pos="0 -2 1"/><camera name="front" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>
  <site name="a" pos="-.2 0 0"/>
  <body pos=".2 0 0"><joint/><geom size=".01"/><site name="b"/></body></worldbody>
  <tendon><spatial width=".03" rgba="0 0 1 1"><site site="a"/><site site="b"/></spatial></tendon></mujoco>'''
model = mujoco.MjModel.from_xml_string(tendon)
frames["tendon"] = picture(types.SimpleNamespace(model=model, goal_marks=lambda qpos, goal: []), np.zeros(1), np.zeros(3))
np.savez(folder / "frames.npz", **frames)
"""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Folder of SCRIPT, and what its commands printed."""
    folder = tmp_path_factory.mktemp("render")
    run_folder.write_config(
        folder / "run", RunSpec(env="push", env_kwargs=("episode_length=4",), engine="native"), "native", {}
    )
    still = policy.Policy(
        layers=((np.zeros((28, 4)), np.zeros(4)),),
        observation_mean=np.zeros(25),
        observation_std=np.ones(25),
        goal_mean=np.zeros(3),
        goal_std=np.ones(3),
        norm_clip=5.0,
        obs_clip=200.0,
    )
    save_policy(folder / "run", still)
    return folder, draw(folder, "commands")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Pictures of SCRIPT by name."""
    folder = tmp_path_factory.mktemp("pictures")
    draw(folder, "pictures")
    with np.load(folder / "frames.npz") as file:
        return dict(file)


def draw(folder, what):
    """What a part of SCRIPT prints."""
    command = [sys.executable, "-c", SCRIPT, str(folder), what]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode == NO_GL:
        pytest.skip(f"nothing on this machine can draw: {done.stdout.strip()}")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def centre(picture, colour):
    """(row, column) of the middle of all pixels in which one channel stands out; None without such."""
    channel = {"red": 0, "blue": 2}[colour]
    rest = np.delete(picture.astype(int), channel, axis=-1).max(axis=-1)
    pixels = np.argwhere(picture[..., channel] - rest > 60)
    return pixels.mean(axis=0) if len(pixels) > 20 else None


@pytest.mark.slow
def test_every_task_shows_its_goal_and_its_object(frames):
    for name in ("pick_and_place", "push", "reach", "slide"):
        assert frames[name].shape == (240, 320, 3)
        assert centre(frames[name], "red") is not None, name
        assert (centre(frames[name], "blue") is None) == (name == "reach")


@pytest.mark.parametrize(("what", "colour"), [("goal", "red"), ("object", "blue")])
@pytest.mark.slow
def test_a_thing_moved_is_drawn_moved(frames, what, colour):
    near, far = (centre(frames[f"{what}_{where}"], colour) for where in ("near", "far"))
    assert near[0] > far[0] + 20  # the camera looks at the robot: nearer to the camera is lower in the picture


@pytest.mark.slow
def test_a_tendon_is_drawn_between_its_sites(frames):
    np.testing.assert_allclose(centre(frames["tendon"], "blue"), (120, 160), atol=5)


def test_the_command_writes_every_frame(drawn):
    folder, printed = drawn
    assert frames_in(folder / "run.gif", 96, 64) == 2 * (5 + 10)
    assert "push: 2 episodes, seed 1, physics native, drawn with " in printed
    assert f"of 2; wrote {folder / 'run.gif'}\n" in printed


def test_without_a_run_a_task_is_played_with_random_actions(drawn):
    folder, printed = drawn
    assert frames_in(folder / "reach.png", 96 * render.STILLS, 64) == 1
    assert "reach: 1 episodes of random actions, seed 1, physics native" in printed
    assert {path.name for path in folder.iterdir()} == {"run", "run.gif", "reach.png"}


def frames_in(path, width, height):
    """Counts the pictures of this size in a file."""
    form = ["-fps_mode", "passthrough", "-f", "image2pipe", "-c:v", "ppm"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), *form, "-"]
    return subprocess.run(command, capture_output=True, check=True).stdout.count(f"P6\n{width} {height}\n255\n".encode())


def moving(count):
    """`count` pictures, no two alike."""
    frames = np.full((count, 64, 96, 3), 200, np.uint8)
    for index, frame in enumerate(frames):
        frame[20:40, 2 * index : 2 * index + 20] = (255, 0, 0)
    return frames


@pytest.mark.parametrize(("suffix", "count"), [(".mp4", 12), (".gif", 12), (".GIF", 12), (".png", 1)])
def test_what_is_written_can_be_read(tmp_path, suffix, count):
    render.write_frames(tmp_path / f"out{suffix}", moving(count), 25.0)
    assert frames_in(tmp_path / f"out{suffix}", 96, 64) == count
    assert os.listdir(tmp_path) == [f"out{suffix}"]


def test_why_ffmpeg_was_killed_is_told(tmp_path, monkeypatch):
    killed = tmp_path / "ffmpeg"
    killed.write_text("#!/bin/sh\nkill -9 $$\n")
    killed.chmod(0o700)
    monkeypatch.setattr(render, "ffmpeg", lambda: str(killed))
    with refuses("out", "ended with status -9"):
        render.write_frames(tmp_path / "a.gif", iter([np.zeros((4, 4, 3), np.uint8)] * 9), 25.0)
    assert os.listdir(tmp_path) == ["ffmpeg"]


@pytest.mark.parametrize("name", ["12:30.gif", "-x.gif", "pic%d.png"])
def test_names_that_ffmpeg_would_read_otherwise_are_names(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pic1.png.partial").write_text("mine")
    render.write_frames(Path(name), moving(1), 25.0)
    assert sorted(os.listdir(tmp_path)) == sorted([name, "pic1.png.partial"])  # the user's
    assert (tmp_path / "pic1.png.partial").read_text() == "mine"


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize(("fps", "frames"), [(10.0, 30), (33.0, 30), (200.0, 8)])
def test_a_video_lasts_as_long_as_what_it_shows(tmp_path, suffix, fps, frames):
    """Where there are more frames in a second than a file can show, some are left out."""
    out = tmp_path / f"out{suffix}"
    render.write_frames(out, moving(30), fps)
    assert frames_in(out, 96, 64) == pytest.approx(frames, abs=2)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(out)]
    told = subprocess.run(command, capture_output=True, check=False).stderr.decode()
    seconds = float(re.search(r"Duration: 00:00:([\d.]+)", told).group(1))
    assert seconds == pytest.approx(30 / fps, abs=0.05)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a disk that is full")
def test_a_full_disk_is_an_error(tmp_path, monkeypatch):
    """All frames fit into a buffer, so that only ffmpeg's exit status tells."""
    out = tmp_path / "out.gif"

    @contextlib.contextmanager
    def to_full_disk(path):
        partial = path.with_name(path.name + ".partial")
        partial.symlink_to("/dev/full")
        try:
            yield partial
        finally:
            partial.unlink()

    monkeypatch.setattr(render.files, "atomic_write", to_full_disk)
    with refuses("out", out, "No space left"):
        render.write_frames(out, moving(1), 25.0)
    assert os.listdir(tmp_path) == []


def test_a_file_stays_whole_when_its_successor_fails(tmp_path):
    def breaks():
        yield moving(1)[0]
        raise RuntimeError("cannot draw")

    out = tmp_path / "out.mp4"
    out.write_text("before")
    with pytest.raises(RuntimeError, match="cannot draw"):
        render.write_frames(out, breaks(), 25.0)
    with refuses("out", out):
        render.write_frames(out, np.zeros((3, 65, 65, 3), np.uint8), 25.0)  # H.264 takes even sizes only
    assert out.read_text() == "before"
    assert os.listdir(tmp_path) == ["out.mp4"]


OUT = ["--out", "there-is-none.gif"]
BAD = [  # arguments, and what the message names: the field, the value and what is allowed
    (["--env", "push", "--out", "x.avi"], ["out", "x.avi", ".gif"]),
    (["--env", "push", "--out", "x"], ["out", "x", ".gif"]),
    (["--env", "push", "--out", "nowhere/x.gif"], ["out", "nowhere"]),
    (["--env", "push", "--out", "/proc/x.gif"], ["out", "/proc cannot be written to"]),  # before it plays
    (["--env", "push", "--out", "docs/push_learning_curve.png"], ["out", "docs/push_learning_curve.png", "--overwrite"]),
    (["--env", "push", *OUT, "--width", "641"], ["width", 641]),
    (["--env", "push", *OUT, "--width", "0", "--height", "9999"], ["width", "height", 9999]),
    (["--env", "push", *OUT, "--episodes", "0"], ["episodes", 0]),
    (["--env", "pusch", *OUT], ["env", "pusch", "push"]),
    (["--env", "push", *OUT, "--engine", "wrap"], ["engine", "wrap", "native", "warp"]),
    (OUT, ["run folder", "--env", "push"]),
    (["docs", "--env", "push", *OUT], ["run folder", "--env"]),
    (["docs", *OUT], ["docs", "run folder", "config.json"]),
]


def test_bad_arguments_are_refused(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    for argv, parts in BAD:
        assert cli.main(["render", *argv]) == 2
        error = capsys.readouterr().err
        assert all(line.startswith("error: ") for line in error.splitlines())
        names(error, *parts)


def test_bad_arguments_are_refused_before_jax_or_mujoco_load():
    code = f"""
import sys
from mjx_dher.cli import main
assert all(main(["render", *argv]) == 2 for argv in {json.dumps([argv for argv, _ in BAD])})
assert not {{"jax", "mujoco"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)


def test_a_machine_that_cannot_draw_is_told_what_to_install(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with refuses("MUJOCO_GL", "nonsense", "libegl1", "libosmesa6"):
        render.choose_gl()


def test_a_way_to_draw_that_hangs_is_given_up():
    assert render.try_gl("egl", seconds=0.01) == "did not end within 0.01 s"


# MuJoCo is imported first, as by another environment, and so has chosen a way to draw that needs a screen.
LATE = """
import mujoco, sys, types
from mjx_dher.tools import render
scene = '<geom size=".1"/><camera name="front" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>'
model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{scene}</worldbody></mujoco>")
try:
    pictures = list(render.draw_frames(types.SimpleNamespace(model=model), [[]] * 2, [0.2, 0, 0], 64, 64))
except ValueError as error:
    print(error)
    sys.exit(77 if "cannot draw here" in str(error) else 1)
assert len(pictures) == 2 and pictures[0].std() > 1
"""


def test_it_draws_after_mujoco_was_imported():
    variables = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", LATE], cwd=ROOT, env=variables, capture_output=True, text=True, check=False)
    if done.returncode == NO_GL:
        pytest.skip(f"nothing on this machine can draw: {done.stdout.strip()}")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_a_way_to_draw_is_tried_once(monkeypatch):
    tried = []
    monkeypatch.setattr(render, "_DRAWN", set())
    monkeypatch.setattr(render, "try_gl", lambda name: tried.append(name))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert [render.choose_gl() for _ in range(3)] == ["egl"] * 3
    assert tried == ["egl"]


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with refuses("imageio_ffmpeg", "[video]"):
        render.ffmpeg()
