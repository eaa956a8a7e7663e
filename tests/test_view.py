"""The viewer without a browser: its page, its server, its commands."""

import dataclasses
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import webbrowser

import numpy as np
import pytest
from conftest import ROOT, refuses

from mjx_dher import cli, envs
from mjx_dher.envs.task import Joints, MujocoTask, Rotation, Start
from mjx_dher.policy import bundled
from mjx_dher.viewer import address, server, sources


def reach():
    return envs.make("reach", engine="native")


def of_package(name):
    return sources.of_run(name, bundled.FOLDER / name)


@pytest.fixture
def port():
    return address.check("127.0.0.1", 0)


# The page


def test_a_port_that_is_free_is_given(port):
    assert address.check("127.0.0.1", port) == port


def test_a_port_in_use_is_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        number = taken.getsockname()[1]
        with refuses("port", number, "--port"):
            address.check("127.0.0.1", number)


@pytest.mark.parametrize(
    ("host", "port", "parts"),
    [
        ("127.0.0.1", -1, ["port", -1]),
        ("127.0.0.1", 65536, ["port", 65536]),
        ("192.0.2.1", 0, ["host", "192.0.2.1"]),
        ("no such host", 0, ["host", "no such host"]),
        ("a" * 300, 0, ["host"]),
    ],
)
def test_a_bad_address_is_refused(host, port, parts):
    with refuses(*parts):
        address.check(host, port)


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with refuses("viser", "[view]"):
        address.check("127.0.0.1", 0)


def test_addresses_are_those_for_a_browser_here():
    assert address.address("127.0.0.1", 80) == "http://127.0.0.1:80"
    assert address.address("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert address.address("::1", 80) == address.address("::", 80) == "http://[::1]:80"


def test_only_a_browser_with_a_screen_is_opened(monkeypatch):
    opened = []

    class Screen(webbrowser.BaseBrowser):
        def open(self, url, new=0, autoraise=True):
            opened.append(url)
            return True

    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(webbrowser, "get", lambda: Screen("screen"))
    monkeypatch.setattr(webbrowser, "open", Screen("screen").open)
    assert not address.open_browser("http://x")  # no display
    monkeypatch.setenv("DISPLAY", ":0")
    assert address.open_browser("http://x")
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("lynx"))
    assert not address.open_browser("http://x")  # it would take the terminal

    def none():
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    assert not address.open_browser("http://x")
    assert opened == ["http://x"]


# The server


def test_the_page_is_served_and_the_port_is_free_afterwards(port, capsys):
    with server.Viewer(
        [of_package("reach"), sources.by_random("reach")], lambda source: reach(), "127.0.0.1", port, 1
    ) as viewer:
        assert viewer.address == f"http://127.0.0.1:{port}"
        with urllib.request.urlopen(viewer.address, timeout=10) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read(2000).lower()
        with refuses("port"):
            address.check("127.0.0.1", port)
        ends = time.monotonic() + 0.2
        viewer.run(lambda: time.monotonic() > ends)
        assert viewer.player.clock == 0  # nobody looks
        viewer.choose("random actions, reach")
        assert viewer.player.act is viewer._cast.act
        assert viewer._panel._critic.content == "Random actions have no critic."
        viewer.take("object")  # Reach has none
        assert viewer._handle is None
    assert address.check("127.0.0.1", port) == port
    assert capsys.readouterr().out == ""  # what viser prints is not for users


def test_a_policy_that_cannot_be_played_is_told_and_the_other_goes_on(port):
    wrong = dataclasses.replace(of_package("push"), env="reach")
    with server.Viewer([of_package("reach"), wrong], lambda source: reach(), "127.0.0.1", port, 1) as viewer:
        before = viewer.player
        viewer.choose("push")
        assert viewer.player is before
        assert "push cannot be played in reach" in viewer._panel._about.content
        assert viewer._panel._policy.value == "reach"
        viewer._panel.say("runs/x\udcff")  # bytes of a file name, which no message can hold
        assert viewer._panel._about.content == "runs/x\\xff"


def test_a_hand_moves_the_goal(port):
    with server.Viewer([of_package("reach")], lambda source: reach(), "127.0.0.1", port, 1) as viewer:
        upright = np.array([1.0, 0, 0, 0])
        viewer._drag("goal", (np.zeros(3), upright), "start")
        assert not viewer.player.is_own  # it is held, not moved
        viewer._drag("goal", (np.array([1.3, 0.8, 0.5]), upright), "update")
        viewer.show(True)
        np.testing.assert_allclose(viewer._balls[0].position, [1.3, 0.8, 0.5], atol=1e-6)
        np.testing.assert_allclose(
            viewer._handle.position, viewer.player.game.reset(np.uint32(1)).obs["desired_goal"], atol=1e-6
        )
        viewer._drag("goal", (np.array([9.0, 0.8, 0.5]), upright), "update")
        viewer._drag("goal", (np.zeros(3), upright), "end")
        viewer.show(True)
        highest = viewer.player.game.env.goal_bounds[1, 0]
        np.testing.assert_allclose(
            viewer._handle.position, [highest, 0.8, 0.5], atol=1e-6
        )  # it springs back to where goals lie


class Turn(MujocoTask):
    """A box that lies in front of a servo; the goal is its orientation."""

    model = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" range="-1 1"/><geom size=".1"/></body>
    <body name="box" pos="1 0 0"><freejoint/><geom type="box" size=".1 .2 .3"/></body></worldbody>
    <actuator><position joint="a" kp="1" ctrlrange="-1 1"/></actuator></mujoco>"""
    goal = Rotation("body:box", threshold=0.2)


def test_a_hand_turns_the_goal(port):
    source = sources.by_random("test_view:Turn")
    with server.Viewer([source], lambda source: Turn(engine="native"), "127.0.0.1", port, 1) as viewer:
        quat = np.array([0.5, 0.5, -0.5, 0.5])
        place = np.array(viewer._handle.position)
        np.testing.assert_allclose(place, [1, 0, 0], atol=1e-6)  # at the ghost, which is where the box is
        viewer._drag("goal", (place + 1.0, quat), "update")
        viewer._drag("goal", (place, quat), "end")
        viewer.show(True)
        (ghost,) = viewer._ghosts.values()
        np.testing.assert_allclose(ghost.wxyz, quat, atol=1e-6)
        np.testing.assert_allclose(viewer._handle.position, place, atol=1e-6)
        np.testing.assert_allclose(viewer._handle.wxyz, quat, atol=1e-6)
        assert viewer.player.is_own
        assert viewer._panel._distance.title == "Distance to the goal, °"
        assert f"{np.degrees(viewer.player.distance):.1f} ° from the goal" in viewer._panel._score.content


class Bent(MujocoTask):
    """The goal is a joint's angle, and a box has a range of starts."""

    model = Turn.model
    start = Start(ranges={"box": ((0.8, -0.1, 0.0), (1.2, 0.1, 0.0))})
    goal = Joints("a", low=-0.5, high=0.5)


def test_an_object_is_held_where_it_is_and_not_where_the_goal_is(port):
    source = sources.by_random("test_view:Bent")
    with server.Viewer([source], lambda source: Bent(engine="native"), "127.0.0.1", port, 1) as viewer:
        aimed = []
        viewer._aim = lambda: aimed.append(1)
        viewer.take("object")
        np.testing.assert_allclose(viewer._handle.position, viewer.player.qpos[1:4], atol=1e-6)
        viewer._drag("object", (np.array([1.1, 0.05, 0.0]), np.eye(4)[0]), "update")  # without a start
        viewer.show(True)
        np.testing.assert_allclose(viewer._handle.position, [1.1, 0.05, 0.0], atol=1e-6)
        np.testing.assert_allclose(viewer.player.qpos[1:4], [1.1, 0.05, 0.0], atol=1e-6)
        assert not aimed  # the cameras stay as the users have turned them


# The commands

BAD = [
    ([], ["view needs run folders, bundled policies", "push", "--env"]),
    (["nowhere"], ["nowhere is not a run folder: no such folder"]),
    (["docs"], ["docs is not a run folder: it has no config.json"]),
    (["pusch"], ["did you mean 'push'?"]),
    (["--env", "sldie"], ["env must be one of", "did you mean 'slide'?"]),
    (["push", "--engine", "wrap"], ["engine", "'wrap'"]),
    (["push", "--env-kwargs", "x"], ["env_kwargs must be NAME=VALUE"]),
    (["push", "--seed", "-1"], ["seed must lie in [0, 4294967295]; got -1"]),
    (["push", "--port", "70000"], ["port must lie in [0, 65535]"]),
    (["push", "--host", "192.0.2.1"], ["host must be an address of this machine; got '192.0.2.1'"]),
]


@pytest.mark.parametrize(("argv", "messages"), BAD)
def test_bad_arguments_are_refused(argv, messages, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert cli.main(["view", *argv]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    for message in messages:
        assert message in error


def test_bad_arguments_are_refused_before_jax_or_mujoco_load():
    code = f"""
import sys
from mjx_dher.cli import main
assert all(main(["view", *argv]) == 2 for argv in {[argv for argv, _ in BAD]!r})
assert main(["demo", "--port", "-1"]) == 2
assert main(["train", "--env", "reach", "--view", "--view-port", "-1"]) == 2
assert not {{"jax", "mujoco", "viser"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)


def test_a_policy_of_another_environment_ends_the_command(capsys, port):
    assert cli.main(["view", "push", "--env", "reach", "--port", str(port), "--no-open"]) == 2
    assert "error: push cannot be played in reach" in capsys.readouterr().err
    assert address.check("127.0.0.1", port) == port


def begun(*argv, **variables):
    """Starts a command that shows a page; returns the process, once it has told the address, and what it has printed."""
    environment = {name: x for name, x in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")}
    process = subprocess.Popen(
        [sys.executable, "train.py", *argv],
        cwd=ROOT,
        env={**environment, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    lines = []
    while not lines or "http://" not in lines[-1]:
        lines.append(process.stdout.readline())
        assert lines[-1], process.stderr.read()
    return process, lines


@pytest.mark.slow
def test_the_demo_ends_with_ctrl_c_and_leaves_nothing(port):
    process, lines = begun("demo", "--port", str(port), PYTHONFAULTHANDLER="1")
    assert lines[-1] == f"showing push: http://127.0.0.1:{port} (Ctrl-C ends it)\n"
    assert process.stdout.readline() == "no browser was found: open that address in one\n"
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10) as answer:
        assert answer.status == 200
    process.send_signal(signal.SIGINT)
    try:
        out, err = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # with what each thread was at
        pytest.fail(process.communicate()[1])
    assert (process.returncode, out, err) == (128 + signal.SIGINT, "", "stopped\n")
    assert address.check("127.0.0.1", port) == port


@pytest.mark.slow
def test_a_viewer_ends_with_the_run_that_it_shows(port, tmp_path):
    """`train --view` begins it after the first epoch, and it ends when the run does, even by a kill."""
    argv = ["--env", "reach", "--preset", "cpu", "--total-steps", "4000000", "--out", str(tmp_path / "run")]
    process, _ = begun("train", *argv, "--view", "--view-port", str(port))
    ends = time.monotonic() + 120
    while _is_free(port):
        assert time.monotonic() < ends
        time.sleep(0.2)
    process.kill()
    process.communicate()
    ends = time.monotonic() + 30
    while not _is_free(port):
        assert time.monotonic() < ends
        time.sleep(0.2)


def _is_free(port):
    with socket.socket() as trial:
        return trial.connect_ex(("127.0.0.1", port)) != 0
