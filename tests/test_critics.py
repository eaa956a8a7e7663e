"""What is made of the values of several critics, beside numbers by hand."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from configs import LEARNS

from mjx_dher import HParams, layers, learners, networks
from mjx_dher.learners import critics
from mjx_dher.learners.critics import Categorical, Critics
from mjx_dher.networks import Critic, Style
from mjx_dher.types import Batch
from probes import spec_of

KEY = jax.random.key(0)
TWO = jnp.array([[[-1.0], [-4.0]], [[-2.0], [-3.0]]])  # two critics, two samples


def test_the_smallest_of_each_sample():
    np.testing.assert_array_equal(critics.smallest(TWO, KEY), [[-2.0], [-4.0]])


def test_the_smallest_of_a_subset_is_as_likely_as_its_critics_are():
    """Of three critics with values 1, 2 and 3 two are drawn: the smaller is 1 in two of three pairs, else 2; never 3."""
    values = jnp.array([1.0, 2.0, 3.0])[:, None, None]
    combine = critics.smallest_of(2)
    drawn = np.asarray(jax.vmap(lambda key: combine(values, key))(jax.random.split(KEY, 3000))).ravel()
    assert set(drawn) == {1.0, 2.0}
    assert abs((drawn == 1.0).mean() - 2 / 3) < 4 * np.sqrt(2 / 9 / 3000)
    np.testing.assert_array_equal(critics.smallest_of(3)(values, KEY), [[1.0]])


def test_the_subset_is_the_same_for_the_whole_batch():
    values = jnp.tile(jnp.arange(10.0)[:, None, None], (1, 50, 1))
    assert np.unique(critics.smallest_of(1)(values, KEY)).size == 1


def test_truncation_pools_the_quantiles_and_drops_the_largest():
    """Two critics with three quantiles each, one dropped a critic: of six numbers the four smallest, in order."""
    values = jnp.array([[[3.0, 1.0, 2.0]], [[9.0, -1.0, 2.0]]])
    np.testing.assert_array_equal(critics.truncated(1)(values, KEY), [[-1.0, 1.0, 2.0, 2.0]])
    np.testing.assert_array_equal(critics.truncated(0)(values, KEY), [[-1.0, 1.0, 2.0, 2.0, 3.0, 9.0]])
    np.testing.assert_array_equal(critics.truncated(2)(values, KEY), [[-1.0, 1.0]])


@pytest.fixture(params=["cpu", "gpu"])
def backend(request, monkeypatch):
    """The way of adding up that each of them has; both are computed here."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)


def test_the_least_are_those_of_a_sort(backend):
    numbers = np.round(3 * np.random.default_rng(0).normal(size=(40, 9))).astype(np.float32)  # with many ties
    least = jax.jit(critics.least, static_argnums=1)
    np.testing.assert_array_equal(least(numbers, 3), np.sort(numbers, axis=-1)[:, :3])
    numbers[0, 1] = np.nan
    assert np.isnan(np.asarray(least(numbers, 3))[0]).any()


def test_squared_error_by_hand():
    # First critic: (1 + 4) / 2 to targets -2, -2; second: (0 + 1) / 2.
    np.testing.assert_allclose(critics.squared_error(TWO, jnp.array([[-2.0], [-2.0]])), 2.5 + 0.5)


def test_quantile_huber_by_hand():
    """One sample, quantiles 0 and 1 (tau 1/4 and 3/4), atoms -2, 1/2 and 3."""
    values, atoms = jnp.array([[[0.0, 1.0]]]), jnp.array([[-2.0, 0.5, 3.0]])
    # huber(u): |u| - 1/2 beyond 1, else u^2 / 2. To 0: u = -2, 1/2, 3; to 1: u = -3, -1/2, 2.
    of_0 = 0.75 * 1.5 + 0.25 * 0.125 + 0.25 * 2.5
    of_1 = 0.25 * 2.5 + 0.25 * 0.125 + 0.75 * 1.5
    loss, gradient = jax.value_and_grad(critics.quantile_huber)(values, atoms)
    np.testing.assert_allclose(loss, (of_0 + of_1) / 6, rtol=1e-6)
    # huber's slope is u clipped to [-1, 1]: to 0 it is -1, 1/2, 1; to 1 -1, -1/2, 1.
    slopes = [0.75 * -1 + 0.25 * 0.5 + 0.25 * 1, 0.25 * -1 + 0.25 * -0.5 + 0.75 * 1]
    np.testing.assert_allclose(gradient, [[[-slopes[0] / 6, -slopes[1] / 6]]], rtol=1e-6)


def test_two_hot_by_hand():
    """Five values from -4 to 0: a target of -0.5 is half of -1 and half of 0, one at the end is that end."""
    categorical = Categorical(1, 5, critics.smallest, critics.two_hot, critics.lowest)
    shares = np.array([0.1, 0.1, 0.2, 0.4, 0.2])
    logits = np.float32(np.log(shares)[None, None] + 3.0)  # logits have no unit
    error = jax.jit(lambda logits, target: categorical.error(logits, target, -4.0, 0.0))
    returns = jax.jit(lambda logits: categorical.returns(logits, -4.0, 0.0))(logits)
    np.testing.assert_allclose(returns, [[[-4 * 0.1 - 3 * 0.1 - 2 * 0.2 - 0.4]]], rtol=1e-5)
    for target, expected in ((-0.5, np.log([0.4, 0.2]).mean()), (0.0, np.log(0.2)), (-4.0, np.log(0.1)), (-1.0, np.log(0.4))):
        loss = error(logits, np.float32([[target]]))
        np.testing.assert_allclose(loss, -expected, rtol=1e-5)
    two = error(np.concatenate([logits, logits]), np.float32([[-1.0, 0.0]]))
    np.testing.assert_allclose(two, -2 * np.log([0.4, 0.2]).mean(), rtol=1e-5)  # summed over critics, a mean over atoms


def plain_loss(values, atoms):
    """The loss as it is written in the paper, pair by pair."""
    tau = (np.arange(values.shape[-1]) + 0.5) / values.shape[-1]
    u = atoms[None, :, None, :] - values[..., None]
    huber = jnp.where(jnp.abs(u) <= 1, 0.5 * u**2, jnp.abs(u) - 0.5)
    return jnp.sum(jnp.mean(jnp.abs(tau[:, None] - (u < 0)) * huber, axis=(1, 2, 3)))


def test_quantile_huber_and_its_gradient_are_those_of_the_formula(backend):
    values, atoms = (2.0 * jax.random.normal(jax.random.key(i), shape) for i, shape in enumerate(((3, 5, 4), (5, 7))))
    ours, formula = (jax.jit(jax.value_and_grad(loss))(values, atoms) for loss in (critics.quantile_huber, plain_loss))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-7), ours, formula)
    lanes = jax.jit(jax.vmap(jax.grad(critics.quantile_huber)))(jnp.stack([values, -values]), jnp.stack([atoms, atoms]))
    np.testing.assert_allclose(lanes[0], formula[1], rtol=2e-5, atol=1e-7)
    assert not np.any(jax.jit(jax.grad(critics.quantile_huber, argnums=1))(values, atoms))  # a target stays where it is


def test_quantiles_of_a_known_distribution_are_found():
    """Atoms are draws of a uniform distribution on [-100, 0], wide beside kappa: quantile m goes to 100 tau_m - 100."""
    optimizer, values = optax.adam(1.0), jnp.zeros((1, 1, 4)) - 50.0

    def step(carry, key):
        values, moments, rate = carry
        atoms = jax.random.uniform(key, (1, 64), minval=-100.0, maxval=0.0)
        direction, moments = optimizer.update(jax.grad(critics.quantile_huber)(values, atoms), moments)
        return (values + rate * direction, moments, rate * 0.998), None

    start = values, optimizer.init(values), jnp.float32(1.0)
    (values, *_), _ = jax.lax.scan(step, start, jax.random.split(KEY, 3000))
    np.testing.assert_allclose(values[0, 0], [-87.5, -62.5, -37.5, -12.5], atol=1.5)


def test_judges_of_actions():
    values = jnp.array([[[-1.0, -3.0]], [[-6.0, -4.0]]])  # means -2 and -5
    np.testing.assert_allclose(critics.lowest(values), [-5.0])
    np.testing.assert_allclose(critics.mean(values), [-3.5])
    params = {"w": jnp.arange(6.0).reshape(3, 2)}
    parts = Critics(3, 1, critics.smallest, critics.squared_error, critics.lowest, num_judges=1)
    np.testing.assert_array_equal(parts.judges(params)["w"], [[0.0, 1.0]])


@pytest.mark.parametrize("backend", ["cpu", "gpu"])  # one after the other, or together
def test_critics_begin_apart_and_are_each_that_critic_alone(backend, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    network = Critic((16,), size=4)
    made = Critics(3, 4, critics.smallest, critics.squared_error, critics.mean)
    params = jax.jit(lambda: made.init(network, KEY, *map(jnp.zeros, (5, 3, 2))))()
    inputs = [jax.random.normal(jax.random.key(i), (7, size)) for i, size in enumerate((5, 3, 2))]
    values = np.asarray(jax.jit(lambda *inputs: critics.values(network, *inputs))(params, *inputs))
    assert values.shape == (3, 7, 4)
    assert not np.allclose(values[0], values[1])
    params, apply = jax.device_get(params), jax.jit(network.apply)
    for i in range(3):
        alone = apply(jax.tree.map(lambda x, i=i: x[i], params), *inputs)
        np.testing.assert_allclose(values[i], alone, rtol=1e-5, atol=1e-6)


def test_layer_norm_normalizes_before_each_relu():
    """Of the default critic with layer_norm, by hand: (x - mean) / sqrt(var + 1e-6), then scale, bias and ReLU."""
    network, inputs = (
        Critic((4, 4), style=Style(layer_norm=True)),
        [jnp.array([[0.3, -2.0]]), jnp.array([[1.0]]), jnp.array([[0.5]])],
    )
    params = network.init(KEY, *inputs)
    layers = params["params"]
    assert set(layers) == {"Dense_0", "LayerNorm_0", "Dense_1", "LayerNorm_1", "Dense_2"}
    x = np.concatenate(inputs, axis=-1)
    for i in range(2):
        x = x @ np.asarray(layers[f"Dense_{i}"]["kernel"]) + np.asarray(layers[f"Dense_{i}"]["bias"])
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
        x = np.maximum(x * np.asarray(layers[f"LayerNorm_{i}"]["scale"]) + np.asarray(layers[f"LayerNorm_{i}"]["bias"]), 0)
    expected = x @ np.asarray(layers["Dense_2"]["kernel"]) + np.asarray(layers["Dense_2"]["bias"])
    np.testing.assert_allclose(network.apply(params, *inputs), expected[:, 0], rtol=1e-4)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_layers_that_sum_by_products_have_the_gradients_of_flax(dtype):
    """Of 3 networks side by side, with scales and biases that are not those of the start."""

    class Flax(nn.Module):
        @nn.compact
        def __call__(self, x):
            x = nn.LayerNorm(dtype=dtype)(nn.Dense(8, dtype=dtype, kernel_init=nn.initializers.xavier_uniform())(x))
            return nn.Dense(2, kernel_init=nn.initializers.xavier_uniform())(nn.relu(x))

    class Ours(nn.Module):
        @nn.compact
        def __call__(self, x):
            return networks._mlp(x, (8,), 2, jnp.dtype(dtype), Style(layer_norm=True))

    x, target = jax.random.normal(KEY, (3, 5, 16, 4)), jax.random.normal(jax.random.key(1), (3, 5, 16, 2))
    params = jax.jit(jax.vmap(Ours().init, (None, 0)))(KEY, x)
    theirs = jax.eval_shape(jax.vmap(Flax().init, (None, 0)), KEY, x)
    assert jax.tree.structure(params) == jax.tree.structure(theirs)
    params = jax.jit(lambda params: jax.tree.map(lambda p: p + 0.1 * jax.random.normal(KEY, p.shape), params))(params)

    def gradients(module):
        loss = lambda p, x, target: jnp.mean((module.apply(p, x) - target) ** 2)  # noqa: E731
        return jax.jit(jax.vmap(jax.value_and_grad(loss)))(params, x, target)

    tolerance = {"float32": 1e-6, "bfloat16": 0.02}[dtype]
    for own, flax in zip(jax.tree.leaves(gradients(Ours())), jax.tree.leaves(gradients(Flax()))):
        assert own.dtype == jnp.float32
        np.testing.assert_allclose(own, flax, atol=tolerance * float(jnp.abs(flax).max()))


@pytest.mark.parametrize("shape", [(4,), (6, 4), (2, 3, 4), (0, 4)])
def test_layers_have_the_second_derivatives_of_flax(shape):
    """Of a penalty on the gradient by the input, for inputs with any leading axes and for an empty batch."""
    own = layers.Dense(5, jnp.float32, nn.initializers.xavier_uniform()), layers.LayerNorm(jnp.float32)
    flax = nn.Dense(5), nn.LayerNorm()
    x = jax.random.normal(KEY, shape)
    params = own[0].init(KEY, x), jax.tree.map(lambda p: p + 0.3, own[1].init(KEY, jnp.zeros((*shape[:-1], 5))))

    def penalty(params, modules):
        output = lambda x: modules[1].apply(params[1], modules[0].apply(params[0], x))  # noqa: E731
        return jnp.sum(jax.grad(lambda x: jnp.sum(jnp.tanh(output(x))))(x) ** 2)

    gradients = jax.jit(jax.grad(penalty), static_argnums=1)
    for a, b in zip(*(jax.tree.leaves(gradients(params, modules)) for modules in (own, flax))):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("name", ["ddpg", "td3"])
def test_unit_norm_keeps_the_weights_of_each_hidden_unit_at_length_1(name):
    learner = learners.make(
        name, dataclasses.replace(LEARNS, hidden_sizes=(4, 4), num_critics=1), spec_of(2, 2, 2), "unit_norm"
    )
    ones = jnp.ones((8, 2))
    batch = Batch(ones, ones, ones, ones, -ones[:, 0], ones[:, 0], jnp.arange(8))
    state = jax.jit(learner.init)(jax.random.key(0))
    before, params = state.params, jax.jit(learner.update)(state, batch, HParams())[0].params
    for ours, theirs in zip(jax.tree.leaves(learner.lagging(before)), jax.tree.leaves(state.target)):
        np.testing.assert_array_equal(ours, theirs)
    for tree, start in ((params.critic, before.critic), (params.actor, before.actor)):
        layers, old = tree["params"], start["params"]
        for name in ("Dense_0", "Dense_1"):
            np.testing.assert_allclose(np.linalg.norm(layers[name]["kernel"], axis=-2), 1.0, rtol=1e-5)
            np.testing.assert_allclose(np.linalg.norm(old[name]["kernel"], axis=-2), 1.0, rtol=1e-5)
        assert np.abs(layers["Dense_2"]["kernel"] - old["Dense_2"]["kernel"]).max() < 0.01  # a step of Adam, and no more
