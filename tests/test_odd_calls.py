"""Calls from Python with values that are nearly right: NumPy's scalars, other shapes, names, and too many or too few."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from configs import SMALL, TINY
from conftest import refuses

from mjx_dher import Config, HParams, RunSpec, contract, envs, gym, normalizer, relabel, samplers, trainer, validation
from mjx_dher import spec as spec_lib
from mjx_dher.envs import Simulator
from mjx_dher.parallel import mesh
from mjx_dher.rollout import rollout
from mjx_dher.runs import loop, program
from mjx_dher.runs.folder import reading, results, run_folder
from mjx_dher.types import EnvSpec
from point_mass import PointMass


def test_numbers_of_numpy_are_checked_and_kept_as_python_s(tmp_path):
    config = Config(num_envs=np.int64(2), hidden_sizes=(np.int32(8),))
    hparams = HParams(her_k=np.int64(8), gamma=np.float32(0.5))
    run_folder.write_config(tmp_path / "run", RunSpec(config=config, hparams=hparams), "native", {})
    assert reading.read_spec(tmp_path / "run").hparams.her_k == 8
    assert config == Config(num_envs=2, hidden_sizes=(8,))
    for bad in ({"gamma": np.float64(5)}, {"her_k": np.float32("nan")}, {"her_k": np.float64(-0.5)}):
        with refuses(*bad):
            validation.validate(TINY, HParams(**bad), 10)
    validation.validate(TINY, HParams(gamma=np.float32(0.9), her_k=np.int64(4)), np.int64(10))
    validation.validate(TINY, HParams(gamma=np.array([0.9, 5])), 10)  # one for each run
    jax.eval_shape(lambda gamma: validation.validate(TINY, HParams(gamma=gamma), 10), 0.9)
    for field in ("cycles_per_epoch", "n_step"):
        with refuses(field, 1.5):
            validation.validate(dataclasses.replace(TINY, **{field: np.float64(1.5)}), HParams(), 10)


@pytest.mark.parametrize(("text", "value"), [("False", False), ("TRUE", True), ("false", False), ('"False"', "False")])
def test_a_flag_of_an_environment_is_one_however_it_is_written(text, value):
    run = RunSpec(env_kwargs=(f"easy={text}",))
    assert run.env_arguments == {"easy": value}
    assert RunSpec(env_kwargs=run.env_kwargs) == run


@pytest.mark.parametrize("seed", [-1, 2**32, 1.5, True, np.float32(3)])
def test_seeds_have_32_bits(seed):
    with refuses("seed", seed):
        next(loop.train(PointMass(), TINY, seed=seed))
    with refuses("seed", seed):
        spec_lib.validate(RunSpec(env="reach", seed=seed))


def test_a_start_at_the_end_leaves_nothing_to_train():
    epochs = TINY.total_steps // (TINY.num_envs * TINY.cycles_per_epoch * PointMass().episode_length)
    with refuses("total_steps", "nothing is left", epochs):
        next(loop.train(PointMass(), TINY, start=loop.Start(None, epochs)))


def test_moments_are_of_values_of_their_shape():
    state = normalizer.init(jnp.zeros(3))
    for values in (jnp.arange(6.0), jnp.ones((3, 1)), jnp.ones(())):
        with refuses("values", "[3]", list(values.shape)):
            normalizer.update(state, values, 200.0)
        with refuses("values", "[3]", list(values.shape)):
            normalizer.normalize(state, values, 0.01, 5.0, 200.0)
    with refuses("valid", "bool", "int32"):
        normalizer.update(state, jnp.ones((2, 3)), 200.0, valid=jnp.array([2, 2]))


HINGE = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""


def test_a_control_that_is_no_number_leaves_none():
    simulator = Simulator(mujoco.MjModel.from_xml_string(HINGE), substeps=2)
    data, step = simulator.make_data(), jax.jit(jax.vmap(simulator.step, (None, 0)))
    ctrl = jnp.array([1.0, jnp.nan, jnp.inf, 1e20, -9e9])
    np.testing.assert_array_equal(jnp.isfinite(step(data, ctrl[:, None]).qpos[:, 0]), [True, False, False, False, True])


def test_actions_beyond_the_space_are_clipped_for_any_environment(monkeypatch):
    class Free(PointMass):
        def step(self, state, action):
            moved = state.obs["achieved_goal"] + action
            return state.replace(obs={**state.obs, "achieved_goal": moved})

    monkeypatch.setattr("point_mass.Free", Free, raising=False)
    env = gym.GymEnv("point_mass:Free")
    first, _ = env.reset(seed=0)
    np.testing.assert_allclose(
        env.step(np.float32([50, -0.5]))[0]["achieved_goal"] - first["achieved_goal"], [1, -0.5], atol=1e-6
    )


def test_options_reach_only_what_takes_an_engine():
    class Plain(PointMass):
        def __init__(self, extra=1, **options):
            super().__init__(**options)

    class Push(envs.load("env", "push")):
        def __init__(self, extra=1, **options):
            super().__init__(**options)

    assert not envs.takes_engine(Plain)
    assert envs.takes_engine(Push)
    assert envs.takes_engine(lambda **options: None)
    assert envs.make(Plain).episode_length == PointMass().episode_length


def test_sizes_of_numpy_are_sizes_of_an_environment():
    class Sized(PointMass):
        action_size = np.int64(2)

        @property
        def spec(self):
            return EnvSpec(jax.ShapeDtypeStruct((2,), jnp.float32), np.int64(2), 2, self.episode_length)

    contract.env_spec(Sized())
    for bounds in ((0,), None, "ab", (1, 0)):
        with refuses("reward_range", str(bounds)):
            EnvSpec(jax.ShapeDtypeStruct((2,), jnp.float32), 2, 2, 10, reward_range=bounds)


def test_an_observation_is_not_empty():
    class Blind(PointMass):
        def reset(self, key):
            state = super().reset(key)
            return state.replace(obs={**state.obs, "observation": jnp.zeros(0)})

    with refuses("observation", "empty"):
        contract.env_spec(Blind())


def test_one_key_or_one_for_each_environment():
    with refuses("key", "[4]", "[3]"):
        rollout(PointMass(), lambda inputs, obs: jnp.zeros((4, 2)), jax.random.split(jax.random.key(0), 3), 4)


@pytest.mark.parametrize("lanes", [0, -3, 1.5, True])
def test_lanes_are_a_number_of_runs(lanes):
    with refuses("lanes", lanes):
        mesh.most_lanes(lanes, ())


@pytest.mark.parametrize(("lanes", "shape"), [(None, (4, 1)), (4, (4, 1)), (8, (4, 1)), (2, (2, 2)), (1, (1, 4))])
def test_a_sweep_has_the_same_layout_for_any_number_of_runs_that_are_left(lanes, shape):
    devices = [SimpleNamespace(platform="gpu")] * 4
    config = dataclasses.replace(SMALL, num_envs=8, batch_size=32, replay_size=400)
    for number in (1, 2, 3, 6):
        specs = [RunSpec(env="point_mass:PointMass", config=config, seed=seed) for seed in range(30, 30 + number)]
        _, layout, _ = program._plan(PointMass(), specs, mesh.most_lanes(lanes, devices), devices, True)
        assert (layout.lanes, layout.shards) == shape, number


@pytest.mark.parametrize(("placed", "episodes"), [({}, 5), ({"devices": 2, "lanes": 1}, 6), ({"devices": 4, "lanes": 2}, 6)])
def test_devices_that_share_a_run_evaluate_as_many_episodes_each(placed, episodes, tmp_path):
    spec = RunSpec(config=Config(eval_episodes=5))
    assert results.Record(tmp_path, placed, spec, [], {}).eval_episodes == episodes


def test_names_and_numbers_of_parts_are_checked_at_once():
    with refuses("generator", "hgg"):
        trainer.make_train(PointMass(), TINY, generator="hgg")
    for name in ("future", "point_mass:soon", samplers.future):
        for argument in ("metric", "kernel", "normalization"):
            with refuses("nonsense"):
                samplers.make(name, **{argument: "nonsense"})
    with refuses("n_step", -3):
        relabel.draw_batches(None, jax.random.key(0), (4,), samplers.future, None, None, n_step=-3)
