"""Goal generators, priorities of transitions and learned distances in the training loop, and what of own ones is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SMALL

from mjx_dher import HParams, RunSpec, learners, make_train, priorities, replay, samplers, testing
from mjx_dher.components import COMPONENTS
from mjx_dher.context import Context
from mjx_dher.contract import env_spec
from mjx_dher.contrib import generators, goals
from mjx_dher.priorities import Priority
from mjx_dher.rollout import rollout
from mjx_dher.runs.folder import fingerprint
from mjx_dher.testing import ComponentError
from point_mass import PointMass
from probes import Walk

ENV = PointMass()
TRIAL = testing.trial.Trial(ENV)  # its episodes are played once
CONTEXT = Context(ENV.compute_reward, HParams())


class WithoutGoals(PointMass):
    """A task whose goals cannot be set."""

    with_goal = None


def corner(key, obs, ring, context):
    """All of them to one corner."""
    return jnp.full_like(obs["desired_goal"], 0.3)


def first_of(env=ENV, number=5):
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(0), number))


def test_a_rollout_takes_keys_of_either_kind():
    actions = jnp.zeros((ENV.episode_length, 5, 2))
    play = jax.jit(lambda key: rollout(ENV, lambda action, obs: action, key, 5, actions)[0])
    typed, numbers = map(play, (jax.random.key(0), jax.random.PRNGKey(0)))
    np.testing.assert_array_equal(typed.observation, numbers.observation)


def test_a_rollout_is_played_for_the_goals_that_are_given():
    actions = jnp.zeros((ENV.episode_length, 5, 2))
    play = lambda: rollout(ENV, lambda action, obs: action, jax.random.key(0), 5, actions, lambda obs: corner(0, obs, 0, 0))  # noqa: E731
    episodes, outcome = jax.jit(play)()
    np.testing.assert_allclose(episodes.desired_goal, 0.3)
    np.testing.assert_allclose(episodes.achieved_goal[:, 0], first_of().obs["achieved_goal"])
    assert outcome.valid.all()


def played_for(generate, env=ENV):
    """Goals of the episodes of a run's first cycle."""
    train = make_train(env, dataclasses.replace(SMALL, cycles_per_epoch=1, total_steps=40), generator=generate)
    state, _ = jax.jit(train.epoch)(train.init(jax.random.key(0), HParams()))
    return state.replay.episodes.desired_goal[: SMALL.num_envs]


@pytest.mark.slow
def test_a_goal_that_is_not_finite_leaves_the_reset_s():

    def some(key, obs, ring, context):
        return obs["desired_goal"].at[1, 0].set(jnp.nan).at[0].set(0.1).at[2, 1].set(jnp.inf)

    found = played_for(some)
    own = played_for(lambda key, obs, ring, context: obs["desired_goal"])
    np.testing.assert_array_equal(found, own.at[0].set(0.1))


@pytest.mark.slow
def test_a_start_that_is_not_finite_does_not_spoil_the_goals_of_others():
    class Broken(PointMass):
        """Half of the starts, those at the right, are NaN."""

        def reset(self, key):
            state = super().reset(key)
            start = state.obs["achieved_goal"]
            return self._state(jnp.where(start[0] > 0, jnp.nan, start), state.obs["desired_goal"])

    found = played_for(lambda key, obs, ring, context: 0.1 + 0.0 * (obs["desired_goal"] + obs["achieved_goal"].sum()), Broken())
    assert 0 < (found == jnp.float32(0.1)).all(axis=1).sum() < SMALL.num_envs  # the others were discarded


@pytest.mark.parametrize(
    ("gives", "generate"),
    [
        ("float32[4]", lambda key, obs, ring, context: obs["desired_goal"][:, 0]),
        ("int32[4, 2]", lambda key, obs, ring, context: jnp.ones((4, 2), jnp.int32)),
        ("float32[2]", lambda key, obs, ring, context: [0.1, 0.2]),
    ],
)
def test_goals_of_the_wrong_shape_are_refused(gives, generate):
    with pytest.raises(ValueError, match=r"goals \[N, G\] .*\[4, 2\]") as error:
        played_for(generate)
    assert gives in str(error.value)


def test_make_takes_a_name_a_place_or_a_function():
    assert generators.make("reset") is generators.reset
    assert generators.make("mjx_dher.contrib.goals:hgg") is generators.make("hgg") is goals.hgg
    assert generators.make(corner).generate is corner
    for wrong in ("hggg", "mjx_dher.contrib.generators:rset", lambda obs: obs, 3):
        with pytest.raises(ValueError, match="generator"):
            generators.make(wrong)


def test_a_generator_needs_an_environment_that_takes_goals():
    with pytest.raises(ValueError, match="with_goal"):
        make_train(WithoutGoals(), SMALL, generator=corner)
    make_train(WithoutGoals(), SMALL)


def test_what_asks_the_learner_needs_one_that_answers():
    made = learners.make("ddpg", SMALL, env_spec(ENV))
    silent = dataclasses.make_dataclass("Silent", [])()
    for name in (method for method in vars(learners.Learner) if not method.startswith("_")):
        object.__setattr__(silent, name, getattr(made, name))
    for part in {"priority": priorities.make("td_error")}, {"generator": generators.make("hgg")}:
        with pytest.raises(ValueError, match="value"):
            make_train(ENV, SMALL, learner=silent, **part)
        make_train(ENV, SMALL, **part)


def test_what_is_half_a_priority_is_refused():
    for wrong, message in (
        (Priority(), "none of them"),
        (Priority(renew=lambda ring: 1.0), "renew must be a function"),
        (Priority(choose=lambda key: 1), "choose must be a function"),
        (dataclasses.replace(priorities.td_error, candidates=0), r"priority: candidates must lie in \[1, "),
    ):
        with pytest.raises(ValueError, match=message):
            priorities.make(wrong)
    ring = TRIAL.ring
    with pytest.raises(ValueError, match=r"weights \[E\] .*\[32\]; got .*\[2\]"):
        priorities.renew(Priority(renew=lambda ring, context: jnp.ones(2)), ring, CONTEXT)
    nan = priorities.renew(Priority(renew=lambda ring, context: jnp.full(32, jnp.nan)), ring, CONTEXT)
    np.testing.assert_array_equal(nan.priority, 0)
    for wrong in (
        lambda key, sample, batch, number, context: jnp.zeros(number),
        lambda key, sample, batch, number, context: jnp.arange(2),
    ):
        with pytest.raises(ValueError, match=r"indices \[B\] of choose"):
            priorities.choose(Priority(choose=wrong), jax.random.key(0), *_candidates(ring), 4, CONTEXT)


def _candidates(ring):
    from mjx_dher.relabel import relabel

    @jax.jit
    def draw(ring):
        sample = replay.sample(ring, jax.random.key(0), 16)
        return sample, relabel(sample, samplers.make("future"), CONTEXT, jax.random.key(1)).batch

    return draw(ring)


def test_trials_name_what_is_wrong():
    trial = TRIAL
    for wrong, message in (
        (lambda key, obs, ring, context: obs["achieved_goal"][:, 0], r"goals \[N, G\]"),
        (lambda key, obs, ring, context: jnp.full((16, 2), jnp.nan), "no goal is finite"),
        (lambda key, obs, ring, context: 1 / 0, "ZeroDivisionError"),
    ):
        with pytest.raises(ComponentError, match=message):
            testing.check_generator(wrong, trial)
    with pytest.raises(ComponentError, match="with_goal"):
        testing.check_generator(corner, WithoutGoals())
    assert "100% of the goals" in testing.check_generator(corner, trial)
    with pytest.raises(ComponentError, match="negative"):
        testing.check_priority(Priority(renew=lambda ring, context: -ring.priority - 1.0), trial)
    with pytest.raises(ComponentError, match="indices"):
        testing.check_priority(Priority(choose=lambda key, sample, batch, number, context: 99 + jnp.arange(number)), trial)
    with pytest.raises(ComponentError, match="negative"):
        testing.check_metric(lambda achieved, desired: -jnp.ones(11), trial)


def test_built_in_parts_pass_their_trials():
    trial = TRIAL
    assert "chosen" in testing.check_priority("td_error", trial)
    assert "goals of the past never" in testing.check_sampler(samplers.make("weighted", metric="velocity"), trial)


def test_a_task_that_changes_more_than_the_goal_is_named():
    class Moves(PointMass):
        def with_goal(self, state, goal):
            return self._state(state.obs["achieved_goal"] + 0.1, goal)

    class Ignores(PointMass):
        def with_goal(self, state, goal):
            return state

    with pytest.raises(testing.ComponentError, match="achieved_goal differs"):
        testing.check_env(Moves())
    with pytest.raises(testing.ComponentError, match="desired_goal differs"):
        testing.check_env(Ignores())


def test_a_task_whose_terminal_states_or_observations_depend_on_the_goal_is_named():
    """After relabelling, both would still be those of the goal before."""

    class Shows(PointMass):
        def step(self, state, action):
            following = super().step(state, action)
            left = following.obs["desired_goal"] - following.obs["achieved_goal"]
            return following.replace(obs={**following.obs, "observation": left})

    class Ends(Walk):
        def _walk(self, position, goal):
            state = super()._walk(position, goal)
            return state.replace(terminal=state.success > 0)

    with pytest.raises(testing.ComponentError, match=r"step after with_goal.*observation differs"):
        testing.check_env(Shows())
    with pytest.raises(testing.ComponentError, match=r"step after with_goal.*terminal differs"):
        testing.check_env(Ends())
    testing.check_env(Walk())


def test_every_part_by_name_shares_a_program_with_its_kind():
    base = RunSpec()
    shared = {
        **{("sampler", name): base for name in COMPONENTS["sampler"]},
        **{("metric", name): base for name in COMPONENTS["metric"]},
        **{("generator", name): base for name in COMPONENTS["generator"]},
    }
    for (field, name), other in shared.items():
        assert dataclasses.replace(base, **{field: name}).program == other.program, name
    kinds = {dataclasses.replace(base, priority=name).program for name in COMPONENTS["priority"]}
    assert len(kinds) == 4  # two draw other numbers of candidates
    assert dataclasses.replace(base, priority="my:own").program not in kinds


def test_settings_that_are_new_change_no_name_of_a_trial():
    assert not {"generator", "hindsight_reward"} & set(fingerprint.identity(RunSpec(), "native", {}))
    named = {fingerprint.trial_name(RunSpec(generator=name)) for name in COMPONENTS["generator"]}
    assert len(named) == len(COMPONENTS["generator"])
    assert fingerprint.trial_name(RunSpec(hparams=HParams(hindsight_reward=0.5))) != fingerprint.trial_name(RunSpec())


@pytest.mark.slow
def test_lanes_learn_as_runs_alone_do():
    """A priority and a generator that share a program with others compute what they compute alone."""
    kinds = [("eventful", "reset"), ("energy", "hgg"), ("max_entropy", "reset")]
    hparams = HParams(priority_fraction=0.5)

    def finish(program, key, numbers):
        state = program.init(key, numbers)
        for _ in range(2):
            state, _ = program.epoch(state)
        return state.learner.params

    from mjx_dher.runs.program import Lane

    names = list(dict.fromkeys(name for name, _ in kinds)), ["reset", "hgg"]
    together = make_train(
        ENV,
        SMALL,
        priority=priorities.join(map(priorities.make, names[0])),
        generator=generators.join(map(generators.make, names[1])),
    )
    lanes = [Lane(*hparams, 0, names[0].index(p), names[1].index(g)) for p, g in kinds]
    stacked = jax.tree.map(lambda *x: jnp.array(x, jnp.float32), *lanes)
    keys = jnp.stack([jax.random.key(3)] * 3)
    joined = jax.jit(jax.vmap(lambda key, numbers: finish(together, key, numbers)))(keys, stacked)
    for lane, (priority, generator) in enumerate(kinds):
        alone = make_train(ENV, SMALL, priority=priorities.make(priority), generator=generators.make(generator))
        params = jax.jit(lambda key, program=alone: finish(program, key, hparams))(jax.random.key(3))
        for a, b in zip(jax.tree.leaves(joined), jax.tree.leaves(params), strict=True):
            np.testing.assert_allclose(a[lane], b, rtol=1e-3, atol=1e-4)
