"""What a JAX user hands to single functions: each wrong argument is refused by a sentence, as soon as it is traced."""

import collections
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import TINY as SMALL
from conftest import refuses

from mjx_dher import HParams, make_train, priorities, relabel, replay, samplers, testing, trainer
from mjx_dher.context import Context
from mjx_dher.learners import RESERVED, ddpg
from mjx_dher.rollout import rollout
from mjx_dher.runs.folder import loggers
from mjx_dher.runs.loop import Progress
from mjx_dher.samplers import Sampler, future
from point_mass import PointMass
from probes import Least, Walk

ENV = PointMass()
TRIAL = testing.trial.Trial(ENV)  # its episodes are played once
T, N = ENV.episode_length, 6

CONTEXT = Context(ENV.compute_reward, HParams())


@pytest.fixture(scope="module")
def episodes():
    return TRIAL.episodes


@pytest.fixture(scope="module")
def ring(episodes):
    return replay.add(replay.init(first(episodes), 20), episodes)


def first(episodes):
    return jax.tree.map(lambda x: x[0], episodes)


def trace(function, *args):
    """Traces a function: what is refused is refused before anything runs."""
    return jax.eval_shape(function, *args)


# Samplers and what they are made of, through `relabel`: a part, and what the error must name.
SAMPLERS = [
    (lambda a, d, s, h: None, ["sampler", "NoneType"]),
    (lambda a, d, s, h: (future(a, d, s, h),), ["sampler", "[1, 11]"]),
    (lambda a, d, s, h: 1.0, ["sampler", "float32[]"]),
    (lambda a, d, s, h: future(a, d, s, h) > -1, ["sampler", "bool[11]"]),
    (Sampler(3), ["sampler", 3]),
    (Sampler, ["sampler", "class"]),
    (Sampler(future, cross_episode="yes"), ["cross_episode", "yes"]),
    ("futur", ["sampler", "futur", "future"]),
]
METRICS = [
    (lambda a, d: None, ["metric", "NoneType"]),
    (lambda a, d: a[:, 0] + 1j, ["metric", "complex64[11]"]),
]
KERNELS = [
    (lambda r, t: None, ["kernel", "NoneType"]),
    (lambda r, t: r < t, ["kernel", "bool[11]"]),
    (lambda r, t: jnp.arange(r.size), ["kernel", "int32[11]"]),
    (lambda r, t: 0.0, ["kernel", "[11]", "float32[]"]),
]


def test_what_a_sampler_gives_is_checked(ring):
    sample = replay.sample(ring, jax.random.key(0), 5)
    makes = [
        *((functools.partial(samplers.make, part), parts) for part, parts in SAMPLERS),
        *((functools.partial(samplers.make, "closest", metric=part), parts) for part, parts in METRICS),
        *((functools.partial(samplers.make, "weighted", kernel=part), parts) for part, parts in KERNELS),
    ]
    for make, parts in makes:
        with refuses(*parts):
            trace(lambda make=make: relabel.relabel(sample, make(), CONTEXT, jax.random.key(1)))


@pytest.mark.parametrize("gives", [jnp.zeros(()), jnp.zeros(1), jnp.zeros(T + 1, jnp.int32)])
def test_samplers_side_by_side_are_checked_each(ring, gives):
    """In `join` a scalar would be spread over all goals, and an integer would become a number."""
    numbers = collections.namedtuple("Numbered", (*HParams._fields, "choice"))(*HParams(), 1)
    together = samplers.join([future, lambda a, d, s, h: gives])
    sample = replay.sample(ring, jax.random.key(0), 5)
    with refuses("sampler"):
        trace(lambda: relabel.hindsight_goals(sample, together, numbers, jax.random.key(1)))


PRIORITIES = [
    (lambda e, c: None, ["priority", "NoneType"]),
    (lambda e, c: jnp.ones((), complex), ["priority", "complex64[]"]),
    (lambda e, c: jnp.ones(1), ["priority", "float32[1]"]),
]


def test_what_a_priority_gives_is_checked(episodes):
    for priority, parts in PRIORITIES:
        with refuses(*parts):
            trace(lambda priority=priority: priorities.weights(priority, episodes, CONTEXT))


def test_a_priority_in_the_ring_is_a_positive_number_or_0(ring, episodes):
    """Whoever adds it: the sums of others would no longer be sums."""
    weights = jnp.full(16, -1.0).at[:3].set(jnp.array([jnp.nan, jnp.inf, 2.0]))
    added = replay.add(replay.init(first(episodes), 16), episodes, weights)
    np.testing.assert_array_equal(added.priority, [0, 0, 2, *(0,) * 13])
    sums = replay.cumulative(added)
    rows = replay.draw_rows(added, jax.random.key(0), 50, 1.0, sums)
    np.testing.assert_array_equal(rows, 2)
    with refuses("priority", "str"):
        replay.add(ring, episodes, "x")


NO_EPISODES = [  # a change of one episode, and what the error must name
    (lambda e: e.replace(desired_goal=jnp.zeros(3)), ["(11, 2)", "(3,)"]),
    (lambda e: e.replace(desired_goal=e.achieved_goal), ["(11, 2)"]),
    (lambda e: e.replace(action=jnp.zeros(())), ["action"]),
    (lambda e: e.replace(action=jnp.zeros(10)), ["action"]),
    (lambda e: e.replace(action=None), ["action"]),
    (lambda e: e.replace(action=[[0.0, 0.0]] * 10), ["action"]),
    (lambda e: e.replace(observation={"x": jnp.zeros(())}), ["observation['x']", 11]),
    (lambda e: jax.tree.map(lambda x: x[None], e), ["action", "(1, 10, 2)"]),
]


def test_a_ring_is_made_of_one_whole_episode(episodes):
    for change, parts in NO_EPISODES:
        with refuses(*parts):
            replay.init(change(first(episodes)), 4)


def test_numbers_of_things_are_integers_of_at_least_1(ring, episodes):
    calls = {
        "num_episodes": lambda number: replay.init(first(episodes), number),
        "batch_size": lambda number: replay.sample(ring, jax.random.key(0), number),
        "num_envs": lambda number: rollout(ENV, lambda _, obs: jnp.zeros((N, 2)), jax.random.key(0), number),
        "episode_length": lambda number: make_train(PointMass(number), SMALL),
    }
    for name, call in calls.items():
        for number in (0, -1, 2.5, True, "3", None):
            with refuses(name, number):
                call(number)


def test_rows_are_one_integer_for_each_transition(ring):
    for rows in (jnp.zeros((), int), jnp.zeros(1, int), jnp.zeros(5)):
        with refuses("rows"):
            replay.sample(ring, jax.random.key(0), 5, rows)


def test_nothing_cannot_be_added(ring, episodes):
    with refuses("episodes"):
        replay.add(ring, jax.tree.map(lambda x: x[:0], episodes))


@dataclasses.dataclass
class State:
    obs: object
    reward: object
    success: object
    failed: object = dataclasses.field(default_factory=lambda: jnp.zeros((), bool))


jax.tree_util.register_dataclass(State)


class Changed(PointMass):
    """A point mass whose states go through `change`."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def reset(self, key):
        return self.change(State(**vars(super().reset(key))))

    def step(self, state, action):
        return self.change(State(**vars(super().step(state, action))))


STATES = [  # a change of the states, and what the error must name
    (lambda s: dataclasses.replace(s, failed=jnp.int32(0)), ["failed", "int32"]),
    (lambda s: dataclasses.replace(s, failed=jnp.float32(0)), ["failed", "float32"]),
    (lambda s: dataclasses.replace(s, failed=jnp.zeros(3, bool)), ["failed", "(3,)"]),
    (lambda s: dataclasses.replace(s, failed=None), ["failed", "NoneType"]),
    (lambda s: dataclasses.replace(s, reward=None), ["reward", "NoneType"]),
    (lambda s: dataclasses.replace(s, reward=s.reward + 0j), ["reward", "complex64"]),
    (lambda s: dataclasses.replace(s, obs={n: x for n, x in s.obs.items() if n[0] != "d"}), ["obs", "desired_goal"]),
    (lambda s: dataclasses.replace(s, obs=s.obs["observation"]), ["obs"]),
    (lambda s: (s.obs, s.reward, s.success), ["tuple", "obs"]),
    (lambda s: None, ["NoneType", "obs"]),
]


def test_a_state_has_what_the_trainer_reads():
    """`rollout` rejects it, and the trainer before that."""
    actions = jnp.zeros((T, N, 2))
    for change, parts in STATES:
        env = Changed(change)
        with refuses(*parts):
            trace(lambda env=env: rollout(env, lambda action, obs: action, jax.random.key(0), N, actions))
        with refuses(*parts):
            make_train(env, SMALL)


def test_what_is_no_environment_is_named():
    for env in (PointMass, object(), None, "push"):
        for call in (
            lambda env=env: make_train(env, SMALL),
            lambda env=env: rollout(env, None, jax.random.key(0), N),
            lambda env=env: testing.check_sampler("future", env),
        ):
            with refuses("PointMass" if env is PointMass else "reset"):
                call()


ARGUMENTS = [  # arguments of make_train, and what the error must name
    ({"config": {"num_envs": 3}}, ["config", "Config"]),
    ({"config": HParams()}, ["config", "Config"]),
    ({"learner": ddpg.make}, ["learner", "init"]),
    ({"learner": object()}, ["learner", "init"]),
    ({"priority": 3}, ["priority", "(episode, context)", 3]),
    ({"priority": lambda: 1.0}, ["priority"]),
    ({"priority": "evntful"}, ["priority", "evntful", "eventful"]),
]


def test_arguments_of_make_train_are_of_their_kind():
    for arguments, parts in ARGUMENTS:
        with refuses(*parts):
            make_train(ENV, **{"config": SMALL, **arguments})


def test_a_policy_s_inputs_are_one_for_each_step():
    with refuses("inputs['x']", "[10]", "[5, 6, 2]"):
        rollout(ENV, lambda inputs, obs: inputs["x"], jax.random.key(0), N, {"x": jnp.zeros((5, N, 2))})


# Learners, in the loop: `Least` but for one method.


def updates(change):
    return {"update": lambda self, state, batch, hparams: change(*Least.update(self, state, batch, hparams))}


def half(tree):
    return jax.tree.map(lambda x: x.astype("float16"), tree)


LEARNERS = {  # methods, and what the error must name
    "no pair": (updates(lambda state, losses: state), ["update", "(state, metrics)"]),
    "no dict": (updates(lambda state, losses: (state, (1.0,))), ["update", "tuple"]),
    "the log's": (updates(lambda state, losses: (state, {"success_rate": 1.0})), ["success_rate"]),
    "no column": (updates(lambda state, losses: (state, {"loss,actor": 1.0})), ["loss,actor", "commas"]),
    "the trainer's": ({"summary": lambda self, state: {"discarded_episodes": 0.0}}, ["discarded_episodes"]),
    "the loop's": ({"summary": lambda self, state: {"epoch": 0.0}}, ["epoch"]),
    "its own": ({"summary": lambda self, state: {"q_mean": 0.0}}, ["q_mean"]),
    "no text": ({"summary": lambda self, state: {1: 0.0}}, [1]),
    "no scalar": ({"summary": lambda self, state: {"x": jnp.zeros(3)}}, ["x", "learner"]),
    "nothing": ({"summary": lambda self, state: None}, ["summary", "NoneType"]),
    "other types": (updates(lambda state, losses: (half(state), losses)), ["update", "float32[8]", "float16[8]"]),
    "no target": ({"update_target": lambda self, state, hparams: None}, ["update_target"]),
    "no normalizers": ({"update_normalizers": lambda self, *args: None}, ["update_normalizers"]),
    "noise": ({"noise": lambda self, key, t, n, hparams: jnp.zeros(t)}, ["[T, N]", "noise", "[10]"]),
}


@pytest.mark.parametrize("name", LEARNERS)
def test_what_a_learner_gives_is_checked(name):
    methods, parts = LEARNERS[name]
    own = type("Own", (Least,), methods)()
    train = make_train(ENV, SMALL, learner=own)
    with refuses(*parts):
        trace(train.epoch, trace(train.init, jax.random.key(0), HParams()))
    with refuses(*parts, error=testing.ComponentError):
        testing.check_learner(lambda config, spec, networks: own, TRIAL, SMALL)


def test_the_learner_without_a_mistake_passes():
    train = make_train(ENV, SMALL, learner=Least())
    trace(train.epoch, trace(train.init, jax.random.key(0), HParams()))
    testing.check_learner(lambda config, spec, networks: Least(), TRIAL, SMALL)


def test_a_sampler_is_checked_with_the_length_of_short_episodes():
    def future_in_the_end(achieved, desired, step, hparams, length=None):
        weights = samplers.future(achieved, desired, step, hparams, length)
        return weights if length is None else weights * jnp.nan

    testing.check_sampler(future_in_the_end, TRIAL)
    with refuses("sampler", "nan", error=testing.ComponentError):
        testing.check_sampler(future_in_the_end, Walk())
    assert "never" in testing.check_sampler("future", Walk())


def test_a_learner_without_floating_point_numbers_is_finite():
    assert trainer.is_finite({"steps": jnp.zeros((), int)})


def test_the_names_that_learners_may_not_use_are_those_of_the_log():
    train = make_train(ENV, SMALL)
    _, metrics = trace(train.epoch, trace(train.init, jax.random.key(0), HParams()))
    progress = Progress(*(1 for _ in Progress._fields))
    logged = loggers.metrics_row(progress, dict.fromkeys(metrics, 0.0))
    losses = {"critic_loss", "actor_loss", "q_mean", "actor_norm", "critic_norm"}
    assert set(logged) - losses | {"train_length_mean", "digest", "file"} == RESERVED  # of tasks that end early, or in files


@pytest.mark.slow
def test_checks_take_episodes_of_one_step_and_observations_of_their_kind():
    one_step = PointMass(1)
    assert "goals of the past too" in testing.check_sampler("episode", one_step)
    testing.check_learner("ddpg", one_step, SMALL)
    dicts = Changed(lambda s: dataclasses.replace(s, obs={**s.obs, "observation": {"x": s.obs["achieved_goal"]}}))
    testing.check_learner("ddpg", dicts, SMALL)


def test_a_kernel_s_weights_and_a_priority_of_0_are_told():
    assert "weights 2, 1 and 0 at relative distances 0, 1 and 2" in testing.check_kernel("linear")
    told = testing.check_priority(lambda episode, context: jnp.zeros(()), TRIAL)
    assert "while none is above 0, episodes are drawn uniformly" in told


def test_what_is_to_be_left_out_is_left_out():
    takes_all = lambda self, state, obs, goal, hparams, valid: ddpg.DDPG.update_normalizers(self, state, obs, goal, hparams)  # noqa: E731

    def make(config, spec, networks):
        made = ddpg.make(config, spec, networks)
        kind = type("Own", (ddpg.DDPG,), {"update_normalizers": takes_all})
        return kind(*(getattr(made, field.name) for field in dataclasses.fields(made)))

    with refuses("learner.update_normalizers", "finite"):
        testing.check_learner(make, TRIAL, SMALL)


def test_a_place_is_told_wherever_the_code_lies(tmp_path, monkeypatch):
    """In a folder that is called as a library is, too."""
    folder = tmp_path / "jax" / "mjx_dher"
    folder.mkdir(parents=True)
    (folder / "lies_in_jax.py").write_text("def sampler(achieved, desired, step, hparams):\n    return achieved.nothing\n")
    monkeypatch.syspath_prepend(folder)
    with refuses("AttributeError", "lies_in_jax.py", "line 2"):
        testing.check_sampler("lies_in_jax:sampler", TRIAL)
