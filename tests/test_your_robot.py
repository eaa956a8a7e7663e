"""docs/your_robot.md, docs/real_robot.md and their arm, docs/examples/my_arm.py: from an MJCF to ONNX, on every engine."""

import json
import re

import jax
import jax.numpy as jnp
import my_arm
import numpy as np
import pytest
import seven_joints
from conftest import EXAMPLES, ROOT

from mjx_dher import cli
from mjx_dher.envs.kinematics import Place
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec

PAGE, REAL = ((ROOT / "docs" / name).read_text() for name in ("your_robot.md", "real_robot.md"))


def test_the_page_shows_the_example():
    code = (EXAMPLES / "my_arm.py").read_text()
    shown = [block for block in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "class " in block]
    assert [block.count("class ") for block in shown] == [1, 1]
    for block in shown:
        assert block.partition("class ")[2] in code
    assert len(code.splitlines()) <= 40


@pytest.mark.slow
def test_the_page_works_line_by_line(tmp_path, monkeypatch, capsys):
    """From `check` to ONNX; and a robot's loop gives the action that the policy gives in simulation."""
    monkeypatch.chdir(tmp_path)
    script = "".join(re.findall(r"```bash\n(.*?)```", PAGE, re.S))
    for line in script.replace("\\\n", "").splitlines():
        command = line.removeprefix("python train.py ").split()
        if command[0] not in ("view", "render"):
            assert cli.main(command) == 0, line
    assert float(re.findall(r"^success ([\d.]+)", capsys.readouterr().out, re.M)[0]) >= 0.9
    assert (tmp_path / "arm.onnx").stat().st_size > 10_000
    assert json.loads((tmp_path / "runs/arm/config.json").read_text())["interface"]["dt"] == 0.04
    (robot,) = [block for block in re.findall(r"```python\n(.*?)```", REAL, re.S) if "def targets" in block]
    names = {"Reach": my_arm.Reach}
    exec(compile(robot, "real_robot.md", "exec"), names)
    state = names["env"].reset(jax.random.key(0))
    ctrl = names["targets"](state.physics.qpos, state.physics.qvel, state.obs["desired_goal"])
    action = names["policy"](jax.tree.map(np.asarray, state.obs))
    np.testing.assert_allclose(ctrl, names["env"].controls(state.physics, jnp.asarray(action)).ctrl, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Reach", "Push"])
def test_engines_agree_on_the_arm(name):
    """Ten steps from one start under random actions; warp by the path graph."""
    results = {}
    for engine, options in {"native": {}, "jax": {}, "warp": {"allow_cpu": True}}.items():
        env = getattr(my_arm, name)(engine=engine, **options)
        state, step = env.reset(jax.random.key(0)), jax.jit(env.step)
        for action in 0.5 * jax.random.normal(jax.random.key(1), (10, env.action_size)):
            state = step(state, action)
        results[engine] = state.obs["observation"]
    for observation in results.values():
        np.testing.assert_allclose(observation, results["native"], atol=1e-3)


@pytest.mark.parametrize(("name", "size"), [("Reach", 7), ("Push", 7), ("Pick", 8)])
def test_the_arm_of_seven_joints_has_the_published_sizes(name, size):
    """At zero angles the flange is 88 mm in front of the base, and 333 + 316 + 384 - 107 mm high."""
    env = getattr(seven_joints, name)(engine="native")
    assert env.action_size == size
    hand = Place(env.model, "body:hand").position(jnp.zeros(env.model.nq))
    np.testing.assert_allclose(hand, [0.088, 0, 0.926], atol=1e-6)


def test_an_edited_mjcf_changes_the_identity_of_a_run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "robot_of_test.py").write_text('model = "robot.xml"')
    digests = []
    for files in ({"robot.xml": "a"}, {"robot.xml": "b"}, {"other.xml": "c"}):
        for name, content in files.items():
            (tmp_path / name).write_text(content)
        fingerprint._source.cache_clear()
        digests.append(fingerprint.sources(RunSpec(env="robot_of_test:Reach"))["env"])
    assert digests[0] != digests[1] == digests[2]
