"""What `check` finds beyond shapes: observations that have the desired goal, which relabelling would leave as it is, and a
description for policy files that JSON cannot hold.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from flax import struct

from mjx_dher.testing import check_env
from mjx_dher.testing.trial import ComponentError
from point_mass import PointMass


class Seen(PointMass):
    """Its observation has the way to the goal, which relabelling would leave as it is."""

    observation_size = 4
    with_goal = None

    def reset(self, key):
        return self._seen(super().reset(key))

    def step(self, state, action):
        return self._seen(super().step(state.replace(obs={**state.obs, "observation": state.obs["achieved_goal"]}), action))

    def _seen(self, state):
        way = state.obs["desired_goal"] - state.obs["achieved_goal"]
        return state.replace(obs={**state.obs, "observation": jnp.concatenate([state.obs["achieved_goal"], way])})


class NoGoal(PointMass):
    with_goal = None


def test_an_observation_that_has_the_goal_is_named():
    check_env(NoGoal())
    with refuses("observation", "must not depend on the desired goal", error=ComponentError):
        check_env(Seen())


@struct.dataclass
class Kept:
    inner: Any
    obs: Any
    reward: Any
    success: Any


class KeepsGoal(NoGoal):
    """Its state keeps the goal beside `obs`, and its observation has `part` of the goals."""

    observation_size = 4

    def __init__(self, part):
        super().__init__(10)
        self.part = part

    def reset(self, key):
        return self._kept(super().reset(key))

    def step(self, state, action):
        return self._kept(super().step(state.inner, action))

    def _kept(self, inner):
        seen = [inner.obs["observation"], self.part(inner.obs["achieved_goal"], inner.obs["desired_goal"])]
        return Kept(inner, {**inner.obs, "observation": jnp.concatenate(seen)}, inner.reward, inner.success)


@pytest.mark.parametrize(
    ("part", "named"),
    [
        (lambda achieved, desired: desired, "desired_goal"),
        (lambda achieved, desired: desired - achieved, "desired_goal - achieved_goal"),
        (lambda achieved, desired: achieved - desired, "achieved_goal - desired_goal"),
    ],
)
def test_a_goal_that_the_state_keeps_and_the_observation_has_is_named(part, named):
    with refuses(f"observation[2:4] must not be {named},", error=ComponentError):
        check_env(KeepsGoal(part))


@pytest.mark.parametrize(
    ("described", "named"),
    [({"offset": np.zeros(3)}, "ndarray"), ({"gain": math.nan}, "JSON"), (property(lambda self: 1 / 0), "zero")],
)
def test_a_description_that_json_cannot_hold_is_named_before_training(described, named):
    with refuses("describe", named, error=ComponentError):
        check_env(type("Described", (PointMass,), {"robot_interface": described})())
