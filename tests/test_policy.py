import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, refuses, save_policy

import mjx_dher
from mjx_dher import RunSpec, learners
from mjx_dher.config import Config, HParams
from mjx_dher.runs.folder import reading, run_folder
from mjx_dher.system.files import FolderError
from probes import spec_of

HP = HParams(norm_clip=3.0)
DDPG = learners.make("ddpg", Config(), spec_of(25, 3, 4))
SPEC = RunSpec(config=Config(hidden_sizes=(256, 256)), hparams=HP, seed=3, engine="native", sampler="closest", metric="a:b")


@pytest.fixture(scope="module")
def learner():
    keys = jax.random.split(jax.random.key(0), 3)
    observations = 0.3 * jax.random.normal(keys[1], (100, 25)) + 1.3
    goals = jax.random.normal(keys[2], (100, 3))

    @jax.jit  # one program instead of some hundred
    def learner(key, observations, goals):
        state = DDPG.init(key)
        # Biases begin as 0, and would not be missed.
        state = state.replace(params=jax.tree.map(lambda x: x + 0.1 if x.ndim == 1 else x, state.params))
        return DDPG.update_normalizers(state, observations, goals, HP)

    return learner(keys[0], observations.at[:, 5].set(0.0), goals)


@pytest.fixture
def run_dir(tmp_path, learner):
    run_folder.write_config(tmp_path / "run", SPEC, "native", {"note": "for the reader"})
    save_policy(tmp_path / "run", DDPG.export(learner, HP))
    return tmp_path / "run"


def test_the_loaded_policy_acts_as_the_learner_does(run_dir, learner):
    rng = np.random.default_rng(0)
    obs = {
        "observation": rng.normal(1.3, 1.0, (64, 25)).astype(np.float32),
        "achieved_goal": np.zeros((64, 3), np.float32),
        "desired_goal": rng.normal(0, 2, (64, 3)).astype(np.float32),
    }
    loaded = mjx_dher.load_policy(run_dir)
    actions = loaded(obs)
    assert isinstance(actions, np.ndarray)
    assert actions.shape == (64, 4)
    assert np.abs(actions).max() <= 1
    assert np.abs(actions).std() > 0.05
    np.testing.assert_allclose(actions, jax.jit(DDPG.act)(learner, obs, HP), atol=1e-5)
    np.testing.assert_allclose(loaded({k: v[7] for k, v in obs.items()}), actions[7], atol=1e-6)
    traced = jax.jit(lambda o: loaded.forward(o["observation"], o["desired_goal"], jnp))(obs)
    np.testing.assert_allclose(actions, traced, atol=1e-5)


def test_a_description_comes_back_as_it_was(run_dir):
    assert reading.read_spec(run_dir) == SPEC
    content = reading.read_config(run_dir)
    assert (content["engine"], content["physics"], content["note"]) == ("native", "native", "for the reader")


def test_loading_and_acting_need_numpy_alone(run_dir):
    code = f"""
import sys
import numpy as np
import mjx_dher
policy = mjx_dher.load_policy({str(run_dir)!r})
policy({{"observation": np.zeros(25), "achieved_goal": np.zeros(3), "desired_goal": np.zeros(3)}})
loaded = {{name.split(".")[0] for name in sys.modules}}
assert not loaded & {{"jax", "mujoco", "flax", "optax", "gymnasium"}}, loaded
assert not any(name.startswith("mjx_dher.envs") for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


BAD_OBSERVATIONS = [
    ({"observation": np.zeros(25)}, ["desired_goal"]),
    ({"observation": np.zeros(24), "desired_goal": np.zeros(3)}, ["observation", 25, "(24,)"]),
    ({"observation": np.zeros(25), "desired_goal": np.zeros(())}, ["desired_goal", 3, "()"]),
    ({"observation": np.zeros((2, 25)), "desired_goal": np.zeros(3)}, ["observation", (2, 25), "desired_goal", (3,)]),
    ({"observation": np.full(25, np.nan), "desired_goal": np.zeros(3)}, ["observation", "finite"]),
]


def test_bad_observations_are_refused(run_dir):
    policy = mjx_dher.load_policy(run_dir)
    for obs, parts in BAD_OBSERVATIONS:
        with refuses(*parts):
            policy(obs)


def damage(run_dir, how):
    config_file, policy_file = run_dir / run_folder.CONFIG_FILE, run_dir / run_folder.POLICY_FILE
    content = json.loads(config_file.read_text())
    if how == "no config":
        config_file.unlink()
    elif how == "broken json":
        config_file.write_text(config_file.read_text()[:-20])
    elif how == "foreign json":
        config_file.write_text('{"model_type": "bert"}')
    elif how == "list":
        config_file.write_text("[]")
    elif how == "newer schema":
        config_file.write_text(json.dumps(content | {"schema": 99}))
    elif how == "unknown field":
        content["config"]["colour"] = 1
        config_file.write_text(json.dumps(content))
    elif how == "no policy":
        policy_file.unlink()
    elif how == "truncated policy":
        policy_file.write_bytes(policy_file.read_bytes()[:1000])
    elif how == "foreign policy":
        np.savez(policy_file.open("wb"), other=np.zeros(3))
    elif how == "interface":
        arrays = dict(np.load(policy_file))
        np.savez(policy_file.open("wb"), **arrays, interface=np.frombuffer(b"[1]", np.uint8))
    elif how == "wide numbers":
        arrays = dict(np.load(policy_file))
        np.savez(policy_file.open("wb"), **arrays | {"layer0_kernel": arrays["layer0_kernel"].astype(np.longdouble)})
    elif how == "no policy file at all":
        policy_file.write_text("hello")


DAMAGES = {
    "no config": ["config.json"],
    "broken json": ["config.json"],
    "foreign json": ["config.json", "schema", None],
    "list": ["config.json", "schema"],
    "newer schema": ["config.json", "schema", 99],
    "unknown field": ["config.json"],
    "no policy": ["policy.npz", "missing"],
    "truncated policy": ["policy.npz", "damaged"],
    "foreign policy": ["policy.npz", "damaged"],
    "interface": ["policy.npz", "interface", "[1]"],
    "wide numbers": ["policy.npz", "layer0_kernel", "float32"],
    "no policy file at all": ["policy.npz", "damaged"],
}


def test_unreadable_and_foreign_run_folders_are_refused(run_dir, tmp_path_factory):
    for how, parts in DAMAGES.items():
        copy = shutil.copytree(run_dir, tmp_path_factory.mktemp("damaged") / "run")
        damage(copy, how)
        with refuses(*parts, error=FolderError):
            mjx_dher.load_policy(copy)


def test_no_folder(tmp_path):
    with refuses("nowhere", error=FolderError):
        mjx_dher.load_policy(tmp_path / "nowhere")
