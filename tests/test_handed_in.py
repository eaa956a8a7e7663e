"""What a JAX user hands to single functions: each wrong argument is refused by a sentence, as soon as it is traced."""

import collections
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_mistakes import SMALL

from mjx_dher import HParams, make_train, priorities, relabel, replay, samplers, testing, trainer
from mjx_dher.context import Context
from mjx_dher.learners import RESERVED, ddpg
from mjx_dher.rollout import env_spec, rollout
from mjx_dher.runs.folder import loggers
from mjx_dher.runs.program.loop import Progress
from mjx_dher.samplers import Sampler, future
from point_mass import PointMass

ENV = PointMass()
T, N = ENV.episode_length, 6

CONTEXT = Context(ENV.compute_reward, HParams())


@pytest.fixture(scope="module")
def episodes():
    return testing.trial.random_episodes(ENV)


@pytest.fixture(scope="module")
def ring(episodes):
    return replay.add(replay.init(first(episodes), 20), episodes)


def first(episodes):
    return jax.tree.map(lambda x: x[0], episodes)


def trace(function, *args):
    """Traces a function: what is refused is refused before anything runs."""
    return jax.eval_shape(function, *args)


# Samplers and what they are made of, through `relabel`.
SAMPLERS = {
    "sampler: .*NoneType": lambda a, d, s, h: None,
    r"sampler: .*\[1, 11\]": lambda a, d, s, h: (future(a, d, s, h),),
    r"sampler: .*float32\[\]": lambda a, d, s, h: 1.0,
    "sampler: .*bool": lambda a, d, s, h: future(a, d, s, h) > -1,
    "sampler .* 3": Sampler(3),
    "sampler .*class .*Sampler": Sampler,
    "cross_episode .*'yes'": Sampler(future, cross_episode="yes"),
    "sampler must be one of .*did you mean 'future'": "futur",
}
METRICS = {
    "metric: .*NoneType": lambda a, d: None,
    "metric: .*complex64": lambda a, d: a[:, 0] + 1j,
}
KERNELS = {
    "kernel: .*NoneType": lambda r, t: None,
    "kernel: .*bool": lambda r, t: r < t,
    "kernel: .*int32": lambda r, t: jnp.arange(r.size),
    r"kernel: .*\[11\]; got float32\[\]": lambda r, t: 0.0,
}


@pytest.mark.parametrize(
    ("message", "make"),
    [
        *((message, functools.partial(samplers.make, part)) for message, part in SAMPLERS.items()),
        *((message, functools.partial(samplers.make, "closest", metric=part)) for message, part in METRICS.items()),
        *((message, functools.partial(samplers.make, "weighted", kernel=part)) for message, part in KERNELS.items()),
    ],
)
def test_what_a_sampler_gives_is_checked(ring, message, make):
    sample = replay.sample(ring, jax.random.key(0), 5)
    with pytest.raises(ValueError, match=message):
        trace(lambda: relabel.relabel(sample, make(), CONTEXT, jax.random.key(1)))


@pytest.mark.parametrize("gives", [jnp.zeros(()), jnp.zeros(1), jnp.zeros(T + 1, jnp.int32)])
def test_samplers_side_by_side_are_checked_each(ring, gives):
    """In `join` a scalar would be spread over all goals, and an integer would become a number."""
    numbers = collections.namedtuple("Numbered", (*HParams._fields, "choice"))(*HParams(), 1)
    together = samplers.join([future, lambda a, d, s, h: gives])
    sample = replay.sample(ring, jax.random.key(0), 5)
    with pytest.raises(ValueError, match="sampler: log weights"):
        trace(lambda: relabel.hindsight_goals(sample, together, numbers, jax.random.key(1)))
    with pytest.raises(ValueError, match="one or more samplers"):
        samplers.join([])


PRIORITIES = {
    "priority: weight .*NoneType": lambda e, c: None,
    "priority: weight .*complex64": lambda e, c: jnp.ones((), complex),
    r"priority: weight .*\[1\]": lambda e, c: jnp.ones(1),
}


@pytest.mark.parametrize("message", PRIORITIES)
def test_what_a_priority_gives_is_checked(episodes, message):
    with pytest.raises(ValueError, match=message):
        trace(lambda: priorities.weights(PRIORITIES[message], episodes, CONTEXT))


def test_a_priority_in_the_ring_is_a_positive_number_or_0(ring, episodes):
    """Whoever adds it: the sums of others would no longer be sums."""
    weights = jnp.full(16, -1.0).at[:3].set(jnp.array([jnp.nan, jnp.inf, 2.0]))
    added = replay.add(replay.init(first(episodes), 16), episodes, weights)
    np.testing.assert_array_equal(added.priority, [0, 0, 2, *(0,) * 13])
    sums = replay.cumulative(added)
    rows = replay.draw_rows(added, jax.random.key(0), 50, 1.0, sums)
    np.testing.assert_array_equal(rows, 2)
    with pytest.raises(ValueError, match=r"priority must be numbers .*str"):
        replay.add(ring, episodes, "x")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.replace(desired_goal=jnp.zeros(3)), r"of one size G; got shapes \(11, 2\) and \(3,\)"),
        (lambda e: e.replace(desired_goal=e.achieved_goal), r"of one size G; got shapes \(11, 2\) and \(11, 2\)"),
        (lambda e: e.replace(action=jnp.zeros(())), "action"),
        (lambda e: e.replace(action=jnp.zeros(10)), "action"),
        (lambda e: e.replace(action=None), "action"),
        (lambda e: e.replace(action=[[0.0, 0.0]] * 10), "action"),
        (lambda e: e.replace(observation={"x": jnp.zeros(())}), r"observation\['x'\] must lead with T\+1 = 11"),
        (lambda e: jax.tree.map(lambda x: x[None], e), r"action of one episode must be \[T, A\]; got shape \(1, 10, 2\)"),
    ],
)
def test_a_ring_is_made_of_one_whole_episode(episodes, change, message):
    with pytest.raises(ValueError, match=message):
        replay.init(change(first(episodes)), 4)


@pytest.mark.parametrize("number", [0, -1, 2.5, True, "3", None])
def test_numbers_of_things_are_integers_of_at_least_1(ring, episodes, number):
    calls = {
        "num_episodes": lambda: replay.init(first(episodes), number),
        "batch_size": lambda: replay.sample(ring, jax.random.key(0), number),
        "num_envs": lambda: rollout(ENV, lambda _, obs: jnp.zeros((N, 2)), jax.random.key(0), number),
        "episode_length": lambda: make_train(PointMass(number), SMALL),
    }
    for name, call in calls.items():
        with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1; it is {number!r}"):
            call()


@pytest.mark.parametrize("rows", [jnp.zeros((), int), jnp.zeros(1, int), jnp.zeros(5)])
def test_rows_are_one_integer_for_each_transition(ring, rows):
    with pytest.raises(ValueError, match=r"rows"):
        replay.sample(ring, jax.random.key(0), 5, rows)


def test_nothing_cannot_be_added(ring, episodes):
    with pytest.raises(ValueError, match="one or more episodes; got none"):
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


STATES = {
    "reset: failed must be bool; it is int32": lambda s: dataclasses.replace(s, failed=jnp.int32(0)),
    "reset: failed must be bool; it is float32": lambda s: dataclasses.replace(s, failed=jnp.float32(0)),
    r"reset: failed must be a scalar, \[\]; it has shape \(3,\)": lambda s: dataclasses.replace(s, failed=jnp.zeros(3, bool)),
    "reset: failed must be a scalar, .*NoneType": lambda s: dataclasses.replace(s, failed=None),
    "reset: reward must be a scalar, .*NoneType": lambda s: dataclasses.replace(s, reward=None),
    "reset: reward must be a real number; it is complex64": lambda s: dataclasses.replace(s, reward=s.reward + 0j),
    "obs must be a dict .* it has no desired_goal": lambda s: dataclasses.replace(
        s, obs={n: x for n, x in s.obs.items() if n[0] != "d"}
    ),
    "obs must be a dict": lambda s: dataclasses.replace(s, obs=s.obs["observation"]),
    "this tuple has no obs": lambda s: (s.obs, s.reward, s.success),
    "this NoneType has no obs": lambda s: None,
}


@pytest.mark.parametrize("message", STATES)
def test_a_state_has_what_the_trainer_reads(message):
    """Refused by `rollout`, and by the trainer before that."""
    env = Changed(STATES[message])
    actions = jnp.zeros((T, N, 2))
    with pytest.raises(ValueError, match=message):
        trace(lambda: rollout(env, lambda action, obs: action, jax.random.key(0), N, actions))
    with pytest.raises(ValueError, match=message):
        make_train(env, SMALL)


@pytest.mark.parametrize("env", [PointMass, object(), None, "push"])
def test_what_is_no_environment_is_named(env):
    message = "an object, not a class: PointMass" if env is PointMass else "has reset, step and compute_reward; .* has no reset"
    for call in (
        lambda: make_train(env, SMALL),
        lambda: rollout(env, None, jax.random.key(0), N),
        lambda: testing.check_sampler("future", env),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"config": {"num_envs": 3}}, "config must be a Config"),
        ({"config": HParams()}, "config must be a Config"),
        ({"learner": ddpg.make}, "is no learner: it has no init"),
        ({"learner": object()}, "is no learner: it has no init"),
        ({"priority": 3}, r"priority must be a function \(episode, context\); it is 3"),
        ({"priority": lambda: 1.0}, "priority must be a function"),
        ({"priority": "evntful"}, "did you mean 'eventful'"),
    ],
)
def test_arguments_of_make_train_are_of_their_kind(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_train(ENV, **{"config": SMALL, **arguments})


def test_a_policy_s_inputs_are_one_for_each_step():
    with pytest.raises(ValueError, match=r"inputs\['x'\] must lead with \[T\] = \[10\], one for each step; got \[5, 6, 2\]"):
        rollout(ENV, lambda inputs, obs: inputs["x"], jax.random.key(0), N, {"x": jnp.zeros((5, N, 2))})


# Learners, in the loop: DDPG but for one method.
DDPG = ddpg.DDPG


def updates(change):
    return {"update": lambda self, state, batch, hparams: change(*DDPG.update(self, state, batch, hparams))}


def half(tree):
    return jax.tree.map(lambda x: x.astype("float16"), tree)


LEARNERS = {
    r"update must give \(state, metrics\)": updates(lambda state, losses: state),
    "update must be a dict of scalars; they are a tuple": updates(lambda state, losses: (state, (1.0,))),
    "'success_rate' is taken": updates(lambda state, losses: (state, {"success_rate": 1.0})),
    "'discarded_episodes' is taken": {"summary": lambda self, state: {"discarded_episodes": 0.0}},
    "'epoch' is taken": {"summary": lambda self, state: {"epoch": 0.0}},
    "'q_mean' is taken": {"summary": lambda self, state: {"q_mean": 0.0}},
    "1 is no text": {"summary": lambda self, state: {1: 0.0}},
    r"metric x of learner": {"summary": lambda self, state: {"x": jnp.zeros(3)}},
    "summary must be a dict of scalars; they are a NoneType": {"summary": lambda self, state: None},
    r"update must keep .*\.params\..* is float32\[8\] and becomes float16\[8\]": updates(
        lambda state, losses: (half(state), losses)
    ),
    "update_target must keep .*absent": {"update_target": lambda self, state, hparams: None},
    "update_normalizers must keep .*absent": {"update_normalizers": lambda self, *args: None},
    r"lead with \[T, N\] = \[10, 4\]; noise is \[10\]": {"noise": lambda self, key, t, n, hparams: jnp.zeros(t)},
}


@pytest.mark.parametrize("message", LEARNERS)
def test_what_a_learner_gives_is_checked(message):
    made = ddpg.make(SMALL, env_spec(ENV), trainer.learners.networks.mlp)
    own = type("Own", (DDPG,), LEARNERS[message])(*(getattr(made, field.name) for field in dataclasses.fields(made)))
    train = make_train(ENV, SMALL, learner=own)
    with pytest.raises(ValueError, match=message):
        trace(train.epoch, trace(train.init, jax.random.key(0), HParams()))
    with pytest.raises(ValueError, match=message.replace("10, 4", "10, 16")):
        testing.check_learner(lambda config, spec, networks: own, ENV, SMALL)


def test_a_learner_without_floating_point_numbers_is_finite():
    assert trainer.is_finite({"steps": jnp.zeros((), int)})


def test_the_names_that_learners_may_not_use_are_those_of_the_log():
    train = make_train(ENV, SMALL)
    _, metrics = trace(train.epoch, trace(train.init, jax.random.key(0), HParams()))
    progress = Progress(*(1 for _ in Progress._fields))
    logged = loggers.metrics_row(progress, dict.fromkeys(metrics, 0.0))
    losses = {"critic_loss", "actor_loss", "q_mean", "actor_norm", "critic_norm"}
    assert set(logged) - losses == RESERVED


# The checks themselves.


def test_checks_take_episodes_of_one_step_and_observations_of_their_kind():
    one_step = PointMass(1)
    assert "goals of the past too" in testing.check_sampler("episode", one_step)
    testing.check_learner("ddpg", one_step, SMALL)
    dicts = Changed(lambda s: dataclasses.replace(s, obs={**s.obs, "observation": {"x": s.obs["achieved_goal"]}}))
    with pytest.raises(ValueError, match="observation must be one vector"):
        testing.check_learner("ddpg", dicts, SMALL)


def test_a_kernel_s_weights_and_a_priority_of_0_are_told():
    assert "weights 2, 1 and 0 at relative distances 0, 1 and 2" in testing.check_kernel("linear")
    told = testing.check_priority(lambda episode, context: jnp.zeros(()), ENV)
    assert "while none is above 0, episodes are drawn uniformly" in told


def test_what_is_to_be_left_out_is_left_out():
    takes_all = lambda self, state, obs, goal, hparams, valid: DDPG.update_normalizers(self, state, obs, goal, hparams)  # noqa: E731

    def make(config, spec, networks):
        made = ddpg.make(config, spec, networks)
        kind = type("Own", (DDPG,), {"update_normalizers": takes_all})
        return kind(*(getattr(made, field.name) for field in dataclasses.fields(made)))

    with pytest.raises(ValueError, match=r"the state that learner\.update_normalizers gives must be finite"):
        testing.check_learner(make, ENV, SMALL)


def test_a_place_is_told_wherever_the_code_lies(tmp_path, monkeypatch):
    """In a folder that is called as a library is, too."""
    folder = tmp_path / "jax" / "mjx_dher"
    folder.mkdir(parents=True)
    (folder / "lies_in_jax.py").write_text("def sampler(achieved, desired, step, hparams):\n    return achieved.nothing\n")
    monkeypatch.syspath_prepend(folder)
    with pytest.raises(ValueError, match=r"AttributeError: .*lies_in_jax.py, line 2\)"):
        testing.check_sampler("lies_in_jax:sampler", ENV)
