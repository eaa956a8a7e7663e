"""Observations that are trees: encoders, concatenation, and what is rejected."""

import dataclasses
import functools
import sys
import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import Config, HParams, RunSpec, learners, make_train, networks, testing, trainer
from mjx_dher.contract import env_spec
from mjx_dher.policy import learner_policy
from mjx_dher.policy.load import check_fits
from mjx_dher.runs.loop import state_template
from mjx_dher.types import Batch
from point_mass import PointMass
from probes import spec_of

TASK = spec_of(2, 2, 2)
SMALL = Config(hidden_sizes=(16, 16), batch_size=8, num_quantiles=5, dropped_quantiles=1)
HP = HParams(gamma=0.9)
IMAGES = dataclasses.replace(
    TASK,
    observation={
        "image": jax.ShapeDtypeStruct((4, 4, 1), jnp.uint8),
        "vector": jax.ShapeDtypeStruct((3,), jnp.float32),
    },
)


class Pixels(nn.Module):
    """Encodes an image and a vector, with parameters of its own."""

    @nn.compact
    def __call__(self, observation):
        image = observation["image"].astype(jnp.float32) / 255.0
        pixels = nn.Dense(5)(image.reshape(*image.shape[:-3], -1))
        return jnp.concatenate([pixels, observation["vector"]], axis=-1)


def seeing(action_size, hidden_sizes, dtype="float32", heads=networks.PLAIN):
    return networks.mlp(action_size, hidden_sizes, dtype, heads)._replace(encoder=Pixels())


def random_tree(key, *leading):
    image = jax.random.randint(key, (*leading, 4, 4, 1), 0, 256).astype(jnp.uint8)
    return {"image": image, "vector": 3.0 + jax.random.normal(key, (*leading, 3))}


@pytest.mark.parametrize("name", ["ddpg", "tqc", pytest.param("sac", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_an_encoder_takes_a_tree_of_observations(name):
    """Both networks learn their own encoder; float leaves are normalized and images are not."""
    learner = learners.make(name, SMALL, IMAGES, seeing)
    key, ones = jax.random.key(0), jnp.ones((8, 2))
    hparams = trainer.as_arrays(HP)
    state = learner.update_normalizers(learner.init(key), random_tree(key, 4, 6), ones, hparams, jnp.arange(4) > 0)
    assert state.observation_norm["image"] is None
    np.testing.assert_allclose(state.observation_norm["vector"].mean, 3.0, atol=1.0)
    reward = -jnp.ones(8)
    batch = Batch(random_tree(key, 8), random_tree(key, 8), ones, ones, reward, discount=0.9 * jnp.ones(8), row=jnp.arange(8))
    after, _ = jax.jit(learner.update)(state, batch, hparams)
    for network in ("actor", "critic"):
        before_and_after = [jax.tree.leaves(getattr(x.params, network)) for x in (state, after)]
        assert all(bool(jnp.any(a != b)) for a, b in zip(*before_and_after) if a.ndim > 1), network
    obs = {"observation": random_tree(key, 8), "achieved_goal": ones, "desired_goal": ones}
    actions = learner.act(after, obs, hparams)
    assert actions.shape == (8, 2)
    one = learner.act(after, jax.tree.map(lambda x: x[3], obs), hparams)
    np.testing.assert_allclose(one, actions[3], rtol=1e-5, atol=1e-6)
    darker = obs | {"observation": obs["observation"] | {"image": obs["observation"]["image"] // 2}}
    assert float(jnp.abs(learner.act(after, darker, hparams) - actions).max()) > 1e-4
    pairs = jax.tree.map(lambda x: jnp.stack([x, x]), obs)
    assert learner.value(after, pairs, jnp.ones((2, 8, 2)), hparams).shape == (2, 8)
    assert learner.export(after, hparams) is None


def test_a_tree_of_vectors_needs_no_encoder():
    """It is learned from as the vector that its leaves make, in the tree's order."""
    tree = dataclasses.replace(TASK, observation={"b": TASK.observation, "a": jax.ShapeDtypeStruct((1,), jnp.float32)})
    vector = dataclasses.replace(TASK, observation=jax.ShapeDtypeStruct((3,), jnp.float32))
    of_tree, of_vector = (learners.make("ddpg", SMALL, spec) for spec in (tree, vector))
    key, goal, hparams = jax.random.key(0), jnp.ones((8, 2)), trainer.as_arrays(HP)
    x = jax.random.normal(key, (8, 3)) + 1.0

    def learned(learner, observation):
        state = learner.update_normalizers(learner.init(key), observation, goal, hparams)
        batch = Batch(observation, observation, goal, goal, -jnp.ones(8), discount=0.9 * jnp.ones(8), row=jnp.arange(8))
        return learner.update(state, batch, hparams)[0].params

    parts = {"a": x[:, :1], "b": x[:, 1:]}
    results = (jax.jit(functools.partial(learned, learner))(seen) for learner, seen in ((of_tree, parts), (of_vector, x)))
    jax.tree.map(np.testing.assert_array_equal, *results)


class Camera(PointMass):
    """PointMass that is seen as a bright pixel, beside its position."""

    def _state(self, position, goal):
        state = super()._state(position, goal)
        cell = jnp.clip((position + 0.5) * 4.0, 0.0, 3.0).astype(jnp.int32)
        image = jnp.zeros((4, 4, 1), jnp.uint8).at[cell[0], cell[1]].set(255)
        vector = jnp.concatenate([position, jnp.ones(1)])
        return state.replace(obs={**state.obs, "observation": {"image": image, "vector": vector}})


@pytest.mark.slow
def test_dicts_with_images_are_trained_on(tmp_path, monkeypatch):
    """From the rollout to the stored policy, which acts as the learner does."""
    monkeypatch.setitem(sys.modules, "mine", types.SimpleNamespace(networks=seeing))
    env, config = Camera(), dataclasses.replace(SMALL, num_envs=4, eval_episodes=2, updates_per_cycle=2, target_period=1)
    spec = env_spec(env)
    assert spec.sizes == ({"image": (4, 4, 1), "vector": 3}, 2, 2)
    learner = learners.make("ddpg", config, spec, "mine:networks")
    program = make_train(env, config, learner=learner)
    jax.eval_shape(program.epoch, state_template(program))
    testing.check_learner("ddpg", env, config, networks=seeing)
    state = learner.init(jax.random.key(0))
    learner_policy.LearnerPolicy(learner, state, HP, spec).save(tmp_path / "policy.npz")
    with np.load(tmp_path / "policy.npz") as arrays:
        run = RunSpec(learner="ddpg", networks="mine:networks", config=config, hparams=HP)
        policy = learner_policy.from_arrays(arrays, run)
    assert policy.spec == spec
    check_fits(policy, env)
    with pytest.raises(ValueError, match="observations of"):
        check_fits(policy, PointMass())
    obs = {"observation": jax.device_get(random_tree(jax.random.key(1), 5)), "desired_goal": np.ones((5, 2), np.float32)}
    np.testing.assert_allclose(policy(obs), learner.act(state, obs, HP), rtol=1e-5, atol=1e-6)
    seen = obs["observation"]
    for wrong, parts in (
        ({"observation": seen}, ["desired_goal"]),
        ({**obs, "observation": {"image": seen["image"]}}, ["observation", "structure"]),
        ({**obs, "observation": {**seen, "vector": seen["vector"][:, :2]}}, ["observation", "(5, 2)"]),
        ({**obs, "desired_goal": np.full((5, 2), np.nan)}, ["desired_goal", "finite"]),
        ({**obs, "desired_goal": np.ones((4, 2))}, ["batch", "(4,)"]),
    ):
        with refuses(*parts):
            policy(wrong)


def test_only_dicts_lists_and_tuples_can_be_stored():
    nested = dataclasses.replace(
        TASK, observation=({"b": [TASK.observation], "a": TASK.observation},), reward_range=(-np.inf, 1.0)
    )
    assert learner_policy.from_json(learner_policy.to_json(nested)) == nested
    with pytest.raises(ValueError, match="observation must consist of dicts"):
        learner_policy.to_json(dataclasses.replace(TASK, observation=networks.Networks(TASK.observation, TASK.observation)))


def test_images_need_an_encoder():
    for name in ("ddpg", "td3"):
        with pytest.raises(ValueError, match=r"observation\['image'\] .* uint8\[4, 4, 1\] .*encoder"):
            learners.make(name, SMALL, IMAGES)


def test_networks_are_an_object_of_their_class():
    with refuses("networks", "Networks", "namespace"):
        networks.with_encoder(types.SimpleNamespace(encoder=None, actor=None, critic=None))
