import collections
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import names, readings, samplers, spec
from mjx_dher.config import HParams
from mjx_dher.methods import metrics
from mjx_dher.spec import METRICS, SAMPLERS, WEIGHT_KERNELS, WEIGHT_NORMALIZATIONS, RunSpec

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


# The candidates after step 1 are at 1, 3 and 2. At a scale of 2 m, x = d / 2 is 0.5, 1.5 and 1.
READINGS = [
    ("mean", "linear", 1.0, [1.5, 0.5, 1.0]),  # 2 - d / 2
    ("sum", "linear", 1.0, [5 / 6, 3 / 6, 4 / 6]),  # 1 - d / 6
    ("sum", "linear", 0.25, [1 / 3, 0.0, 0.0]),  # 1 - 4 d / 6 is below 0 for two of them
    ("sum", "softmax", 1.0, [np.exp(-1 / 6), np.exp(-3 / 6), np.exp(-2 / 6)]),
    ("sum", "inverse", 1.0, [6 / 7, 6 / 9, 6 / 8]),  # 1 / (1 + d / 6)
    ("max", "linear", 1.0, [2 / 3, 0.0, 1 / 3]),  # 1 - d / 3
    ("max", "linear", 0.2, [1.0, 0.0, 0.0]),  # 1 - 5 d / 3 is below 0 for all: the nearest
    ("max", "inverse", 0.5, [9 / 16, 1 / 4, 9 / 25]),  # 1 / (1 + d / 3)^2
    ("minmax", "linear", 1.0, [1.0, 0.0, 0.5]),  # 1 - (d - 1) / 2
    ("minmax", "softmax", 0.5, [1.0, np.exp(-2.0), np.exp(-1.0)]),
    ("none", "softmax", 1.0, [np.exp(-0.5), np.exp(-1.5), np.exp(-1.0)]),
    ("none", "linear", 1.0, [0.5, 0.0, 0.0]),
    ("none", "linear", 2.0, [0.75, 0.25, 0.5]),
    ("none", "linear", 0.4, [1.0, 0.0, 0.0]),  # all are beyond 0.8 m: the nearest
    ("none", "inverse", 1.0, [1 / 1.5, 1 / 2.5, 1 / 2]),
    ("far", "linear", 1.0, [1.0, 3.0, 2.0]),  # d
    ("far", "linear", 0.5, [0.0, 2.0, 1.0]),  # 1 + 2 (d / 2 - 1)
    ("far", "softmax", 1.0, [np.exp(-0.5), np.exp(0.5), 1.0]),
    ("far", "inverse", 1.0, [1 / 1.5, 2.0, 1.0]),  # 1 / (2 - d / 2)
]


@pytest.mark.parametrize(("normalization", "kernel", "temperature", "weights"), READINGS)
def test_readings(normalization, kernel, temperature, weights):
    sampler = samplers.make("weighted", kernel, normalization=normalization)
    got = table(sampler, 1, HP._replace(temperature=temperature, weight_scale=2.0))
    np.testing.assert_allclose(got, np.array([0, 0, *weights]) / np.sum(weights), atol=1e-6)


@pytest.mark.parametrize("normalization", WEIGHT_NORMALIZATIONS)
@pytest.mark.parametrize("kernel", WEIGHT_KERNELS)
@pytest.mark.parametrize("temperature", [0.25, 1.0])
def test_equal_distances_make_every_reading_exactly_future(normalization, kernel, temperature):
    """Of 0, of a millionth, of twice and a hundred times the scale; and the last step, after which one goal is left."""
    sampler, hparams = samplers.make("weighted", kernel, normalization=normalization), HP._replace(temperature=temperature)
    log_weights = jax.jit(sampler.log_weights)
    for distance in (0.0, 1e-6, 0.1, 5.0):
        achieved = jnp.full((7, 3), distance) * jnp.array([1.0, 0, 0])
        for step in range(6):
            got = samplers.probabilities(log_weights(achieved, DESIRED, jnp.array(step), hparams))
            expected = samplers.probabilities(samplers.future(achieved, DESIRED, jnp.array(step), hparams))
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("kernel", WEIGHT_KERNELS)
@pytest.mark.parametrize("normalization", [name for name in WEIGHT_NORMALIZATIONS if name != "none"])
def test_readings_that_have_no_scale(normalization, kernel):
    sampler = samplers.make("weighted", kernel, normalization=normalization)
    np.testing.assert_allclose(table(sampler, 0), table(sampler, 0, achieved=ACHIEVED * 1e-3), atol=1e-5)


@pytest.mark.parametrize("kernel", WEIGHT_KERNELS)
def test_weights_of_a_length_even_out_as_distances_shrink(kernel):
    """What the paper says of its method 3: "more and more random as the network learns"."""
    sampler, far_off = samplers.make("weighted", kernel, normalization="none"), []
    for shrunk in (1.0, 0.1, 0.01, 0.001):
        probabilities = table(sampler, 0, HP._replace(weight_scale=2.0), ACHIEVED * shrunk)
        far_off.append(0.5 * np.abs(probabilities - table(samplers.make("future"), 0)).sum())
    assert far_off == sorted(far_off, reverse=True)
    assert far_off[0] > 0.1
    assert far_off[-1] < 1e-3


@pytest.mark.parametrize("normalization", WEIGHT_NORMALIZATIONS)
def test_a_candidate_on_the_goal_is_no_trouble(normalization):
    """The candidates after step 0 are at 0, 0, 3 and 2; of the nearest two neither is preferred."""
    achieved = ACHIEVED.at[1:3].set(0.0)
    for kernel in WEIGHT_KERNELS:
        got = table(samplers.make("weighted", kernel, normalization=normalization), 0, achieved=achieved)
        assert np.isfinite(got).all()
        assert got[0] == 0
        assert got[1] == got[2]
        assert (got[1] > got[3]) == (normalization != "far")


def test_a_distance_that_is_none_leaves_no_goal_in_any_reading():
    for normalization in WEIGHT_NORMALIZATIONS:
        for kernel in WEIGHT_KERNELS:
            sampler = samplers.make("weighted", kernel, lambda a, d: a[:, 0].at[3].set(jnp.nan), normalization)
            log_weights = sampler.log_weights(ACHIEVED, DESIRED, jnp.array(1), HP)
            assert samplers.draw(jax.random.key(0), log_weights[None])[0] == 5, (normalization, kernel)


def test_readings_are_lanes_of_one_program():
    """The choice is traced, so one compiled function serves all."""
    every = [samplers.make("weighted", k, normalization=n) for n in WEIGHT_NORMALIZATIONS for k in WEIGHT_KERNELS]
    lane = collections.namedtuple("Lane", (*HParams._fields, "choice"))
    joined = jax.jit(lambda choice: samplers.one_of(every).log_weights(ACHIEVED, DESIRED, jnp.array(1), lane(*HP, choice)))
    for choice, sampler in enumerate(every):
        np.testing.assert_allclose(samplers.probabilities(joined(choice)), table(sampler, 1), atol=1e-6)
    assert joined._cache_size() == 1


@pytest.mark.parametrize("kernel", WEIGHT_KERNELS)
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


@pytest.mark.parametrize("kernel", WEIGHT_KERNELS)
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


def test_closest_by_another_metric():
    by_height = samplers.make("closest", metric=lambda achieved, desired: jnp.abs(achieved[:, 2] - desired[2] - 1))
    np.testing.assert_allclose(table(by_height, 0), [0, 0, 1, 0, 0])


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


@pytest.mark.parametrize("name", SAMPLERS)
def test_every_name_makes_a_sampler_and_random_alone_crosses_episodes(name):
    sampler = samplers.make(name)
    assert sampler.log_weights(ACHIEVED, DESIRED, jnp.array(0), HP).shape == (5,)
    assert sampler.cross_episode == (name == "random")


@pytest.mark.parametrize(("field", "known"), [("weight_kernel", WEIGHT_KERNELS), ("metric", METRICS)])
def test_names_are_those_of_functions(field, known):
    for name, place in known.items():
        module = metrics if "methods" in place else samplers
        assert names.load_import_path(field, place) is getattr(module, name)


def test_normalizations_are_those_of_the_module():
    functions = [names.load_import_path("weight_normalization", place) for place in WEIGHT_NORMALIZATIONS.values()]
    by = readings.by_mean, readings.by_sum, readings.by_max, readings.by_range, readings.by_scale
    assert functions == [*by, readings.mirrored]


def first(achieved, desired, step, hparams):
    return jnp.where(jnp.arange(len(achieved)) == 0, 0.0, -jnp.inf)


@pytest.fixture
def mine(monkeypatch):
    """A module of the user's."""
    module = types.ModuleType("mine")
    module.first = first
    module.elsewhere = samplers.Sampler(first, cross_episode=True)
    module.along_x = lambda achieved, desired: jnp.abs(achieved[:, 0] - desired[0])
    module.squared = lambda relative, temperature: -2 * jnp.log(relative)
    module.nearest_is_1 = lambda distance, candidates, scale: 1 + distance - jnp.min(jnp.where(candidates, distance, jnp.inf))
    module.pairs = lambda distance, candidates, scale: jnp.stack([distance, distance])
    module.two = 2
    monkeypatch.setitem(sys.modules, "mine", module)
    return module


def test_a_sampler_of_one_s_own(mine):
    for name, crosses in (("first", False), ("elsewhere", True)):
        sampler = samplers.make(f"mine:{name}")
        np.testing.assert_allclose(table(sampler, 2), [1, 0, 0, 0, 0])
        assert sampler.cross_episode is crosses
    assert samplers.make("mine:elsewhere") is mine.elsewhere
    spec.validate(RunSpec(sampler="mine:first"), ("push",))


def test_a_metric_of_one_s_own(mine):
    """Distance along x alone: of the goals after step 1, (0, 0, 1) and (0, 2, 0) lie on the desired one."""
    spec.validate(RunSpec(metric="mine:along_x"), ("push",))
    for metric in ("mine:along_x", mine.along_x):
        np.testing.assert_allclose(table(samplers.make("closest", metric=metric), 1), [0, 0, 0.5, 0, 0.5])
        # At 0, 3, 0 the mean is 1 and the relative distances are 0, 3, 0: weights 2, 0, 2.
        np.testing.assert_allclose(table(samplers.make("weighted", metric=metric), 1), [0, 0, 0.5, 0, 0.5])
    # A fifth of the weight is shared by the three, and the rest by the two nearest.
    expected = [0, 0, 0.4 + 0.2 / 3, 0.2 / 3, 0.4 + 0.2 / 3]
    np.testing.assert_allclose(table(samplers.make("epsilon_closest", metric="mine:along_x"), 1), expected, atol=1e-6)


def test_a_kernel_of_one_s_own(mine):
    """The candidates after step 2 are at 3 and 2, so that their weights are as 1 / 9 to 1 / 4."""
    spec.validate(RunSpec(weight_kernel="mine:squared"), ("push",))
    for kernel in ("mine:squared", mine.squared):
        np.testing.assert_allclose(table(samplers.make("weighted", kernel), 2), [0, 0, 0, 4 / 13, 9 / 13], atol=1e-6)


def test_a_normalization_of_one_s_own(mine):
    """The candidates after step 1 are at 1, 3 and 2, so that their weights are 1, exp(-2) and exp(-1)."""
    spec.validate(RunSpec(weight_normalization="mine:nearest_is_1"), ("push",))
    weights = np.array([0, 0, 1, np.exp(-2.0), np.exp(-1.0)])
    for normalization in ("mine:nearest_is_1", mine.nearest_is_1):
        got = table(samplers.make("weighted", "softmax", normalization=normalization), 1)
        np.testing.assert_allclose(got, weights / weights.sum(), atol=1e-6)
    with pytest.raises(ValueError, match=r"a normalization gives relative distances \[T\+1\] = \[5\]; .* gives \[2, 5\]"):
        table(samplers.make("weighted", normalization="mine:pairs"), 1)


REFUSED = [  # arguments of `make`, and what the message names: the field, the value and what is allowed
    ({"name": "futur"}, ["sampler", "'futur'", ", ".join(SAMPLERS), "did you mean 'future'"]),
    ({"name": "weighted", "kernel": "softmx"}, ["weight_kernel", "'softmx'", "linear, inverse, softmax", "'softmax'?"]),
    (
        {"name": "weighted", "normalization": "meam"},
        ["weight_normalization", "'meam'", "mean, sum, max, minmax", "'mean'"],
    ),
    ({"name": "weighted", "normalization": ""}, ["weight_normalization", "''", "mean, sum, max, minmax"]),
    ({"name": "weighted", "normalization": "mine:two"}, ["weight_normalization", "(distance, candidates, scale)", " 2"]),
    ({"name": "future", "normalization": "meam"}, ["weight_normalization", "'meam'"]),
    ({"name": "weighted", "metric": "along_x"}, ["metric", "'along_x'", "position", "module:attribute"]),
    ({"name": "mine:frist"}, ["sampler", "'mine:frist'", "did you mean 'first'"]),
    ({"name": "closest", "metric": "mine:along_y"}, ["metric", "'mine:along_y'", "did you mean 'along_x'"]),
    ({"name": "weighted", "kernel": "no_such:squared"}, ["weight_kernel", "'no_such:squared'", "no module"]),
    ({"name": "mine:two"}, ["sampler", "(achieved, desired, step, hparams)", " 2"]),
    ({"name": "mine:along_x"}, ["sampler", "(achieved, desired, step, hparams)"]),
    ({"name": "closest", "metric": "mine:two"}, ["metric", "(achieved, desired)", " 2"]),
    ({"name": "closest", "metric": first}, ["metric", "(achieved, desired)"]),
    ({"name": "weighted", "kernel": "mine:first"}, ["weight_kernel", "(relative, temperature)"]),
    ({"name": "future", "kernel": "softmx"}, ["weight_kernel", "'softmx'"]),  # what is not read must be right, too
]


@pytest.mark.parametrize(("arguments", "parts"), REFUSED)
def test_what_cannot_be_used_is_refused(mine, arguments, parts):
    with pytest.raises(ValueError, match=parts[0]) as error:
        samplers.make(**arguments)
    assert all(part in str(error.value) for part in parts), error.value


@pytest.mark.parametrize(
    ("field", "value"),
    [("metric", "along_x"), ("weight_kernel", "squared"), ("weight_normalization", "median"), ("sampler", "first")],
)
def test_a_run_with_a_name_that_is_not_built_in_is_refused(field, value):
    with pytest.raises(ValueError, match=f"{field} must be one of .*module:attribute; got '{value}'"):
        spec.validate(RunSpec(**{field: value}), ("push",))
