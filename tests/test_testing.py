import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from flax import struct

from mjx_dher import envs
from mjx_dher.testing import ComponentError, check_env
from mjx_dher.types import Array, EnvSpec, GoalObs
from point_mass import PointMass, PointState
from probes import Explodes


class Quick(PointMass):
    """PointMass whose starts are compiled in no time: many are, below."""

    def reset(self, key):
        start, goal = 0.4 * jnp.sin(jnp.outer(jnp.array([1.0, 2.0]), jax.random.key_data(key).astype(jnp.float32)))
        return self._state(start, goal)


@pytest.mark.parametrize("env", [PointMass(episode_length=1), Explodes(None)])
def test_what_is_as_it_should_be_passes(env):
    check_env(env)


@pytest.mark.slow
@pytest.mark.parametrize("env", envs.list_envs())
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_the_tasks_pass(env, reward_type):
    check_env(envs.make(env, reward_type=reward_type))


def test_what_an_environment_checks_itself_is_asked_last():
    class Checked(Quick):
        def check(self):
            raise ValueError("contacts were lost")

    with pytest.raises(ValueError, match="contacts were lost"):
        check_env(Checked())


def broken(**members):
    """Quick with other members; functions are its methods."""
    return type("Broken", (Quick,), members)()


def with_obs(name, change):
    """Quick whose obs[name] is changed."""

    def state(self, position, goal):
        right = PointMass._state(self, position, goal)
        return right.replace(obs={**right.obs, name: change(right.obs[name])})

    return broken(_state=state)


def with_state(**changes):
    """Quick whose states have fields changed by functions of the state."""

    def state(self, position, goal):
        right = PointMass._state(self, position, goal)
        return right.replace(**{name: change(right) for name, change in changes.items()})

    return broken(_state=state)


class Plain:
    """A state that JAX does not know as a pytree."""

    def __init__(self, state):
        self.obs, self.reward, self.success = state.obs, state.reward, state.success


@struct.dataclass
class Counting(PointState):
    count: Array


@struct.dataclass
class NoReward:
    obs: GoalObs
    success: Array


def counting(first, later):
    """Counts steps, from `first`; `later(count)` is the next count."""

    def reset(self, key):
        state = Quick.reset(self, key)
        return Counting(state.obs, state.reward, state.success, first)

    def step(self, state, action):
        following = PointMass.step(self, state, action)
        return Counting(following.obs, following.reward, following.success, later(state.count))

    return broken(reset=reset, step=step)


def growing(self, state, action):
    following = PointMass.step(self, state, action)
    return Counting(following.obs, following.reward, following.success, jnp.zeros(()))


def mutating(self, state, action):
    following = PointMass.step(self, state, action)
    state.obs["achieved_goal"] = following.obs["achieved_goal"]
    return following


def branching(self, state, action):
    return PointMass.step(self, state, action if action[0] > 0 else -action)


def drifting():
    """Its steps depend on how many there have been, which no state says."""
    calls = itertools.count()
    return broken(step=lambda self, state, action: PointMass.step(self, state, action + 0.1 * next(calls)))


def forgetful():
    """Its starts depend on how many there have been."""
    calls = itertools.count()
    return broken(reset=lambda self, key: Quick.reset(self, jax.random.fold_in(key, next(calls))))


def mixing(self, state, action):
    """A callback that is handed the whole batch, and mixes it."""

    def centre(actions):
        return np.asarray(actions) - (np.mean(actions, axis=0) if np.ndim(actions) > 1 else 0)

    centred = jax.pure_callback(centre, jax.ShapeDtypeStruct(action.shape, action.dtype), action, vmap_method="broadcast_all")
    return PointMass.step(self, state, centred)


def unclipped(self, state, action):
    """NaN where an action is out of bounds."""
    following = PointMass.step(self, state, action)
    obs = following.obs
    return following.replace(obs={**obs, "observation": obs["observation"] + jnp.where(jnp.abs(action) > 1, jnp.nan, 0.0)})


def diverging(self, state, action):
    """NaN from the third step on."""
    following = PointMass.step(self, state, action)
    obs = following.obs
    far = jnp.abs(obs["achieved_goal"]).max() > 0.45
    return following.replace(obs={**obs, "observation": jnp.where(far, jnp.nan, obs["observation"])})


def new_goal(self, state, action):
    following = PointMass.step(self, state, action)
    return self._state(following.obs["achieved_goal"], following.obs["desired_goal"] + 0.01)


def late_reward(self, state, action):
    """The reward of the state that the step left."""
    return PointMass.step(self, state, action).replace(reward=state.reward)


def over_all(self, achieved_goal, desired_goal):
    """Forgets that there may be leading axes."""
    return -(jnp.linalg.norm(achieved_goal - desired_goal) > 0.1).astype(jnp.float32)


def over_the_batch(self, achieved_goal, desired_goal):
    distance = jnp.linalg.norm(achieved_goal - desired_goal, axis=-1)
    return -jnp.minimum(distance / jnp.maximum(1.0, jnp.max(distance)), 1.0) - 0.01 * (distance.size > 1)


def inverted(self, achieved_goal, desired_goal):
    return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) < 0.1).astype(jnp.float32)


def shifted(self, achieved_goal, desired_goal):
    return PointMass.compute_reward(self, achieved_goal, desired_goal) + 1.0


def rare(self, achieved_goal, desired_goal):
    """1 at the goal, as in other libraries: random actions never see it."""
    return (jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) < 1e-6).astype(jnp.float32)


def dense(self, achieved_goal, desired_goal):
    return -10.0 * jnp.linalg.norm(achieved_goal - desired_goal, axis=-1)


def log_distance(self, achieved_goal, desired_goal):
    """Finite wherever random actions come."""
    return -jnp.log(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1)) / 1e3 - 0.5


def counted():
    calls = itertools.count()
    return lambda self, achieved, desired: PointMass.compute_reward(self, achieved, desired) * (1 - 0.01 * next(calls))


def angle(self, achieved_goal, desired_goal):
    """Rounding takes the cosine of equal goals beyond 1."""
    cosine = jnp.sum(achieved_goal * desired_goal, axis=-1) / jnp.sum(jnp.square(desired_goal), axis=-1)
    return jnp.arccos(1.0000001 * cosine)


def away(self, state, goal):
    return self._state(goal, goal)


def whole_numbers(self, achieved_goal, desired_goal):
    return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.1).astype(jnp.int32)


BROKEN = {
    "no actions": (broken(action_size=0), "action_size .* at least 1.* 0"),
    "no length": (broken(__init__=lambda self: None), "episode_length .* at least 1.* None"),
    "no reward function": (broken(compute_reward=None), "has no compute_reward"),
    "reset fails": (broken(reset=lambda self, key: jnp.zeros(2) + jnp.zeros(3)), "reset raises TypeError: "),
    "no pytree": (broken(reset=lambda self, key: Plain(Quick.reset(self, key))), "reset raises TypeError: .*Plain"),
    "a name in the state": (counting("first", lambda count: count), r"reset raises TypeError: .*\.count"),
    "no reward": (
        broken(_state=lambda self, position, goal: NoReward(PointMass._state(self, position, goal).obs, jnp.zeros(()))),
        "reset .* obs, reward and success.* no reward",
    ),
    "no achieved goal": (
        with_state(obs=lambda state: {name: x for name, x in state.obs.items() if name != "achieved_goal"}),
        "obs .* no achieved_goal",
    ),
    "whole numbers": (with_obs("observation", lambda x: x.astype(jnp.int32)), "observation .* float32.* int32"),
    "two kinds of goal": (with_obs("desired_goal", lambda x: x[:1]), r"achieved_goal and desired_goal .* \(2,\) and \(1,\)"),
    "a row of rewards": (with_state(reward=lambda s: s.reward[None]), r"reward .* scalar, \[\].* \(1,\)"),
    "success is bool": (with_state(success=lambda s: s.success > 0), "success .* float32.* bool"),
    "success of 2": (with_state(success=lambda s: s.success + 2), "success .* 0 or 1.*2"),
    "NaN at once": (with_obs("observation", lambda x: x * jnp.nan), "observation .* finite.* after 0 steps"),
    "changes the state": (broken(step=mutating), "step .* state unchanged"),
    "branches": (broken(step=branching), "episode, traced by jax.jit, raises TracerBoolConversionError"),
    "grows": (broken(step=growing), r"step must keep structure, shapes and types; .*\.count is absent"),
    "changes its type": (
        counting(jnp.zeros((), jnp.int32), lambda count: count + 1.0),
        r"step .* \.count .* int32\[\] .* float32\[\]",
    ),
    "hidden start": (forgetful(), "reset and step, called twice .* same result; reset: "),
    "hidden step": (drifting(), "reset and step, called twice .* same result; step: "),
    "NaN later": (broken(step=diverging), "observation .* finite.* `failed`.* after [1-9]"),
    "always fails": (Explodes(None, edge=-1.0), "every episode .* `failed`"),
    "one start": (broken(reset=lambda self, key: Quick.reset(self, jax.random.key(0))), "8 keys gave the same"),
    "moving goal": (broken(step=new_goal), "desired_goal .* constant .* step 1"),
    "mixes the batch": (broken(step=mixing), "step, alone and under jax.vmap, .* same result; step: .* differs by"),
    "wants what is in bounds": (broken(step=unclipped), r"step with an action of \+-3: observation must be finite"),
    "reward of all goals": (broken(compute_reward=over_all), r"compute_reward of goals \[3, 2\] .* \[3\].* float32\[\]"),
    "reward of whole numbers": (broken(compute_reward=whole_numbers), "compute_reward .* floats.* int32"),
    "reward of the batch": (broken(compute_reward=over_the_batch), "compute_reward .* depends on the others"),
    "late reward": (broken(step=late_reward), r"step .* compute_reward\(achieved_goal, desired_goal\)"),
    "reward of 1": (broken(compute_reward=shifted), r"rewards .* \[-1, 0\].* 0 to 1"),
    "reward of 1 that is never seen": (
        broken(compute_reward=rare),
        r"rewards .* reward_range \[-1, 0\]; .* 0 to 1: .* reward_range=\(0, 1\)",
    ),
    "reward of metres times 10": (broken(compute_reward=dense), "rewards .* to 0: .* reward_range=.* or scale the reward"),
    "reward of what is never reached": (
        broken(compute_reward=lambda self, a, d: -jnp.ones(a.shape[:-1])),
        "sparse reward .* 0 ",
    ),
    "reward that is infinite at the goal": (broken(compute_reward=log_distance), r"rewards .* to inf"),
    "reward that differs from trace to trace": (broken(compute_reward=counted()), "called twice .* same .* reward"),
    "goal that is never reached": (broken(reached=lambda self, a, d: a[..., 0] > 9), "reached must be True"),
    "distance of NaN": (broken(goal_distance=angle), "goal_distance must be finite"),
    "goals that are not kept": (broken(with_goal=lambda self, state, goal: state), "with_goal, .* desired_goal differs"),
    "goals that move": (broken(with_goal=away), "with_goal, .* alone, .* differs"),
    "inverted": (broken(compute_reward=inverted), "compute_reward .* greatest .* achieved exactly"),
    "always a success": (with_state(success=lambda s: jnp.ones(())), "success .* 0 .* sparse reward .* -1"),
    "never a success": (with_state(success=lambda s: jnp.zeros(())), "success .* 1 .* never"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_one_thing_wrong_is_named(name):
    env, message = BROKEN[name]
    with pytest.raises(ComponentError, match=message):
        check_env(env)


# The contract as data


@struct.dataclass
class Ending(PointState):
    done: Array


def contract(edge=0.45, flagged=True, members=None, **fields):
    """Quick with a spec; an episode ends beyond `edge`, if states are `flagged`."""

    def state(self, position, goal):
        right = PointMass._state(self, position, goal)
        right = right.replace(success=(right.reward == self.spec.reward_range[1]).astype(jnp.float32))
        done = jnp.abs(position).max() > edge
        return Ending(right.obs, right.reward, right.success, done) if flagged else right

    observation = jax.ShapeDtypeStruct((2,), jnp.float32)
    sizes = {"observation": observation, "goal_size": 2, "action_size": 2, "episode_length": 10}
    return broken(_state=state, spec=EnvSpec(**{**sizes, **fields}), **(members or {}))


def as_dict(self, position, goal):
    right = PointMass._state(self, position, goal)
    return right.replace(obs={**right.obs, "observation": {"position": position, "image": jnp.zeros((4, 4), jnp.uint8)}})


@pytest.mark.parametrize(
    "env",
    [
        contract(ends=True),
        contract(flagged=False, reward_range=(0.0, 1.0), members={"compute_reward": shifted}),
        broken(_state=as_dict),
    ],
)
def test_episodes_may_end_rewards_have_any_range_and_observations_are_trees(env):
    check_env(env)


@pytest.mark.parametrize(
    ("env", "parts"),
    [
        (contract(), ["ends", "done"]),
        (contract(ends=True, edge=-1.0), ["reset", "done", "one step"]),
        (contract(flagged=False, ends=True), ["ends"]),
        (contract(flagged=False, goal_size=3), ["goal_size", 3, 2]),
        (contract(flagged=False, reward_range=(0.0, 1.0)), ["rewards", "[0, 1]", "-1"]),
        (broken(reached=lambda self, a, d: jnp.zeros(a.shape[:-1])), ["reached", "booleans", "float32[]"]),
        (broken(goal_distance=lambda self, a, d: a - d), ["goal_distance", "float32[2]"]),
        (with_obs("observation", lambda x: {"grid": x.astype(jnp.int32)}), ["observation['grid']", "uint8", "int32"]),
    ],
)
def test_a_contract_that_is_broken_is_named(env, parts):
    with refuses(*parts, error=ComponentError):
        check_env(env)
