"""`from_brax`: with a stand-in that has Brax's interface; with the originals, in a slow test, where they are there."""

import dataclasses
import os
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from flax import struct

from mjx_dher.contract import env_spec
from mjx_dher.envs.brax import from_brax
from mjx_dher.system.machine import user_cache
from mjx_dher.testing import check_env
from mjx_dher.tools import transfer

ROOT = Path(__file__).parents[1]


@struct.dataclass
class State:
    pipeline_state: Any
    obs: Any
    reward: Any
    done: Any
    metrics: dict = struct.field(default_factory=dict)
    info: dict = struct.field(default_factory=dict)


class Line:
    """A point on a line, with the habits of Brax's environments: it is done beyond 1, and draws another goal at each step."""

    action_size, dt = 1, 0.1

    def reset(self, rng):
        start, goal = jax.random.uniform(rng, (2, 1), minval=-0.5, maxval=0.5)
        return State(start, jnp.concatenate([start, goal]), 0, 0.0, {"distance": 0.0}, {"goal": goal, "steps": 0})

    def step(self, state, action):
        place = state.pipeline_state + 0.4 * action
        goal = state.info["goal"] + 0.01
        state.metrics.update(distance=jnp.abs(place - goal)[0])  # of its argument
        done = jnp.any(jnp.abs(place) > 1.0).astype(jnp.float32)
        obs, info = jnp.concatenate([place, goal]), {"goal": goal, "steps": state.info["steps"] + 1}
        return state.replace(pipeline_state=place, obs=obs, reward=1.0, done=done, info=info)


def make(env=None, **options):
    options = {"observe": lambda state: state.obs[:1], "threshold": 0.25, "episode_length": 5, **options}
    return from_brax(env or Line(), lambda state: state.pipeline_state, lambda state: state.info["goal"], **options)


@pytest.mark.parametrize("ends", [False, True])
def test_it_keeps_the_contract(ends):
    env = make(ends=ends)
    spec = env_spec(env)
    assert (spec.sizes, spec.ends, env.name, env.dt) == ((1, 1, 1), ends, "Line", 0.1)
    check_env(env)


def test_goals_rewards_and_ends():
    env, ending = make(), make(ends=True, distance=lambda a, b: jnp.abs(a[..., 0] - b[..., 0]) / 10.0)
    last = ending.reset(jax.random.key(1))
    start = np.float64(last.inner.obs[0])
    assert last.obs["desired_goal"] == last.inner.obs[1]
    goal = start + 0.3
    first = env.with_goal(env.reset(jax.random.key(1)), jnp.array([goal]))
    near = env.step(first, jnp.array([0.25]))
    assert (first.success, near.reward, near.success) == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(near.obs["achieved_goal"], goal - 0.2, atol=1e-6)
    assert near.obs["desired_goal"] == first.obs["desired_goal"]  # the first one of the episode
    assert env.with_goal(first, jnp.array([start])).success == 1.0
    with refuses("(2,)", "(1,)"):
        env.with_goal(first, jnp.zeros(2))
    rewards = env.compute_reward(jnp.zeros((2, 3, 1)), jnp.array([0.2, 0.3, jnp.nan])[:, None])
    np.testing.assert_array_equal(rewards, np.tile([0.0, -1.0, -1.0], (2, 1)))
    assert last.success == 1.0  # of a tenth of the distance
    for _ in range(4):
        near, last = env.step(near, jnp.array([-9.0])), ending.step(last, jnp.array([-9.0]))
    np.testing.assert_allclose(near.obs["achieved_goal"], goal - 0.2 - 1.6, atol=1e-6)  # the action is clipped
    assert near.failed
    assert not hasattr(near, "terminal")
    assert last.terminal
    assert not last.failed
    back = env.step(env.step(env.step(near, jnp.ones(1)), jnp.ones(1)), jnp.ones(1))
    assert back.failed  # until the next reset
    assert not back.inner.done


class AutoResetWrapper:
    def __init__(self, env):
        self.env = env


@dataclasses.dataclass
class EvalWrapper:
    env: Any


def test_an_observation_may_be_a_tree():
    parts = {"place": lambda state: state.pipeline_state, "picture": lambda state: jnp.zeros((2, 2), jnp.uint8)}
    spec = env_spec(make(observe=lambda state: {name: part(state) for name, part in parts.items()}))
    assert {name: (leaf.shape, leaf.dtype) for name, leaf in spec.observation.items()} == {
        "place": ((1,), jnp.float32),
        "picture": ((2, 2), jnp.uint8),
    }


def test_bad_arguments_are_refused():
    own = Line()
    own.env = own
    make(own)  # which is not followed for ever
    with refuses("AutoResetWrapper"):
        make(EvalWrapper(AutoResetWrapper(Line())))
    for options, names in (({"threshold": 0.0}, "threshold"), ({"episode_length": 1.5}, "episode_length")):
        with refuses(names, str(options[names])):
            make(**options)
    with refuses("achieved and goal must return vectors [G]", "()"):
        from_brax(Line(), lambda s: s.obs[0], lambda s: s.obs[1], 0.1, 5).reset(jax.random.key(0))
    with refuses("(2,)", "(1,)"):
        make().step(make().reset(jax.random.key(0)), jnp.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brax_reacher", "jaxgcrl_reacher", "playground_reacher"])
def test_the_originals(name):
    """Where their environment is there: `bench/peer_envs.py` says how to make it."""
    python = transfer.interpreter(user_cache() / "peer_envs")
    if not python.is_file():
        pytest.skip("no environment with Brax, MuJoCo Playground and JaxGCRL")
    command = [python, "train.py", "check", "--env", f"bench.peer_envs:{name}"]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
