"""What users hand in is checked where it is handed in: a table of mistakes in each kind of part."""

import itertools
import re

import configs
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
from configs import TINY as SMALL
from conftest import refuses

import mjx_dher
from mjx_dher import HParams, Options, RunSpec, cli, priorities, relabel, replay, samplers, testing, trainer
from mjx_dher.components import COMPONENTS
from mjx_dher.context import Context
from mjx_dher.priorities import Priority
from mjx_dher.rollout import rollout
from mjx_dher.runs import driver
from mjx_dher.testing import (
    check_env,
    check_generator,
    check_kernel,
    check_learner,
    check_metric,
    check_normalization,
    check_priority,
    check_sampler,
)
from mjx_dher.testing.trial import Trial
from point_mass import PointMass, soon

ENV = PointMass()
TRIAL = Trial(ENV)  # its episodes are played once
CHECKS = {
    "sampler": (mistakes.SAMPLERS, lambda part: check_sampler(part, TRIAL)),
    "metric": (mistakes.METRICS, lambda part: check_metric(part, TRIAL)),
    "weight_kernel": (mistakes.KERNELS, check_kernel),
    "weight_normalization": (mistakes.NORMALIZATIONS, check_normalization),
    "priority": (mistakes.PRIORITY, lambda part: check_priority(part, TRIAL)),
    "learner": (mistakes.LEARNERS, lambda part: check_learner(part, TRIAL, SMALL)),
    "networks": (mistakes.NETWORKS, lambda part: check_learner("ddpg", TRIAL, SMALL, networks=part)),
    "env": (mistakes.ENVS, lambda part: check_env(part())),
}
TABLE = [(kind, name) for kind, (table, _) in CHECKS.items() for name in table]


@pytest.mark.parametrize(("kind", "name"), TABLE)
def test_each_mistake_is_named_by_its_check(kind, name):
    table, check = CHECKS[kind]
    with pytest.raises(ValueError, match=table[name]) as raised:
        check(getattr(mistakes, name))
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_what_is_right_passes(capsys):
    for name in (*COMPONENTS["sampler"], soon):
        check_sampler(name, ENV)
    for kernel in ("linear", "inverse", "softmax"):
        check_kernel(kernel)
    for normalization in COMPONENTS["weight_normalization"]:
        check_normalization(normalization)
    assert "0.0952 to 1.9 for distances" in check_normalization("mean")
    check_metric("position", ENV)
    check_priority("eventful", ENV)
    check_learner("ddpg", ENV, SMALL)
    assert "no goal at" in check_sampler(within, ENV)
    assert "goals of the past too" in check_sampler("episode", ENV)
    assert "goals of the past never" in check_sampler("future", ENV)
    parts = ["--env", "point_mass:PointMass", "--sampler", "weighted", "--metric", "test_mistakes:near"]
    assert cli.main(["check", *parts, "--learner", "mjx_dher.learners.ddpg:make", "--priority", "test_mistakes:alike"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "point_mass:PointMass" in lines[0]
    assert [line.partition(" ")[0] for line in lines] == ["testing", "env", "metric", "weighted:", "priority", "learner"]
    assert cli.main(["check"]) == 2
    assert "one or more components as module:attribute" in capsys.readouterr().err


def within(achieved, desired, step, hparams):
    """Future goals within a radius; often there is none."""
    near = jnp.linalg.norm(achieved - desired, axis=-1) < 0.2
    return jnp.where(near & samplers.future_mask(achieved.shape[0], step), 0.0, -jnp.inf)


def near(achieved, desired):
    return jnp.linalg.norm(achieved - desired, axis=-1)


def alike(episode, context):
    return jnp.ones(())


def deaf(distance, candidates, scale):
    return jnp.ones_like(distance)


def always(index):
    """A `choose` that does not look at the transitions."""
    return Priority(choose=lambda key, sample, batch, number, context: index(jnp.arange(number), key))


def leaving(achieved, desired, step, hparams):
    raise SystemExit(4)


calls = itertools.count()
MORE = {  # what a check is handed, and a word of what it says
    "the same normalized distance": (lambda: check_normalization(deaf), "tells no distances apart"),
    "one transition": (lambda: check_priority(always(lambda i, key: 0 * i), TRIAL), "all 8 are one"),
    "one transition at random": (
        lambda: check_priority(always(lambda i, key: 0 * i + jax.random.randint(key, (), 0, 32)), TRIAL),
        "all 8 are one",
    ),
    "the first of each": (
        lambda: check_priority(always(lambda i, key: 4 * i), TRIAL),
        "keeps the first candidate of every place",
    ),
    "no candidate": (
        lambda: check_priority(always(lambda i, key: 5 * i - 1), TRIAL),
        r"indices of 32 candidates; one is \[-1\]",
    ),
    "another sampler each time": (
        lambda: check_sampler(lambda achieved, desired, step, hparams: next(calls) * achieved[:, 0], TRIAL),
        "sampler, called twice .* same result",
    ),
    "another generator each time": (
        lambda: check_generator(lambda key, obs, ring, context: obs["desired_goal"] + next(calls), TRIAL),
        "generator, called twice .* same result",
    ),
    "a program's end": (lambda: check_sampler(leaving, TRIAL), "raises SystemExit: 4"),
    "another weight each time": (
        lambda: check_priority(lambda episode, context: jnp.zeros(()) + next(calls), TRIAL),
        "priority, called twice .* same result",
    ),
}


@pytest.mark.parametrize(("act", "message"), MORE.values(), ids=MORE)
def test_parts_that_do_not_look_or_not_alike_are_named(act, message):
    with pytest.raises(testing.ComponentError, match=message):
        act()


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("dpp", "td_error")]


@pytest.mark.parametrize("name", ["curriculum", "not_misleading", *SLOW])
def test_built_in_choices_pass(name):
    assert f"8 of {16 if name == 'curriculum' else 32} transitions chosen" in check_priority(name, TRIAL)


FLAGS = configs.flags(SMALL)[2:]  # all but the environment
# On the command line, one of each kind, and each way in which the message can come about.
THROUGH = [
    ("sampler", "nan_late", []),
    ("sampler", "two_arguments", []),
    ("metric", "without_axis", ["--sampler", "closest"]),
    ("metric", "similarity", ["--sampler", "closest"]),
    ("weight_kernel", "pole", ["--sampler", "weighted"]),
    ("weight_normalization", "by_least", ["--sampler", "weighted"]),
    ("priority", "negative", []),
    ("learner", "unbounded", []),
    ("networks", "swapped", []),
    *(("env", name, []) for name in ("NanObservation", "Raising")),
]


@pytest.mark.parametrize(
    ("command", "kind", "name", "flags"),
    [
        *(("train", *mistake) for mistake in THROUGH),
        *(("sweep", *THROUGH[2]), ("check", *THROUGH[2])),
        pytest.param("check", *THROUGH[3], marks=pytest.mark.slow),
        *(pytest.param("train", "env", name, [], marks=pytest.mark.slow) for name in ("RewardOfTwoAxes", "NoSteps")),
    ],
)
def test_each_is_named_by_the_command_before_anything_is_compiled(tmp_path, capsys, monkeypatch, kind, name, flags, command):
    monkeypatch.setattr(driver.program_lib, "compile_runs", lambda *args: pytest.fail("compiled"))
    env = [] if kind == "env" else ["--env", "point_mass:PointMass"]
    argv = [*env, f"--{kind.replace('_', '-')}", f"mistakes:{name}", *flags]
    if command != "check":
        argv += [*FLAGS, "--out", str(tmp_path / "out")]
    assert cli.main([command, *argv] if command != "train" else argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert re.search(CHECKS[kind][0][name], error), error
    assert not list(tmp_path.rglob("*.json"))
    assert command == "sweep" or not (tmp_path / "out").exists()


def train(tmp_path, env=ENV, **parts):
    """Trains by a library call, which tries nothing out; returns the results and what was reported."""
    told = []
    spec = RunSpec(env="point_mass", config=SMALL, **parts)
    return mjx_dher.train_runs(env, [spec], [tmp_path / "run"], options=Options(final_episodes=4), report=told.append), told


@pytest.mark.parametrize(
    ("kind", "name", "parts"),
    [
        ("sampler", "scalar", ["sampler", "[11]", "float32[]"]),
        ("sampler", "whole_numbers", ["sampler", "floats", "int32[11]"]),
        ("metric", "without_norm", ["metric", "float32[11, 2]"]),
        ("weight_kernel", "mean_weight", ["kernel", "float32[]"]),
        ("priority", "of_each_step", ["priority", "float32[11]"]),
        ("learner", "keeps_axis", ["actions", "[4, 2]", "[4, 2, 1]"]),
        ("networks", "one_action", ["actor"]),
        ("env", "RewardOfTwoAxes", ["reward", "scalar"]),
        ("env", "ShorterGoal", ["achieved_goal", "desired_goal"]),
        ("env", "Growing", ["observation", "float32[4]"]),
        ("env", "NoActions", ["action_size", 0]),
        ("env", "NoSteps", ["episode_length", 0]),
        ("env", "WithoutAxis", ["compute_reward", "float32[]"]),
    ],
)
def test_shapes_are_checked_where_a_function_is_handed_in(tmp_path, kind, name, parts):
    read_by = {"metric": {"sampler": "closest"}, "weight_kernel": {"sampler": "weighted"}}.get(kind, {})
    with refuses(*parts):
        if kind == "env":
            train(tmp_path, getattr(mistakes, name)())
        else:
            train(tmp_path, **{kind: f"mistakes:{name}"}, **read_by)


@pytest.mark.parametrize(
    ("env", "parts", "reason"),
    [
        ("NanObservation", {}, "all 4 episodes were discarded"),
        ("SuccessSeven", {}, "success must be 0 or 1; in 1 of the episodes it is not"),
        (None, {"sampler": "mistakes:nothing"}, "the sampler offers no hindsight goal for any transition"),
        *(
            pytest.param(
                None, {"sampler": sampler, "metric": f"mistakes:{metric}"}, "no hindsight goal", marks=pytest.mark.slow
            )
            for sampler, metric in (("closest", "similarity"), ("epsilon_closest", "cosine"))
        ),
        (None, {"learner": "mistakes:breaks"}, "not finite"),
        pytest.param("Hundred", {}, "reward_range", marks=pytest.mark.slow),
    ],
)
def test_a_run_that_has_gone_bad_fails_and_says_why(tmp_path, env, parts, reason):
    (result,), told = train(tmp_path, getattr(mistakes, env)() if env else ENV, **{"learner": "mistakes:least", **parts})
    assert (result.status, result.epoch) == ("failed", 1)
    assert reason in result.content["reason"]
    assert "success_rate" not in result.content
    assert any(line.startswith("failed in epoch 1: ") and reason in line for line in told)
    assert not (tmp_path / "run" / "policy.npz").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "parts", "warning"),
    [
        ("HalfNan", {}, r"epoch 1: \d of 4 episodes were discarded"),
        (
            None,
            {"sampler": "mistakes:nan_late"},
            r"epoch 1: the sampler offers no goal for 0\.\d+ of the transitions to relabel",
        ),
    ],
)
def test_trouble_is_told_once_and_training_goes_on(tmp_path, env, parts, warning):
    (result,), told = train(tmp_path, getattr(mistakes, env)() if env else ENV, **parts)
    assert result.status == "finished"
    assert sum(bool(re.match(warning, line)) for line in told) == 1


# The pieces by themselves.


@pytest.fixture(scope="module")
def episodes():
    actions = jax.random.normal(jax.random.key(0), (10, 6, 2))
    return rollout(ENV, lambda action, obs: action, jax.random.key(1), 6, actions)[0]


@pytest.fixture(scope="module")
def ring(episodes):
    return replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), 8), episodes)


draw, relabelled = jax.jit(replay.sample, static_argnums=2), jax.jit(relabel.relabel, static_argnums=(1, 2))


def test_transitions_without_a_goal_keep_their_own_and_are_counted(ring):
    sample = draw(ring, jax.random.key(2), 400)
    for sampler in (mistakes.nothing, mistakes.infinite, mistakes.nan_late, within):
        context = Context(ENV.compute_reward, HParams(her_k=1e9))
        made = relabelled(sample, sampler, context, jax.random.key(3))
        weigh = jax.jit(jax.vmap(sampler, (0, 0, 0, None)))
        log_weights = weigh(sample.episode_goals, sample.desired_goal, sample.step, HParams())
        offered = np.isfinite(np.max(log_weights, axis=1))
        kept = np.all(np.asarray(made.batch.desired_goal) == np.asarray(sample.desired_goal), axis=1)
        assert np.all(kept[~offered])
        assert made.no_goal_share == pytest.approx(1 - offered.mean())
        assert made.batch.reward.shape == (400,)
    assert 0 < offered.mean() < 1


def test_a_plain_function_is_a_sampler(ring):
    sample = draw(ring, jax.random.key(2), 50)
    plain, named = (
        relabelled(sample, sampler, Context(ENV.compute_reward, HParams()), jax.random.key(3)).batch
        for sampler in (samplers.future, samplers.make("future"))
    )
    np.testing.assert_array_equal(plain.desired_goal, named.desired_goal)
    assert samplers.make(samplers.future).log_weights is samplers.future
    trainer.make_train(ENV, SMALL, sampler=samplers.future)
    with refuses("sampler", "(achieved, desired, step, hparams)", 3):
        samplers.make(3)


def test_relabel_takes_rewards_of_one_axis(ring):
    sample = draw(ring, jax.random.key(2), 5)
    for reward in (lambda a, d: ENV.compute_reward(a, d)[:, None], lambda a, d: jnp.zeros(())):
        with refuses("compute_reward", "[5]"):
            relabelled(sample, samplers.future, Context(reward, HParams()), jax.random.key(3))


def test_what_the_ring_has_no_place_for_is_named(ring, episodes):
    for change, parts in (
        (lambda e: jax.tree.map(lambda x: x[0], e), ["episodes", "[N, 11, 2]"]),
        (lambda e: e.replace(action=e.action[:, :5]), ["action", "[N, 10, 2]", "[6, 5, 2]"]),
        (lambda e: e.replace(desired_goal=e.desired_goal[:, :1]), ["desired_goal", "[N, 2]"]),
        (lambda e: e.replace(observation={"x": e.observation}), ["x"]),
        (lambda e: e.replace(desired_goal=e.desired_goal[:3]), ["desired_goal", 6]),
        (lambda e: e.replace(action=e.action.astype(jnp.complex64)), ["complex64[6, 10, 2]"]),
    ):
        with refuses(*parts):
            replay.add(ring, change(episodes))
    for name, shape in (("priority", (3,)), ("priority", (6, 1)), ("valid", ())):
        with refuses(name, "[N]", "[6]"):
            replay.add(ring, episodes, **{name: jnp.ones(shape)})
    one = jax.tree.map(lambda x: x[0], episodes)
    with refuses("action", "float32[10, 0]"):
        replay.init(one.replace(action=one.action[:, :0]), 4)


def test_a_policy_s_actions_have_their_shape():
    with refuses("actions", "[4, 2]", "[4, 3]"):
        rollout(ENV, lambda _, obs: jnp.zeros((4, 3)), jax.random.key(0), 4)


def test_checks_are_public():
    assert all(callable(getattr(testing, name)) for name in testing.__all__)
    assert priorities.make(alike) is alike
