"""The shapes and dtypes that the docstrings state, by jaxtyping, with a size of its own for each letter.

Functions are traced, not run. Letters are those of `mjx_dher.types`; T1 is T+1.
"""
# ruff: noqa: F722, F821

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from beartype import beartype
from jax import Array
from jaxtyping import Bool, Float, Float32, Int, Key, TypeCheckError, jaxtyped

from mjx_dher import HParams, priorities, relabel, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.context import Context
from mjx_dher.learners import actors, ddpg
from mjx_dher.networks import Actor, Critic, Networks
from mjx_dher.types import Batch, Episode
from probes import spec_of

E, N, B, T, D, G, A = 11, 3, 5, 7, 13, 2, 4
HP = HParams()
NETWORKS = Networks(Actor(A, (8,)), Critic((8,)))
LEARNER = ddpg.DDPG(spec_of(D, G, A), NETWORKS, NETWORKS)


def shape(*sizes, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(sizes, dtype)


KEY = jax.eval_shape(lambda: jax.random.key(0))
EPISODES = Episode(shape(N, T + 1, D), shape(N, T + 1, G), shape(N, G), shape(N, T, A)).filled()
RING = jax.eval_shape(lambda: replay.init(jax.tree.map(lambda x: shape(*x.shape[1:], dtype=x.dtype), EPISODES), E))
SAMPLE = jax.eval_shape(lambda ring, key: replay.sample(ring, key, B), RING, KEY)
BATCH = Batch(shape(B, D), shape(B, D), shape(B, G), shape(B, A), shape(B), shape(B), shape(B, dtype=jnp.int32), shape(B, G))
typed = jaxtyped(typechecker=beartype)
values = lambda tree: tuple(getattr(tree, field.name) for field in dataclasses.fields(tree))  # noqa: E731
fields = lambda tree: tuple(value for value in values(tree) if value is not None and value is not False)  # noqa: E731

Ends = tuple[Float[Array, "B D"], Float[Array, "B D"], Float[Array, "B A"]]
NewEpisodes = tuple[
    Float[Array, "N T1 D"],
    Float[Array, "N T1 G"],
    Float[Array, "N G"],
    Float[Array, "N T A"],
    Int[Array, "N"],
    Bool[Array, "N"],
]
Stored = tuple[
    Float[Array, "E T1 D"],
    Float[Array, "E T1 G"],
    Float[Array, "E G"],
    Float[Array, "E T A"],
    Int[Array, "E"],
    Bool[Array, "E"],
]
Marks = tuple[Float[Array, "E"], Int[Array, ""], Int[Array, ""]]
Ring = tuple[Stored, Marks]
Sample = tuple[Ends, Float[Array, "B T1 G"], Float[Array, "B G"], *(Int[Array, "B"],) * 3, Bool[Array, "B"]]
Drawn = tuple[
    Float[Array, "B D"],
    Float[Array, "B D"],
    Float[Array, "B G"],
    Float[Array, "B A"],
    *(Float[Array, "B"],) * 2,
    Int[Array, "B"],
    Float[Array, "B G"],
]
Batches = tuple[
    *(Float[Array, "T B D"],) * 2,
    Float[Array, "T B G"],
    Float[Array, "T B A"],
    *(Float[Array, "T B"],) * 2,
    Int[Array, "T B"],
    Float[Array, "T B G"],
]
Rows = tuple[Int[Array, "B"], Int[Array, "E"], Bool[Array, ""]]
Noise = tuple[Float[Array, "T N A"], Bool[Array, "T N"], Float[Array, "T N A"]]


def from_ring(state):
    return fields(state.episodes), (state.priority, state.cursor, state.size)


def to_ring(ring):
    return replay.ReplayState(Episode(*ring[0]), *ring[1])


def from_sample(sample):
    return fields(sample)[:3], *fields(sample)[3:]


def to_sample(sample):
    return replay.Sample(*sample[0], *sample[1:])


# A name stands for one size in all arguments and the result; an argument `like` is there to say which.


@typed
def added(ring: Ring, new: NewEpisodes) -> Ring:
    return from_ring(replay.add(to_ring(ring), Episode(*new), jnp.zeros(N), jnp.ones(N, bool)))


def test_replay():
    @typed
    def sampled(ring: Ring, key: Key[Array, ""], rows: Int[Array, "B"]) -> Sample:
        return from_sample(replay.sample(to_ring(ring), key, B, rows))

    @typed
    def rows(ring: Ring, key: Key[Array, ""], like: Int[Array, "B"]) -> Rows:
        state = to_ring(ring)
        cumulative = replay.cumulative(state)
        return replay.draw_rows(state, key, B, 0.5, cumulative), cumulative.priority, replay.can_sample(state)

    @typed
    def pool(ring: Ring, key: Key[Array, ""], like: Int[Array, "B"]) -> tuple[Float[Array, "B T1 G"], Int[Array, "B"]]:
        return tuple(replay.sample_pool(to_ring(ring), key, B))

    jax.eval_shape(added, from_ring(RING), fields(EPISODES))
    for function in (sampled, rows, pool):
        jax.eval_shape(function, from_ring(RING), KEY, shape(B, dtype=jnp.int32))


@pytest.mark.parametrize("name", COMPONENTS["sampler"])
def test_samplers(name):
    @typed
    def log_weights(achieved: Float[Array, "T1 G"], desired: Float[Array, "G"], step: Int[Array, ""]) -> Float[Array, "T1"]:
        return samplers.make(name).log_weights(achieved, desired, step, HP)

    jax.eval_shape(log_weights, shape(T + 1, G), shape(G), shape(dtype=jnp.int32))


def test_drawing():
    @typed
    def draw(key: Key[Array, ""], weights: Float[Array, "B T1"]) -> tuple[Int[Array, "B"], Float[Array, "B T1"]]:
        return samplers.draw(key, weights), samplers.probabilities(weights)

    jax.eval_shape(draw, KEY, shape(B, T + 1))


def reward(achieved, desired):
    return -jnp.linalg.norm(achieved - desired, axis=-1)


CONTEXT = Context(reward, HP)


@pytest.mark.parametrize("name", ["random", "weighted"])
def test_relabel(name):
    @typed
    def relabelled(ring: Ring, sample: Sample, key: Key[Array, ""]) -> tuple[Drawn, Float[Array, "B G"]]:
        sampler = samplers.make(name)
        drawn = relabel.add_pool(to_ring(ring), to_sample(sample), sampler, key)
        goals = relabel.hindsight_goals(drawn, sampler, HP, key).goals
        return fields(relabel.relabel(drawn, sampler, CONTEXT, key).batch), goals

    @typed
    def weights(episodes: NewEpisodes) -> Float32[Array, "N"]:
        return priorities.weights(priorities.eventful, Episode(*episodes), CONTEXT)

    @typed
    def batches(ring: Ring, key: Key[Array, ""], like: Float[Array, "T B"]) -> Batches:
        state = to_ring(ring)
        args = samplers.make(name), CONTEXT, replay.cumulative(state)
        return fields(relabel.draw_batches(state, key, (T, B), *args))

    jax.eval_shape(relabelled, from_ring(RING), from_sample(SAMPLE), KEY)
    jax.eval_shape(weights, fields(EPISODES))
    jax.eval_shape(batches, from_ring(RING), KEY, shape(T, B))


def assert_alike(before, after):
    """What learning changes keeps its shapes and dtypes."""
    before, after = (jax.tree.map(lambda x: (x.shape, x.dtype), x) for x in (before, after))
    assert before == after


def test_ddpg():
    @typed
    def acted(observation: Float[Array, "*N D"], goal: Float[Array, "*N G"], like: Float[Array, "A"]) -> Float[Array, "*N A"]:
        state = LEARNER.init(jax.random.key(0))
        return LEARNER.act(state, {"observation": observation, "desired_goal": goal, "achieved_goal": goal}, HP)

    @typed
    def noise(key: Key[Array, ""], like: Float[Array, "T N A"]) -> Noise:
        return tuple(LEARNER.noise(key, T, N, HP))

    @typed
    def explored(
        observation: Float[Array, "N D"], goal: Float[Array, "N G"], action: Float[Array, "N A"], random: Bool[Array, "N"]
    ) -> Float[Array, "N A"]:
        obs = {"observation": observation, "desired_goal": goal, "achieved_goal": goal}
        return LEARNER.explore(LEARNER.init(jax.random.key(0)), obs, actors.Noise(action, random, action), HP)

    @typed
    def normalized(observation: Float[Array, "N T1 D"], goal: Float[Array, "B G"], valid: Bool[Array, "N"]) -> None:
        state = LEARNER.init(jax.random.key(0))
        assert_alike(state, LEARNER.update_normalizers(state, observation, goal, HP, valid))

    @typed
    def updated(batch: Drawn) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        state = LEARNER.init(jax.random.key(0))
        following, losses = LEARNER.update(state, Batch(*batch), HP)
        assert_alike(state, LEARNER.update_target(following, HP))
        return tuple(losses.values())

    for lead in ((), (N,), (T, N)):
        jax.eval_shape(acted, shape(*lead, D), shape(*lead, G), shape(A))
    jax.eval_shape(noise, KEY, shape(T, N, A))
    jax.eval_shape(explored, shape(N, D), shape(N, G), shape(N, A), shape(N, dtype=bool))
    jax.eval_shape(normalized, shape(N, T + 1, D), shape(B, G), shape(N, dtype=bool))
    jax.eval_shape(updated, fields(BATCH))


def test_it_would_be_noticed():
    """Goals where observations belong, actions of another number of episodes, and a result of another size."""
    observation, goal, desired, action, *more = fields(EPISODES)
    for wrong in ((goal, observation, desired, action, *more), (observation, goal, desired, shape(N + 1, T, A), *more)):
        with pytest.raises(TypeCheckError):
            jax.eval_shape(added, from_ring(RING), wrong)

    @typed
    def cut(rows: Int[Array, "B"]) -> tuple[Int[Array, "B"], Int[Array, "B"]]:
        return rows, rows[1:]

    with pytest.raises(TypeCheckError):
        jax.eval_shape(cut, shape(B, dtype=jnp.int32))
