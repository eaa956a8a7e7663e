import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import config, samplers
from mjx_dher.config import HParams

HP = HParams()
# One episode of T = 4 steps; the desired goal is the origin, so the distances are 5, 4, 1, 3 and 2.
ACHIEVED = jnp.array([[5.0, 0, 0], [0, 4, 0], [0, 0, 1], [3, 0, 0], [0, 2, 0]])
DESIRED = jnp.zeros(3)


def table(sampler, step, hparams=HP, achieved=ACHIEVED):
    return np.asarray(samplers.probabilities(sampler.log_weights(achieved, DESIRED, jnp.array(step), hparams)))


@pytest.mark.parametrize(
    ("name", "step", "expected"),
    [
        ("random", 1, [1 / 5] * 5),
        ("episode", 3, [1 / 5] * 5),
        ("future", 0, [0, 1 / 4, 1 / 4, 1 / 4, 1 / 4]),
        ("future", 2, [0, 0, 0, 1 / 2, 1 / 2]),
        ("future", 3, [0, 0, 0, 0, 1]),
        ("final", 0, [0, 0, 0, 0, 1]),
        ("closest", 0, [0, 0, 1, 0, 0]),
        ("closest", 2, [0, 0, 0, 0, 1]),
        ("epsilon_closest", 1, [0, 0, 0.8 + 0.2 / 3, 0.2 / 3, 0.2 / 3]),
        # The candidates after step 1 are at 1, 3 and 2: the mean is 2, relative distances 0.5, 1.5, 1; weights 2 - r.
        ("weighted", 1, [0, 0, 1.5 / 3, 0.5 / 3, 1 / 3]),
        ("weighted", 3, [0, 0, 0, 0, 1]),
    ],
)
def test_probabilities(name, step, expected):
    np.testing.assert_allclose(table(samplers.make(name), step), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("kernel", "temperature", "weights"),
    [
        ("linear", 1.0, [1.5, 0.5, 1.0]),
        ("linear", 0.25, [3.0, 0.0, 1.0]),  # 1 - 0.5 / 0.25 is below 0: dropped
        ("linear", 2.0, [1.25, 0.75, 1.0]),
        ("inverse", 1.0, [2.0, 1 / 1.5, 1.0]),
        ("inverse", 0.5, [4.0, 1 / 1.5**2, 1.0]),
        ("softmax", 1.0, [np.exp(0.5), np.exp(-0.5), 1.0]),
        ("softmax", 0.1, [np.exp(5.0), np.exp(-5.0), 1.0]),
    ],
)
def test_weight_kernels(kernel, temperature, weights):
    got = table(samplers.make("weighted", kernel), 1, HP._replace(temperature=temperature))
    np.testing.assert_allclose(got, np.array([0, 0, *weights]) / np.sum(weights), atol=1e-6)


@pytest.mark.parametrize("kernel", config.WEIGHT_KERNELS)
@pytest.mark.parametrize("distance", [0.0, 1e-6, 0.3])
def test_equal_distances_make_weighted_exactly_future(kernel, distance):
    # Distances that are equal to the last bit: the same point again and again, and the axes of the plane.
    for achieved in (jnp.full((7, 3), distance), distance * jnp.eye(3)[jnp.arange(7) % 3]):
        for step in range(6):
            args = (achieved, DESIRED, jnp.array(step), HP)
            np.testing.assert_array_equal(
                samplers.probabilities(samplers.make("weighted", kernel).log_weights(*args)),
                samplers.probabilities(samplers.make("future").log_weights(*args)),
            )


@pytest.mark.parametrize("kernel", config.WEIGHT_KERNELS)
def test_weights_do_not_depend_on_scale(kernel):
    sampler = samplers.make("weighted", kernel)
    np.testing.assert_allclose(table(sampler, 0), table(sampler, 0, achieved=ACHIEVED * 1e-3), atol=1e-6)


def test_closest_ties_share():
    achieved = ACHIEVED.at[4].set(ACHIEVED[2])
    np.testing.assert_allclose(table(samplers.make("closest"), 0, achieved=achieved), [0, 0, 0.5, 0, 0.5])


def test_epsilon_bounds_are_closest_and_future():
    sampler = samplers.make("epsilon_closest")
    for epsilon, name in ((0.0, "closest"), (1.0, "future")):
        np.testing.assert_allclose(table(sampler, 0, HP._replace(epsilon=epsilon)), table(samplers.make(name), 0), atol=1e-6)


def test_custom_metric_and_kernel():
    by_height = samplers.make("closest", metric=lambda achieved, desired: jnp.abs(achieved[:, 2] - desired[2] - 1))
    np.testing.assert_allclose(table(by_height, 0), [0, 0, 1, 0, 0])
    squared = samplers.make("weighted", kernel=lambda relative, temperature: -2 * jnp.log(relative))
    np.testing.assert_allclose(table(squared, 2), [0, 0, 0, 4 / 13, 9 / 13], atol=1e-6)


def test_draw_follows_the_probabilities():
    log_weights = jnp.log(jnp.array([0.0, 1.0, 2.0, 0.0, 5.0, 0.0]))
    draws = samplers.draw(jax.random.key(0), jnp.tile(log_weights, (80_000, 1)))
    counts = np.bincount(draws, minlength=6)
    assert counts[[0, 3, 5]].sum() == 0
    expected = np.array([1, 2, 5]) * 10_000
    chi2 = np.sum((counts[[1, 2, 4]] - expected) ** 2 / expected)
    assert chi2 < 13.8  # 99.9 % point at 2 degrees of freedom


def test_draw_never_takes_what_has_no_weight():
    # Weights that do not add up exactly in float32, with holes everywhere.
    key, mask_key, draw_key = jax.random.split(jax.random.key(1), 3)
    weights = jax.random.uniform(key, (200_000, 51), minval=1e-6)
    mask = jax.random.bernoulli(mask_key, 0.3, weights.shape).at[:, 7].set(True)
    index = samplers.draw(draw_key, jnp.where(mask, jnp.log(weights), -jnp.inf))
    assert bool(jnp.all(mask[jnp.arange(len(index)), index]))


def test_names():
    assert set(samplers.list_samplers()) >= set(config.SAMPLERS)
    assert set(samplers.KERNELS) == set(config.WEIGHT_KERNELS)
    assert set(samplers.METRICS) == set(config.METRICS)
    for name in config.SAMPLERS:
        assert samplers.make(name).whole_ring == (name == "random")


def test_register(monkeypatch):
    monkeypatch.setattr(samplers, "_PLAIN", dict(samplers._PLAIN))
    samplers.register("first", samplers.Sampler(lambda a, d, s, h: jnp.where(jnp.arange(len(a)) == 0, 0.0, -jnp.inf)))
    np.testing.assert_allclose(table(samplers.make("first"), 2), [1, 0, 0, 0, 0])
    config.validate(config.Config(sampler="first"), HP)
    with pytest.raises(ValueError, match="sampler 'future' is already registered"):
        samplers.register("future", samplers.make("future"))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"name": "futur"}, "sampler must be one of .*got 'futur' .did you mean 'future'"),
        ({"name": "weighted", "kernel": "softmx"}, "weight_kernel must be one of linear, inverse, softmax; got 'softmx'"),
        ({"name": "weighted", "metric": "speed"}, "metric must be one of position; got 'speed'"),
    ],
)
def test_unknown_names_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        samplers.make(**kwargs)


def test_a_registered_metric_is_one_by_name(monkeypatch):
    """Distance along x alone: of the goals after step 1, (0, 0, 1) and (0, 2, 0) lie on the desired one."""
    monkeypatch.setattr(samplers, "METRICS", dict(samplers.METRICS))
    along_x = lambda achieved, desired: jnp.abs(achieved[:, 0] - desired[0])  # noqa: E731
    with pytest.raises(ValueError, match="metric must be one of position; got 'along_x'"):
        config.validate(config.Config(metric="along_x"), HP)
    samplers.register_metric("along_x", along_x)
    config.validate(config.Config(metric="along_x"), HP)
    np.testing.assert_allclose(table(samplers.make("closest", metric="along_x"), 1), [0, 0, 0.5, 0, 0.5])
    # At 0, 3, 0 the mean is 1 and the relative distances are 0, 3, 0: weights 2, 0, 2.
    np.testing.assert_allclose(table(samplers.make("weighted", metric="along_x"), 1), [0, 0, 0.5, 0, 0.5])
    with pytest.raises(ValueError, match="metric 'along_x' is already registered"):
        samplers.register_metric("along_x", along_x)
