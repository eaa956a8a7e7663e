"""Nothing is promoted unasked: arrays of another rank or dtype meet only where the code says so.

JAX decides that while it traces, so tracing is enough, and quick.
"""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from configs import SMALL

from mjx_dher import envs, make_train, priorities, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.contrib import generators
from mjx_dher.learners import common
from mjx_dher.runs.loop import state_template
from mjx_dher.runs.program import Lane
from point_mass import PointMass
from probes import Explodes


@pytest.fixture(autouse=True)
def strict(monkeypatch):
    """Optax's own arithmetic is exempt: Adam raises a float to the power of its count."""
    adam = common.adam

    def as_ever(*numbers):
        def update(*args):
            with jax.numpy_dtype_promotion("standard"):
                return adam(*numbers).update(*args)

        return adam(*numbers)._replace(update=update)

    monkeypatch.setattr(common, "adam", as_ever)
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


def test_it_would_be_noticed():
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.zeros((2, 3)) + jnp.zeros(3)
    with pytest.raises(ValueError, match="no available implicit dtype promotion"):
        jnp.zeros(3) + jnp.zeros(3, jnp.int32)


@pytest.mark.parametrize(("sampler", "dtype"), [("future", "float32"), ("random", "bfloat16")])
def test_an_epoch_in_which_physics_may_blow_up(sampler, dtype):
    config = dataclasses.replace(SMALL, learner_dtype=dtype)
    program = make_train(Explodes(None), config, sampler=samplers.make(sampler))
    jax.eval_shape(program.epoch, state_template(program))


def test_an_epoch_with_a_priority_of_one_s_own():
    def by_hand(episode, context):
        distance = jnp.linalg.norm(episode.achieved_goal[-1] - episode.achieved_goal[0])
        missed = context.compute_reward(episode.achieved_goal[-1], episode.desired_goal) < 0
        return jnp.where(missed, distance, context.hparams.epsilon)

    program = make_train(PointMass(), SMALL, priority=by_hand)
    jax.eval_shape(program.epoch, state_template(program))


def test_an_epoch_with_every_sampler_and_kernel_as_a_sweep_has_them():
    every = [
        *(samplers.make(name) for name in COMPONENTS["sampler"]),
        *(samplers.make("weighted", k) for k in COMPONENTS["weight_kernel"]),
    ]
    every += [samplers.make("weighted", normalization=n) for n in COMPONENTS["weight_normalization"]]
    program = make_train(PointMass(), SMALL, sampler=samplers.join(every))
    lanes = Lane(*(jnp.zeros(3) for _ in Lane._fields))
    states = jax.eval_shape(jax.vmap(program.init), jax.random.split(jax.random.key(0), 3), lanes)
    jax.eval_shape(jax.vmap(program.epoch), states)


@pytest.mark.parametrize("group", ["episodes", "transitions"])
def test_an_epoch_with_every_priority_and_generator_as_a_sweep_has_them(group):
    names = [name for name, row in COMPONENTS["priority"].items() if row.group == group]
    weighted = [samplers.make("weighted", metric=name) for name in COMPONENTS["metric"]]
    program = make_train(
        PointMass(),
        SMALL,
        sampler=samplers.join([samplers.make("random"), *weighted]),
        priority=priorities.join([priorities.make(name) for name in names]),
        generator=generators.join([generators.make(name) for name in COMPONENTS["generator"]]),
    )
    lanes = Lane(*(jnp.zeros(3) for _ in Lane._fields))
    states = jax.eval_shape(jax.vmap(program.init), jax.random.split(jax.random.key(0), 3), lanes)
    jax.eval_shape(jax.vmap(program.epoch), states)


def test_replay_drawn_from_without_rows():
    program = make_train(PointMass(), SMALL)
    ring = state_template(program).replay
    jax.eval_shape(lambda ring, key: replay.sample(ring, key, 5), ring, jax.random.key(0))


@pytest.mark.parametrize(
    "name",
    ["pick_and_place", "push", "reach", "slide", "block", "pen_rotate", pytest.param("hand_reach", marks=pytest.mark.slow)],
)
def test_the_tasks(name):
    env = envs.make(name, engine="native")
    states = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 2))
    jax.eval_shape(jax.vmap(env.step), states, jax.ShapeDtypeStruct((2, env.action_size), jnp.float32))
