"""Actors: how they act, explore, and are paid, beside numbers by hand."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from mjx_dher.config import HParams
from mjx_dher.learners.actors import Deterministic
from mjx_dher.learners.gaussian import Gaussian, sample_action
from mjx_dher.networks import Actor, GaussianActor

KEY = jax.random.key(0)
HP = HParams(target_noise=0.3, target_noise_clip=0.2, action_l2=0.0, entropy_weight=0.5, entropy_target=-2.0)


class Straight(nn.Module):
    """A deterministic actor that gives its observation."""

    @nn.compact
    def __call__(self, observation, goal):
        return observation


class Fixed(nn.Module):
    """A Gaussian actor with parameters for its moments, whatever it sees."""

    @nn.compact
    def __call__(self, observation, goal):
        shape = observation.shape
        mean, log_std = (self.param(name, nn.initializers.zeros, ()) for name in ("mean", "log_std"))
        return jnp.full(shape, mean), jnp.full(shape, log_std)


def gaussian(mean, std, log_alpha=0.0):
    network = {"params": {"mean": jnp.float32(mean), "log_std": jnp.float32(np.log(std))}}
    return {"network": network, "log_alpha": jnp.float32(log_alpha)}


def zeros(*shape):
    return jnp.zeros(shape)


def normal(*shape):
    return jax.random.normal(KEY, shape)


@functools.partial(jax.jit, static_argnums=(1, 2))
def draw(params, number, size=2):
    """Actions of as many states, and their log probabilities."""
    return sample_action(Fixed(), params, zeros(number, size), zeros(number, 1), normal(number, size))


def test_a_target_s_actions_are_smoothed_within_bounds():
    actions = jnp.tile(jnp.array([[0.0, 0.95]]), (20_000, 1))
    smooth = jax.jit(lambda: Deterministic().next_action(Straight(), {}, actions, zeros(20_000, 1), normal(20_000, 2), HP))
    smoothed, cost = jax.device_get(smooth())
    assert not cost.any()
    noise = np.asarray(smoothed[:, 0])
    assert np.abs(noise).max() == pytest.approx(0.2)
    # A normal deviate beyond 2/3 of its standard deviation is clipped.
    clipped = 2 * scipy.stats.norm.cdf(-2 / 3)
    assert abs((np.abs(noise) > 0.1999).mean() - clipped) < 0.015
    assert float(smoothed[:, 1].max()) == 1.0


def test_a_deterministic_actor_s_loss_by_hand():
    judge = lambda action: action[:, 0] - 2 * action[:, 1]  # noqa: E731
    loss, metrics = Deterministic().loss(
        Straight(), {}, jnp.array([[0.5, 0.1], [-0.5, 0.3]]), zeros(2, 1), judge, normal(2, 2), HP._replace(action_l2=0.5)
    )
    np.testing.assert_allclose(loss, 0.4 + 0.5 * (0.25 + 0.01 + 0.25 + 0.09) / 4, rtol=1e-6)
    assert metrics == {}


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.7, 0.3), (-3.0, 2.0)])
def test_log_probabilities_are_those_of_a_gaussian_under_tanh(mean, std):
    actions, log_prob = draw(gaussian(mean, std), 500)
    u = np.arctanh(np.clip(np.asarray(actions, np.float64), -1 + 1e-12, 1 - 1e-12))
    inside = (np.abs(actions) < 0.999).all(-1)  # where float32 still tells actions apart
    expected = (scipy.stats.norm.logpdf(u, mean, std) - np.log1p(-(np.tanh(u) ** 2))).sum(-1)
    np.testing.assert_allclose(log_prob[inside], expected[inside], rtol=1e-3, atol=2e-3)
    assert np.isfinite(log_prob).all()


def test_the_entropy_is_that_of_the_density():
    """By quadrature over the actions of one number, for mean 0.5 and standard deviation 0.8."""
    a = np.linspace(-1, 1, 200_001)[1:-1]
    density = scipy.stats.norm.pdf(np.arctanh(a), 0.5, 0.8) / (1 - a**2)
    np.testing.assert_allclose(np.trapezoid(density, a), 1.0, atol=1e-3)
    entropy = -np.trapezoid(density * np.log(density + 1e-300), a)
    _, log_prob = draw(gaussian(0.5, 0.8), 40_000, 1)
    assert abs(-float(log_prob.mean()) - entropy) < 4 * float(log_prob.std()) / np.sqrt(40_000)


def test_far_out_log_probabilities_stay_finite():
    wide = {"network": {"params": {"mean": jnp.float32(30.0), "log_std": jnp.float32(50.0)}}, "log_alpha": jnp.float32(0)}
    value, gradient = jax.value_and_grad(lambda params: draw(params, 64)[1].mean())(wide)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))
    assert gradient["network"]["params"]["log_std"] == 0  # beyond its bound


def test_a_gaussian_actor_s_target_costs_alpha_log_pi():
    params = gaussian(0.3, 0.5, log_alpha=np.log(4.0))
    judged = lambda params: Gaussian().next_action(Fixed(), params, zeros(16, 2), zeros(16, 1), normal(16, 2), HP)  # noqa: E731
    action, cost = jax.jit(judged)(params)
    drawn, log_prob = jax.device_get(draw(params, 16))
    np.testing.assert_allclose(action, drawn, rtol=1e-6)
    np.testing.assert_allclose(cost, 0.5 * 4.0 * log_prob, rtol=1e-6)


def test_a_gaussian_actor_s_loss_by_hand():
    params, judge = gaussian(0.3, 0.5, log_alpha=np.log(4.0)), lambda action: 3.0 * action[:, 0]
    arguments = zeros(16, 2), zeros(16, 1)
    loss_of = lambda params: Gaussian().loss(Fixed(), params, *arguments, judge, normal(16, 2), HP)  # noqa: E731
    (loss, metrics), gradient = jax.jit(jax.value_and_grad(loss_of, has_aux=True))(params)
    action, log_prob = jax.device_get(draw(params, 16))
    target = -2.0 * 2  # entropy_target for each of two numbers
    expected = (2.0 * log_prob - 3.0 * action[:, 0]).mean() - np.log(4.0) * (log_prob.mean() + target)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    np.testing.assert_allclose(gradient["log_alpha"], -(log_prob.mean() + target), rtol=1e-5)
    np.testing.assert_allclose([metrics["entropy_weight"], metrics["entropy"]], [2.0, -log_prob.mean()], rtol=1e-6)


@pytest.mark.parametrize(("std", "sign"), [(0.01, -1), (1.0, 1)])
def test_the_weight_of_entropy_rises_where_there_is_too_little(std, sign):
    """Gradient descent raises log_alpha where its gradient is below 0: at entropies under the target."""
    arguments = zeros(99, 2), zeros(99, 1), lambda a: a[:, 0], normal(99, 2), HP
    gradient = jax.jit(jax.grad(lambda params: Gaussian().loss(Fixed(), params, *arguments)[0]))(gaussian(0.0, std))
    assert np.sign(gradient["log_alpha"]) == sign


def test_exploring_draws_from_the_policy_or_uniformly():
    params = gaussian(0.2, 0.5)
    noise = jax.jit(lambda: Gaussian().noise(KEY, 200, 50, 2, HP._replace(random_eps=0.25, noise_std=9.0)))()
    explore = jax.vmap(lambda n: Gaussian().explore(Fixed(), params, zeros(50, 2), zeros(50, 1), n))
    actions, noise = jax.device_get((jax.jit(explore)(noise), noise))
    own = actions[~noise.is_random]
    u = np.arctanh(own.astype(np.float64))
    assert abs(u.mean() - 0.2) < 0.02
    assert abs(u.std() - 0.5) < 0.02  # noise_std plays no part
    np.testing.assert_array_equal(actions[noise.is_random], noise.uniform[noise.is_random])
    assert abs(float(noise.is_random.mean()) - 0.25) < 0.02
    np.testing.assert_allclose(Gaussian().act(Fixed(), params, zeros(3, 2), zeros(3, 1)), np.tanh(0.2), rtol=1e-6)


def test_exploring_without_a_distribution_adds_noise():
    actor = Deterministic()

    def explore():
        noise = actor.noise(KEY, 100, 50, 2, HP._replace(random_eps=0.0, noise_std=0.1))
        return jax.vmap(lambda n: actor.explore(Straight(), {}, zeros(50, 2), zeros(50, 1), n))(noise)

    assert abs(np.std(jax.jit(explore)()) - 0.1) < 0.005


def test_layers_for_export_are_those_of_the_means():
    inputs, network = (jnp.zeros(5), jnp.zeros(3)), GaussianActor(2, (8,))
    params = jax.jit(lambda: Gaussian().init(network, KEY, *inputs))()
    layers = Gaussian().dense(network, params)
    assert layers["Dense_1"]["kernel"].shape == (8, 2)
    mean, _ = network.apply(params["network"], jnp.ones(5), jnp.ones(3))
    hidden = jnp.maximum(jnp.ones(8) @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"], 0)
    np.testing.assert_allclose(hidden @ layers["Dense_1"]["kernel"] + layers["Dense_1"]["bias"], mean, rtol=1e-5)
    assert Gaussian().dense(Fixed(), params) is None
    assert Deterministic().dense(Straight(), {}) is None
    for kind, network in ((Deterministic(), Actor), (Gaussian(), GaussianActor)):
        own = type("Own", (network,), {})  # may compute something else
        assert kind.dense(own(2, (8,)), {"params": {}, "network": {"params": {}}}) is None
    assert set(Deterministic().dense(Actor(2, (8,)), Deterministic().init(Actor(2, (8,)), KEY, *inputs))) == {
        "Dense_0",
        "Dense_1",
    }
