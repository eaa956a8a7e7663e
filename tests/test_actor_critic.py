"""The update that td3, sac, redq, tqc and dtqc share: targets by hand, problems with known answers, lanes, delays."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import LEARNS
from conftest import refuses

from mjx_dher import HParams, learners, make_train, networks
from mjx_dher.learners import critics
from mjx_dher.learners.actor_critic import ActorCritic
from mjx_dher.learners.actors import Deterministic
from mjx_dher.learners.critics import Critics
from mjx_dher.learners.gaussian import Gaussian
from mjx_dher.networks import Networks
from mjx_dher.policy import Policy
from mjx_dher.types import Batch
from point_mass import PointMass
from probes import BATCH, LinearActor, spec_of

NAMES = ("td3", "sac", "csac", "ctd3", "redq", "tqc", "dtqc")


def at_night(*names):
    """All learners; those that are not among `names` with the slow tests."""
    return [pytest.param(name, marks=() if name in names else pytest.mark.slow) for name in NAMES]


SPEC = spec_of(2, 2, 2)
SMALL = dataclasses.replace(LEARNS, num_critics=3, num_quantiles=5, dropped_quantiles=1, eval_episodes=100)
HP = HParams(gamma=0.5, action_l2=0.0, target_noise=0.0, entropy_weight=0.25)


class Moments(nn.Module):
    """Mean w * observation, standard deviation 1/2."""

    @nn.compact
    def __call__(self, observation, goal):
        mean = self.param("w", nn.initializers.constant(1.0), ()) * observation
        return mean, jnp.full_like(mean, jnp.log(0.5))


class LinearCritic(nn.Module):
    """Quantiles a * observation + b * goal + c * action + d * m."""

    size: int

    @nn.compact
    def __call__(self, observation, goal, action):
        abcd = self.param("abcd", lambda _: jnp.array([-0.5, 0.25, 0.5, 0.1]))
        value = abcd[0] * observation + abcd[1] * goal + abcd[2] * action
        return value + abcd[3] * jnp.arange(self.size)


Q = np.array([-0.25, -2 + 0.5 * np.tanh(2)])  # of the next states, where the policy is tanh: see test_ddpg.py


def linear(actor, parts):
    """A learner of these networks; its second critic thinks less of everything by 1/2, by a goal's weight of 1/2 and 3/8."""
    module = Networks(LinearActor() if isinstance(actor, Deterministic) else Moments(), LinearCritic(parts.size))
    learner = ActorCritic(spec_of(1, 1, 1), module, module, actor, critics=parts)
    state = jax.jit(learner.init)(jax.random.key(0))
    lower = {"params": {"abcd": state.target.critic["params"]["abcd"].at[1, 1].add(0.125)}}
    return learner, dataclasses.replace(state, target=dataclasses.replace(state.target, critic=lower))


SECOND = np.array([-0.125, -0.5])  # what the second critic adds: 1/8 of the goal


@pytest.mark.parametrize(("size", "combine"), [(1, critics.smallest), (1, critics.smallest_of(2))])
def test_the_target_of_the_smaller_critic_by_hand(size, combine):
    learner, state = linear(Deterministic(), Critics(2, size, combine, critics.squared_error, critics.lowest))
    got = jax.jit(learner.target)(state, BATCH, HP, jax.random.key(1))
    np.testing.assert_allclose(got[:, 0], [-1 + 0.5 * (Q[0] + SECOND[0]), 0.5 * (Q[1] + SECOND[1])], rtol=1e-6)


def test_the_target_of_truncated_quantiles_by_hand():
    """Of six quantiles, three a critic and 0.1 apart, the two largest are dropped: both of the first critic, or one of each."""
    learner, state = linear(Deterministic(), Critics(2, 3, critics.truncated(1), critics.quantile_huber, critics.mean))
    got = jax.jit(learner.target)(state, BATCH, HP, jax.random.key(1))
    steps = np.array([0.0, 0.1, 0.2])
    for i, reward in enumerate((-1.0, 0.0)):
        pooled = np.sort(np.concatenate([Q[i] + steps, Q[i] + SECOND[i] + steps]))[:4]
        np.testing.assert_allclose(got[i], np.minimum(reward + 0.5 * pooled, 0), rtol=1e-5)


def test_the_target_of_a_soft_value_takes_off_alpha_log_pi():
    parts = Critics(2, 1, critics.smallest, critics.squared_error, critics.lowest)
    learner, state = linear(Gaussian(), parts)
    draws = jax.jit(jax.vmap(lambda key: learner.target(state, BATCH, HP, key)))(jax.random.split(jax.random.key(1), 20_000))
    u = np.array([0.0, 2.0])[:, None] + 0.5 * np.random.default_rng(0).normal(size=(2, 200_000))
    log_pi = -0.5 * ((u.T - [0.0, 2.0]) / 0.5) ** 2 - np.log(0.5 * np.sqrt(2 * np.pi)) - np.log1p(-(np.tanh(u.T) ** 2))
    values = np.array([-0.25 - 0.125, -2.0 - 0.5]) + 0.5 * np.tanh(u.T)
    expected = np.clip([-1.0, 0.0] + 0.5 * (values - 0.25 * log_pi), -2.0, 0.0).mean(0)
    np.testing.assert_allclose(draws.mean(axis=(0, 2)), expected, atol=0.005)


@pytest.mark.parametrize(("reward", "clipped"), [(-9.0, -2.0), (9.0, 0.0)])
def test_targets_are_clipped_to_what_returns_can_be(reward, clipped):
    learner, state = linear(Deterministic(), Critics(2, 1, critics.smallest, critics.squared_error, critics.lowest))
    got = jax.jit(learner.target)(state, BATCH.replace(reward=jnp.full(2, reward)), HP, jax.random.key(1))
    np.testing.assert_array_equal(got, [[clipped], [clipped]])


def test_a_target_takes_its_actions_from_the_slower_actor():
    learner, state = linear(Deterministic(), Critics(2, 1, critics.smallest, critics.squared_error, critics.lowest))
    quick = dataclasses.replace(state.params, actor={"params": {"w": jnp.float32(-1.0)}})
    moved = dataclasses.replace(state, params=quick)
    key = jax.random.key(1)
    target_of = jax.jit(learner.target)
    np.testing.assert_array_equal(target_of(moved, BATCH, HP, key), target_of(state, BATCH, HP, key))
    target = jax.jit(learner.update_target)(moved, HP._replace(polyak=0.75)).target
    np.testing.assert_allclose(target.actor["params"]["w"], 0.5)


def test_an_update_of_the_critics_leaves_the_actor_and_a_whole_one_judges_by_the_new_critics():
    parts = Critics(2, 1, critics.smallest, critics.squared_error, critics.lowest, num_judges=1)
    learner, state = linear(Deterministic(), parts)
    hparams = HP._replace(critic_lr=2.0, actor_lr=0.1)
    after, metrics = jax.jit(functools.partial(learner.update, with_actor=False))(state, BATCH, hparams)
    assert after.params.actor == state.params.actor
    assert metrics.keys() == {"critic_loss", "q_mean"}
    whole, metrics = jax.jit(learner.update)(state, BATCH, hparams)
    jax.tree.map(np.testing.assert_array_equal, whole.params.critic, after.params.critic)
    assert metrics.keys() == {"critic_loss", "q_mean", "actor_loss"}
    # Adam's first step is that of the gradient's sign: the first critic's weight of actions, 0.5, has become -1.5 or 2.5.
    weight = float(after.params.critic["params"]["abcd"][0, 2])
    assert abs(weight - 0.5) > 1.9
    step = float(whole.params.actor["params"]["w"] - state.params.actor["params"]["w"])
    np.testing.assert_allclose(step, 0.1 * np.sign(weight), rtol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, whole.target, state.target)
    assert (int(after.num_updates), int(whole.num_updates)) == (1, 1)


def made(name, **changes):
    config = dataclasses.replace(SMALL, **changes)
    return learners.make(name, config, SPEC, "layer_norm"), config


@pytest.mark.parametrize(
    ("name", "judging"), [("td3", 1), ("ctd3", 1), ("sac", 3), ("csac", 3), ("redq", 3), ("tqc", 3), ("dtqc", 3)]
)
def test_the_actor_of_td3_in_both_forms_is_judged_by_the_first_critic(name, judging):
    learner, _ = made(name)
    judges = jax.eval_shape(lambda key: learner.critics.judges(learner.init(key).params.critic), jax.random.key(0))
    assert {x.shape[0] for x in jax.tree.leaves(judges)} == {judging}


@pytest.mark.slow  # the soft value is the same way
@pytest.mark.parametrize("name", ["dtqc", "td3", "ctd3"])
def test_critics_learn_a_known_value(name):
    """A chain whose every step costs 1 and leads to itself: Q = -1 / (1 - gamma) = -5, whatever the action."""
    learner, _ = made(name)
    hparams = HParams(gamma=0.8, polyak=0.9, critic_lr=0.003)
    np.testing.assert_allclose(learned_value(learner, 5000)(hparams), -5.0, atol=0.1)  # ctd3 had NaN after 2,000


@pytest.mark.parametrize("name", ["sac", *(pytest.param(name, marks=pytest.mark.slow) for name in ("redq", "tqc"))])
def test_critics_learn_a_known_soft_value(name):
    """The same chain, for a policy that stays as it is: Q = (-1 - gamma alpha E log pi) / (1 - gamma), or -5 without pay."""
    learner, _ = made(name, dropped_quantiles=0)  # the pay is noise to a critic, whose largest quantiles count here, too
    hparams = HParams(gamma=0.8, polyak=0.9, critic_lr=0.003, actor_lr=0.0, entropy_weight=0.3)
    state = jax.jit(learner.init)(jax.random.key(0))
    ones = jnp.ones((20_000, 2))
    obs = {"observation": ones, "desired_goal": ones, "achieved_goal": ones}

    @jax.jit
    def costs(state, key):
        inputs = learner.normalize(state, obs["observation"], obs["desired_goal"], hparams)
        normal = jax.random.normal(key, (20_000, 2))
        return learner.actor.next_action(learner.networks.actor, state.params.actor, *inputs, normal, hparams)[1]

    cost = costs(state, jax.random.key(3))
    expected = (-1.0 - 0.8 * float(cost.mean())) / (1 - 0.8)
    assert expected > -4.8  # the pay is to be seen
    both = jax.tree.map(lambda *x: jnp.array(x, jnp.float32), hparams, hparams._replace(entropy_weight=0.0))
    paid, unpaid = jax.vmap(learned_value(learner))(both)  # side by side
    np.testing.assert_allclose(paid, expected, atol=0.15)
    np.testing.assert_allclose(unpaid, -5.0, atol=0.1)


def batch_of(action, reward, hparams):
    """Transitions of a state that never changes."""
    ones = jnp.ones((len(reward), 2))
    return Batch(ones, ones, ones, action, reward, jnp.full(len(reward), hparams.gamma), jnp.arange(len(reward)))


def learned_value(learner, updates=600):
    """Returns a function of HParams: the value that the critics come to in the chain."""

    @jax.jit
    def value(hparams):
        def step(state, key):
            action = jax.random.uniform(key, (32, 2), minval=-1, maxval=1)
            state, losses = learner.update(state, batch_of(action, -jnp.ones(32), hparams), hparams)
            return learner.update_target(state, hparams), losses["q_mean"]

        _, values = jax.lax.scan(step, learner.init(jax.random.key(0)), jax.random.split(jax.random.key(1), updates))
        return values[-100:].mean()

    return value


@pytest.mark.parametrize("name", at_night("dtqc"))
def test_the_best_action_of_a_bandit_is_found(name):
    """The reward is -|a - 0.5| / 4 for each number of the action, and the next state is worth the same as all others."""
    learner, _ = made(name)
    hparams = HParams(gamma=0.0, action_l2=0.0, entropy_weight=0.01, critic_lr=0.003, actor_lr=0.003)
    state = jax.jit(learner.init)(jax.random.key(0))

    def step(state, key):
        action = jax.random.uniform(key, (64, 2), minval=-1, maxval=1)
        reward = -jnp.sum(jnp.abs(action - 0.5), axis=-1) / 4
        state, losses = learner.update(state, batch_of(action, reward, hparams), hparams)
        return learner.update_target(state, hparams), losses

    state, _ = jax.jit(lambda *args: jax.lax.scan(step, *args))(state, jax.random.split(jax.random.key(1), 800))
    one = jnp.ones((1, 2))
    obs = {"observation": one, "desired_goal": one, "achieved_goal": one}
    np.testing.assert_allclose(jax.jit(learner.act)(state, obs, hparams)[0], [0.5, 0.5], atol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_point_mass_is_learned_and_a_lane_is_that_run_alone(name):
    learner, config = made(name, policy_delay=2)
    hparams = HParams(gamma=0.9, polyak=0.9, action_l2=0.1, entropy_weight=0.03, noise_std=0.2)
    if not learner.actor.has_target:
        hparams = hparams._replace(action_l2=0.0, random_eps=0.1)
    program = make_train(PointMass(), config, learner=learner)
    lanes = jax.tree.map(lambda x: jnp.full(2, x, jnp.float32), hparams)
    states = jax.jit(jax.vmap(program.init))(jax.random.split(jax.random.key(0)), lanes)
    alone = jax.tree.map(lambda x: x[1], states)
    epoch, epochs = jax.jit(program.epoch), jax.jit(jax.vmap(program.epoch))
    for number in range(7):
        states, metrics = epochs(states)
        if number < 2:
            alone, one = epoch(alone)
            for key in ("critic_loss", "q_mean", "actor_loss", "train_return_mean"):
                np.testing.assert_allclose(metrics[key][1], one[key], rtol=2e-3, atol=1e-5, err_msg=key)
    assert int(alone.learner.num_updates) == 200
    assert float(metrics["success_rate"].min()) > 0.9
    assert float(metrics["reset_success_rate"].max()) < 0.3
    policy = learner.export(jax.device_get(jax.tree.map(lambda x: x[0], states.learner)), hparams)
    assert isinstance(policy, Policy)


@pytest.mark.parametrize(
    ("delay", "period", "expected"),
    [
        (3, 1, "cT cT uT cT cT uT cT cT uT cT cT uT"),
        (2, 4, "c u c uT c u c uT c u c uT"),
        pytest.param(1, 1, "uT uT uT uT uT uT uT uT uT uT uT uT", marks=pytest.mark.slow),
        pytest.param(4, 2, "c cT c uT c cT c uT c cT c uT", marks=pytest.mark.slow),
        pytest.param(2, 2, "c uT c uT c uT c uT c uT c uT", marks=pytest.mark.slow),
    ],
)
def test_delays_move_targets_and_actor_when_they_are_due(delay, period, expected):
    """What is called in 12 updates, for delays and periods that divide one another; a learner writes it down."""
    config = dataclasses.replace(
        SMALL, updates_per_cycle=12, cycles_per_epoch=1, target_period=period, policy_delay=delay, num_critics=1
    )
    assert calls(config) == expected.split()


def calls(config):
    """Returns the updates of a cycle: u (whole) or c (of critics), with T where the targets move after it."""
    learner = learners.make("td3", config, SPEC, "mlp")

    class Noting(ActorCritic):
        """Notes in the first numbers of `key` that a step was made; nothing is learned."""

        def init(self, key):
            return {"log": jnp.zeros(100, jnp.int32), "at": jnp.int32(0), "state": super().init(key)}

        def note(self, state, code, forward=1):
            at = state["at"] + forward
            return {**state, "log": state["log"].at[at - 1].add(code), "at": at}

        def update(self, state, batch, hparams, with_actor=True):
            return self.note(state, 1 if with_actor else 2), {"loss": jnp.float32(0)}

        def update_target(self, state, hparams):
            return self.note(state, 10, forward=0)

        def act(self, state, obs, hparams):
            return super().act(state["state"], obs, hparams)

        def explore(self, state, obs, noise, hparams):
            return super().explore(state["state"], obs, noise, hparams)

        def update_normalizers(self, state, observation, goal, hparams, valid):
            return state

        def summary(self, state):
            return {}

    noting = Noting(**{field.name: getattr(learner, field.name) for field in dataclasses.fields(learner)})
    program = make_train(PointMass(), config, learner=noting)
    state, _ = jax.jit(program.epoch)(jax.jit(program.init)(jax.random.key(0), HParams()))
    names = {0: "", 1: "u", 2: "c", 11: "uT", 12: "cT"}
    return [names[int(code)] for code in state.learner["log"] if code]


def seven(action_size, hidden_sizes, dtype, heads=networks.PLAIN):
    """Makes networks whose critic gives seven numbers, whatever it is asked for."""
    return networks.mlp(action_size, hidden_sizes, dtype, heads._replace(critic_size=7))


def test_what_does_not_combine_is_refused_by_name():
    for name in NAMES:
        with refuses("learner", name, "networks", "heads"):
            learners.make(name, SMALL, SPEC, lambda action_size, hidden_sizes, dtype: networks.mlp(2, (8,)))
        with refuses("learner", name, "critic"):
            learners.make(name, SMALL, SPEC, seven)
    with refuses("dropped_quantiles", "num_quantiles", 5):
        made("tqc", dropped_quantiles=5)
    with refuses("subset_critics", "num_critics", 3, 4):
        made("redq", subset_critics=4)
    with refuses("reset_every", "updates_per_cycle", SMALL.updates_per_cycle, 30):
        made("sac", reset_every=30)
    with refuses("reward_range", "csac"):
        learners.make("csac", SMALL, dataclasses.replace(SPEC, reward_range=(-np.inf, 0.0)))


def test_resets_draw_new_networks_when_they_are_due_and_keep_the_normalizers():
    learner = learners.make("sac", dataclasses.replace(SMALL, hidden_sizes=(4,), reset_every=40), SPEC)
    state, obs, goal = jax.jit(learner.init)(jax.random.key(0)), jnp.ones((3, 2, 2)), jnp.ones((5, 2))
    kernel = lambda state: state.params.critic["params"]["Dense_0"]["kernel"]  # noqa: E731
    reset = jax.jit(lambda state: learner.update_normalizers(state, obs, goal, HP, jnp.ones(3, bool)))
    after = {n: reset(dataclasses.replace(state, num_updates=jnp.int32(n))) for n in (0, 20, 40, 80)}
    assert np.array_equal(kernel(after[0]), kernel(state))
    assert np.array_equal(kernel(after[20]), kernel(state))
    assert not np.array_equal(kernel(after[40]), kernel(state))
    assert not np.array_equal(kernel(after[40]), kernel(after[80]))
    for n, later in after.items():
        assert (float(later.goal_norm.count), int(later.num_updates)) == (5.0, n)
        np.testing.assert_array_equal(later.target.critic["params"]["Dense_0"]["kernel"], kernel(later))


@pytest.mark.parametrize(("delay", "period"), [(3, 2), (40, 1), (3, 4)])
def test_a_delay_that_no_round_has_is_refused(delay, period):
    config = dataclasses.replace(SMALL, policy_delay=delay, target_period=period)
    with refuses("policy_delay", "target_period", delay):
        make_train(PointMass(), config)
