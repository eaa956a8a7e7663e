"""Contrastive RL: losses and energies by hand, a known optimum, goals of the batch, lanes, rejected settings."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import LEARNS, TINY
from conftest import refuses

from mjx_dher import HParams, learners, make_train, networks, priorities, relabel, replay, samplers
from mjx_dher.context import Context
from mjx_dher.learners import crl
from mjx_dher.networks import Encoders, Style
from mjx_dher.policy import Policy
from mjx_dher.types import Batch, Episode
from point_mass import PointMass
from probes import spec_of

SPEC, ONE = spec_of(2, 2, 2), spec_of(1, 1, 1)
LOGITS = np.log(np.array([[1.0, 3.0, 4.0], [2.0, 2.0, 4.0], [1.0, 1.0, 2.0]]))
KEY = jax.random.key(0)


@pytest.mark.parametrize(
    ("loss", "penalty", "expected"),
    [
        # Shares of the diagonal in its row: 1/8, 2/8, 2/4; in its column: 1/4, 2/6, 2/10. Sums of rows: 8, 8, 4.
        ("forward", 0.0, np.log(8 * 4 * 2) / 3),
        ("backward", 0.0, np.log(4 * 3 * 5) / 3),
        ("symmetric", 0.0, np.log(8 * 4 * 2 * 4 * 3 * 5) / 3),
        ("forward", 0.3, np.log(8 * 4 * 2) / 3 + 0.3 * (2 * np.log(8) ** 2 + np.log(4) ** 2) / 3),
        ("backward", 0.3, np.log(4 * 3 * 5) / 3 + 0.3 * (2 * np.log(8) ** 2 + np.log(4) ** 2) / 3),
    ],
)
def test_info_nce_by_hand(loss, penalty, expected):
    np.testing.assert_allclose(crl.info_nce(jnp.asarray(LOGITS), loss, penalty), expected, rtol=1e-6)


def test_the_gradient_of_info_nce_is_a_softmax_less_the_pairs():
    """Of `forward`: (p - I) / B, and of the penalty 2 c logsumexp p / B, with p the softmax of each row."""
    gradient = jax.grad(lambda logits: crl.info_nce(logits, "forward", 0.3))(jnp.asarray(LOGITS))
    rows = np.exp(LOGITS).sum(1, keepdims=True)
    share = np.exp(LOGITS) / rows
    np.testing.assert_allclose(gradient, (share - np.eye(3) + 0.6 * np.log(rows) * share) / 3, rtol=1e-5, atol=1e-7)
    by_columns = jax.grad(lambda logits: crl.info_nce(logits, "backward", 0.0))(jnp.asarray(LOGITS))
    np.testing.assert_allclose(by_columns, (np.exp(LOGITS) / np.exp(LOGITS).sum(0) - np.eye(3)) / 3, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "expected"), [("norm", -np.sqrt(8 + 1e-6)), ("l2", -8.0), ("dot", 11.0), ("cosine", 11 / np.sqrt(5 * 25))]
)
def test_energies_by_hand(name, expected):
    phi, psi = jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])
    np.testing.assert_allclose(crl.energy(name, phi, psi), expected, rtol=1e-5)
    phi, psi = jax.random.normal(KEY, (2, 5, 3))
    energy = jax.jit(functools.partial(crl.energy, name))
    one_by_one = [[energy(x, y) for y in psi] for x in phi]
    np.testing.assert_allclose(crl.energies(name, phi, psi), one_by_one, rtol=1e-4, atol=1e-5)
    gradient = jax.jit(jax.grad(lambda x: crl.energies(name, x, phi * jnp.arange(5)[:, None]).sum()))(phi)
    assert np.all(np.isfinite(gradient))  # also where a distance, or a length, is 0


def made(spec=SPEC, network="mlp", **changes):
    return learners.make("crl", dataclasses.replace(TINY, **{"hidden_sizes": (16, 16), **changes}), spec, network)


def pairs(action, goal, row=None):
    """Transitions of a state that never changes, whose hindsight goal is the desired one, too."""
    number = len(action)
    ones = jnp.ones((number, 1))
    row = jnp.arange(number) if row is None else row
    return Batch(ones, ones, goal, action, jnp.zeros(number), jnp.ones(number), row, hindsight_goal=goal)


def test_other_goals_of_an_episode_are_left_out_if_masked():
    state = jax.jit(made(ONE).init)(KEY)
    batch = pairs(jnp.array([[0.1], [0.2], [0.3]]), jnp.array([[1.0], [2.0], [3.0]]), jnp.array([5, 7, 5]))
    inputs = state.params.critic, batch.observation, batch.desired_goal, batch
    whole, masked = (jax.jit(learner.logits)(*inputs) for learner in (made(ONE), made(ONE, same_episode="masked")))
    assert np.all(np.isfinite(whole))
    np.testing.assert_array_equal(np.isinf(masked), [[0, 0, 1], [0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(np.where(np.isinf(masked), whole, masked), whole)


@pytest.mark.parametrize("loss", ["forward", pytest.param("symmetric", marks=pytest.mark.slow)])
def test_the_critic_learns_how_much_likelier_an_action_makes_a_goal_and_the_actor_follows(loss):
    """An action of 1 or -1 leads to the goal of its sign four times in five: the energies' difference becomes log 4."""
    learner = made(ONE, contrastive_loss=loss, energy="dot", representation_size=4)
    hparams = HParams(critic_lr=3e-3, actor_lr=3e-3, logsumexp_penalty=0.0, action_l2=0.0, entropy_weight=0.01)

    def step(state, key):
        action_key, goal_key = jax.random.split(key)
        action = jax.random.rademacher(action_key, (128, 1), jnp.float32)
        goal = action * jnp.where(jax.random.uniform(goal_key, (128, 1)) < 0.8, 1.0, -1.0)
        return learner.update(state, pairs(action, goal), hparams)

    state, metrics = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys))(
        jax.jit(learner.init)(KEY), jax.random.split(jax.random.key(1), 400)
    )
    signs = jnp.array([[1.0], [-1.0]])
    logits = np.asarray(jax.jit(learner.logits)(state.params.critic, jnp.ones((2, 1)), signs, pairs(signs, signs)))
    np.testing.assert_allclose([logits[0, 0] - logits[0, 1], logits[1, 1] - logits[1, 0]], np.log(4), atol=0.3)
    # What remains of the loss is log B less the mutual information, log 2 less the entropy of (0.8, 0.2).
    information = np.log(2) + 0.8 * np.log(0.8) + 0.2 * np.log(0.2)
    times = 2 if loss == "symmetric" else 1
    np.testing.assert_allclose(metrics["critic_loss"][-100:].mean(), times * (np.log(128) - information), atol=0.05)
    actions = learner.act(state, {"observation": jnp.ones((2, 1)), "desired_goal": signs, "achieved_goal": signs}, hparams)
    assert np.all(np.sign(actions) == signs)


def test_the_critic_learns_from_the_sampler_s_goals_and_the_actor_from_the_batch_s():
    learner, hparams = made(ONE), HParams()
    state = learner.init(KEY)
    batch = pairs(jnp.array([[0.5], [-0.5]]), jnp.array([[1.0], [2.0]]))
    update = jax.jit(learner.update)
    base, played = update(state, batch, hparams)[0], update(state, batch.replace(desired_goal=-batch.desired_goal), hparams)[0]
    achieved = update(state, batch.replace(hindsight_goal=-batch.desired_goal), hparams)[0]
    same = lambda a, b: all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))  # noqa: E731
    assert same(base.params.critic, played.params.critic)
    assert not same(base.params.actor, played.params.actor)
    assert same(base.params.actor, achieved.params.actor)
    assert not same(base.params.critic, achieved.params.critic)
    with refuses("hindsight_goal", "crl"):
        learner.update(state, batch.replace(hindsight_goal=None), hparams)


def test_a_batch_has_the_sampler_s_goal_whether_or_not_it_is_taken():
    achieved = jnp.arange(6.0)[:, None]
    episode = Episode(achieved, achieved, jnp.array([9.0]), jnp.zeros((5, 1)))

    @jax.jit
    def draw(episode, k):
        ring = replay.add(replay.init(episode, 1), jax.tree.map(lambda x: x[None], episode))
        sample = replay.sample(ring, KEY, 64)
        context = Context(lambda achieved, desired: -jnp.ones(len(desired)), HParams(her_k=k))
        return sample, relabel.relabel(sample, "geometric", context, KEY).batch

    for k, own in ((0.0, True), (jnp.inf, False)):
        sample, batch = draw(episode, k)
        assert np.all(batch.hindsight_goal[:, 0] > sample.step)
        assert np.all(batch.desired_goal == 9.0) if own else np.all(batch.desired_goal == batch.hindsight_goal)


def test_geometric_by_hand():
    hparams = HParams(gamma=0.5)
    weights = samplers.weigh(samplers.make("geometric"), jnp.zeros((5, 3)), jnp.zeros(3), jnp.int32(1), hparams)
    np.testing.assert_allclose(samplers.probabilities(weights), np.array([0, 0, 4, 2, 1]) / 7, rtol=1e-6)
    ended = samplers.weigh(
        samplers.make("geometric"), jnp.zeros((5, 3)), jnp.zeros(3), jnp.int32(1), hparams, length=jnp.int32(3)
    )
    np.testing.assert_allclose(samplers.probabilities(ended), np.array([0, 0, 2, 1, 0]) / 3, rtol=1e-6)
    nearest = samplers.weigh(samplers.make("geometric"), jnp.zeros((5, 3)), jnp.zeros(3), jnp.int32(1), HParams(gamma=0.0))
    np.testing.assert_allclose(samplers.probabilities(nearest), [0, 0, 1, 0, 0], atol=1e-20)


@pytest.mark.slow  # compiles the loop twice
def test_a_lane_is_that_run_alone_and_what_it_learns_is_exported():
    learner = made(representation_size=4)
    program = make_train(PointMass(), TINY, sampler=samplers.make("geometric"), learner=learner)
    states = jax.jit(jax.vmap(program.init, in_axes=(0, None)))(jax.random.split(KEY), HParams())
    alone = jax.tree.map(lambda x: x[1], states)
    states, metrics = jax.jit(jax.vmap(program.epoch))(states)
    alone, one = jax.jit(program.epoch)(alone)
    for name, value in one.items():
        np.testing.assert_allclose(metrics[name][1], value, rtol=1e-3, atol=1e-5, err_msg=name)
    assert {"accuracy", "energy_mean", "critic_loss", "actor_loss", "entropy"} <= one.keys()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1], b, rtol=1e-3, atol=1e-4), states.learner, alone.learner)
    policy = learner.export(jax.device_get(alone.learner), HParams())
    assert isinstance(policy, Policy)
    obs = {"observation": np.ones((3, 2), np.float32), "desired_goal": np.zeros((3, 2), np.float32)}
    np.testing.assert_allclose(policy(obs), learner.act(alone.learner, obs, HParams()), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("network", "sizes"), [("mlp", (32, 32)), ("residual", (32,) * 6)])
def test_the_point_mass_is_learned(network, sizes):
    learner = learners.make("crl", dataclasses.replace(LEARNS, hidden_sizes=sizes, policy_delay=2), SPEC, network)
    program = make_train(PointMass(), LEARNS, sampler=samplers.make("geometric"), learner=learner)
    hparams = HParams(gamma=0.9, action_l2=0.0, random_eps=0.1)
    state, epoch = jax.jit(program.init)(KEY, hparams), jax.jit(program.epoch)
    for _ in range(7):
        state, metrics = epoch(state)
    assert float(metrics["success_rate"]) > 0.9


def plain(action_size, hidden_sizes, dtype, heads=networks.PLAIN):
    """Makes networks whose critic has no encoders."""
    return networks.mlp(action_size, hidden_sizes, dtype, heads._replace(representation=None))


def test_what_does_not_combine_is_rejected():
    with refuses("n_step", "crl", 3):
        made(n_step=3)
    with refuses("learner", "crl", "heads"):
        made(network=lambda action_size, hidden_sizes, dtype: networks.mlp(2, (8,)))
    with refuses("critic", "crl"):
        made(network=plain)
    with refuses("value", "CRL"):
        make_train(PointMass(), TINY, learner=made(), priority=priorities.make("td_error"))


def test_residual_networks_by_hand():
    """Four layers: the first, a pair with a skip connection around it, and one more; swish after layer normalization."""
    network = Encoders((4,) * 4, jnp.float32, 3, Style(layer_norm=True, residual=True))
    params = jax.jit(network.init)(KEY, *(jnp.zeros(2) for _ in range(3)))
    inputs = [jax.random.normal(jax.random.key(i), (5, 2)) for i in range(3)]
    layers = jax.tree.map(np.asarray, params["params"]["psi"])

    def layer(x, i):
        x = x @ layers[f"Dense_{i}"]["kernel"] + layers[f"Dense_{i}"]["bias"]
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
        x = x * layers[f"LayerNorm_{i}"]["scale"] + layers[f"LayerNorm_{i}"]["bias"]
        return x / (1 + np.exp(-x))

    first = layer(np.asarray(inputs[1]), 0)
    second = layer(layer(first, 1), 2) + first
    expected = layer(second, 3) @ layers["Dense_4"]["kernel"] + layers["Dense_4"]["bias"]
    np.testing.assert_allclose(jax.jit(network.apply)(params, *inputs)[1], expected, rtol=1e-4, atol=1e-5)
    with refuses("hidden_sizes", (8, 4)):
        networks.residual(2, (8, 4))
    learner = made(network="residual")
    assert learner.export(jax.jit(learner.init)(KEY), HParams()) is None  # a Policy has neither swish nor normalization
