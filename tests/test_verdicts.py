"""What has passed its check is not checked again until something that it depends on changes."""

import importlib
import sys

import pytest

from mjx_dher import RunSpec, envs
from mjx_dher.testing import ComponentError, check_components, verdicts

TASK = """
import json, pathlib
import jax.numpy as jnp
from helper_of_verdicts import NEAR
from point_mass import PointMass

RADIUS = json.loads(pathlib.Path(__file__).with_name("radius.json").read_text())

class Task(PointMass):
    def compute_reward(self, achieved_goal, desired_goal):
        far = jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > NEAR * RADIUS
        return -far.astype(jnp.float32)

def even(achieved, desired, step, hparams):
    return jnp.zeros(achieved.shape[0])
"""
HELPER = "NEAR = 1.0"
SPEC = RunSpec(env="task_of_verdicts:Task")


@pytest.fixture
def told(tmp_path, monkeypatch):
    """Lines of a check in a process that has just begun, as far as the task's modules go; and the folder of the task."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(verdicts, "check_components", lambda env, run, with_env: iter(["env: as it should be"]))
    monkeypatch.syspath_prepend(str(tmp_path))
    files = {"task_of_verdicts.py": TASK, "helper_of_verdicts.py": HELPER, "radius.json": "0.1"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)

    def told(*specs, **more):
        for name in ("task_of_verdicts", "helper_of_verdicts"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        env = envs.make(specs[0].env, **specs[0].env_arguments)
        return list(verdicts.check(env, specs, **more))

    return told


def passed(lines):
    return len(lines) == 1 and "passed before" in lines[0] and "task_of_verdicts:Task" in lines[0]


def install(folder, version):
    (folder / "some_package.dist-info").mkdir(exist_ok=True)
    (folder / "some_package.dist-info" / "METADATA").write_text(f"Name: some-package\nVersion: {version}\n")


CHANGES = {
    "the module": lambda folder: (folder / "task_of_verdicts.py").write_text(TASK + "# another comment"),
    "a module that it imports": lambda folder: (folder / "helper_of_verdicts.py").write_text("NEAR = 1.5  # longer"),
    "a file that it reads": lambda folder: (folder / "radius.json").write_text("0.2"),
    "the version of an installed package": lambda folder: install(folder, "2.0"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_change_is_checked_again(told, tmp_path, monkeypatch, change):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    install(tmp_path, "1.0")
    first = told(SPEC)
    assert [line.partition(" ")[0] for line in first] == ["testing", "env:"]
    assert passed(told(SPEC))
    change(tmp_path)
    assert told(SPEC)[0].startswith("testing")
    assert passed(told(SPEC))


def test_settings_count_as_far_as_a_component_may_read_them(told):
    told(SPEC)
    assert passed(told(RunSpec(env=SPEC.env, seed=5, priority="energy")))
    assert passed(told(*(RunSpec(env=SPEC.env, seed=seed, sampler=name) for seed in range(3) for name in ("final", "future"))))
    assert not passed(told(RunSpec(env=SPEC.env, env_kwargs=("episode_length=5",))))
    own = [RunSpec(env=SPEC.env, sampler="task_of_verdicts:even", seed=seed) for seed in range(3)]
    lines = told(*own)
    assert len(lines) == 2
    assert "sampler task_of_verdicts:even" in told(own[0])[0]
    assert passed(told(own[1]))


def test_a_check_that_is_asked_for_is_made(told):
    told(SPEC)
    assert len(told(SPEC, again=True)) == 2


def test_what_fails_is_not_kept(told, tmp_path, monkeypatch):
    monkeypatch.setattr(verdicts, "check_components", check_components)
    (tmp_path / "radius.json").write_text("-1")  # nothing is ever reached
    for _ in range(2):
        with pytest.raises(ComponentError, match="sparse reward"):
            told(SPEC)


def test_a_cache_that_is_none_is_done_without(told, tmp_path):
    (tmp_path / "cache").write_text("a file in place of the folder")
    for _ in range(2):
        assert told(SPEC)[0].startswith("testing")
    (tmp_path / "cache").unlink()
    told(SPEC)
    (verdict,) = (tmp_path / "cache" / "mjx-dher" / "checked").iterdir()
    verdict.unlink()
    verdict.mkdir()  # no verdict
    assert told(SPEC)[0].startswith("testing")
