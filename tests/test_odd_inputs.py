"""Keys of other generators and for resets, NumPy's numbers, and padded episodes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from trap import Trap

from mjx_dher import HParams, learners
from mjx_dher.config import Config
from mjx_dher.envs import wrappers
from mjx_dher.testing import check_sampler
from point_mass import PointMass
from probes import spec_of


@pytest.mark.parametrize("name", ["sac", "crl"])
def test_a_learner_takes_keys_of_any_generator(name):
    learner = learners.make(name, Config(hidden_sizes=(4,)), spec_of(2, 2, 2))
    states = {kind: jax.jit(learner.init)(jax.random.key(0, impl=kind)) for kind in ("rbg", "unsafe_rbg", "threefry2x32")}
    assert {(state.key.shape, str(state.key.dtype)) for state in states.values()} == {((2,), "uint32")}
    assert len({bytes(np.asarray(state.key)) for state in states.values()}) >= 2
    again = jax.jit(learner.init)(jax.random.key(1, impl="rbg"))
    assert not np.array_equal(again.key, states["rbg"].key)
    assert np.array_equal(states["threefry2x32"].key, jax.random.key_data(jax.random.split(jax.random.key(0), 3)[2]))


def test_numbers_of_numpy_are_numbers():
    env = PointMass()
    assert wrappers.FrameStack(env, np.int64(2)).reset(jax.random.key(0)).obs["observation"].shape[0] >= 4
    wrappers.ActionFilter(env, np.float32(0.5))
    with refuses("True"):
        wrappers.ActionFilter(env, np.bool_(True))


def test_new_networks_have_a_key_of_their_own():
    """The update after a reset makes its keys of the same number."""
    learner = learners.make("sac", Config(hidden_sizes=(4,), reset_every=40), spec_of(2, 2, 2))
    state = dataclasses.replace(jax.jit(learner.init)(jax.random.key(0)), num_updates=jnp.int32(40))
    after = jax.jit(lambda state: learner.update_normalizers(state, jnp.ones((3, 2, 2)), jnp.ones((5, 2)), HParams()))(state)
    of_update = jax.jit(learner.init)(jax.random.fold_in(jax.random.wrap_key_data(state.key), 40))
    actor, other, first = (of.params.actor["network"]["params"]["Dense_0"]["kernel"] for of in (after, of_update, state))
    assert not np.array_equal(actor, first)
    assert not np.array_equal(actor, other)


def test_goals_after_an_early_end_are_not_of_the_past():
    assert "goals of the past never" in check_sampler("final", Trap())
