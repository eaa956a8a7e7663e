import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_dher import by_distance, samplers, spec
from mjx_dher.components import COMPONENTS
from mjx_dher.config import HParams
from mjx_dher.spec import RunSpec

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


@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
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


@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
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
    rng = np.random.default_rng(1)
    weights = np.maximum(rng.random((200_000, 51), np.float32), 1e-6)
    mask = rng.random(weights.shape, np.float32) < 0.3
    mask[:, 7] = True
    index = np.asarray(jax.jit(samplers.draw)(jax.random.key(1), np.where(mask, np.log(weights), -np.inf)))
    assert mask[np.arange(len(index)), index].all()


@pytest.mark.parametrize("name", COMPONENTS["sampler"])
def test_every_name_makes_a_sampler_and_random_alone_crosses_episodes(name):
    sampler = samplers.make(name)
    assert sampler.log_weights(ACHIEVED, DESIRED, jnp.array(0), HP).shape == (5,)
    assert sampler.cross_episode == (name == "random")


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
    spec.validate(RunSpec(sampler="mine:first"))


def test_a_metric_of_one_s_own(mine):
    """Distance along x alone: of the goals after step 1, (0, 0, 1) and (0, 2, 0) lie on the desired one."""
    spec.validate(RunSpec(metric="mine:along_x"))
    for metric in ("mine:along_x", mine.along_x):
        np.testing.assert_allclose(table(samplers.make("closest", metric=metric), 1), [0, 0, 0.5, 0, 0.5])
        # At 0, 3, 0 the mean is 1 and the relative distances are 0, 3, 0: weights 2, 0, 2.
        np.testing.assert_allclose(table(samplers.make("weighted", metric=metric), 1), [0, 0, 0.5, 0, 0.5])
    # A fifth of the weight is shared by the three, and the rest by the two nearest.
    expected = [0, 0, 0.4 + 0.2 / 3, 0.2 / 3, 0.4 + 0.2 / 3]
    np.testing.assert_allclose(table(samplers.make("epsilon_closest", metric="mine:along_x"), 1), expected, atol=1e-6)


def test_a_kernel_of_one_s_own(mine):
    """The candidates after step 2 are at 3 and 2, so that their weights are as 1 / 9 to 1 / 4."""
    spec.validate(RunSpec(weight_kernel="mine:squared"))
    for kernel in ("mine:squared", mine.squared):
        np.testing.assert_allclose(table(samplers.make("weighted", kernel), 2), [0, 0, 0, 4 / 13, 9 / 13], atol=1e-6)


def test_a_normalization_of_one_s_own(mine):
    """The candidates after step 1 are at 1, 3 and 2, so that their weights are 1, exp(-2) and exp(-1)."""
    spec.validate(RunSpec(weight_normalization="mine:nearest_is_1"))
    weights = np.array([0, 0, 1, np.exp(-2.0), np.exp(-1.0)])
    for normalization in ("mine:nearest_is_1", mine.nearest_is_1):
        got = table(samplers.make("weighted", "softmax", normalization=normalization), 1)
        np.testing.assert_allclose(got, weights / weights.sum(), atol=1e-6)
    with pytest.raises(ValueError, match=r"relative distances \[T\+1\].*\[2, 5\]"):
        table(samplers.make("weighted", normalization="mine:pairs"), 1)


REFUSED = [  # arguments of `make`, and what the message names: the field, the value and what is allowed
    ({"name": "futur"}, ["sampler", "'futur'", ", ".join(COMPONENTS["sampler"]), "did you mean 'future'"]),
    ({"name": "weighted", "kernel": "softmx"}, ["weight_kernel", "'softmx'", "linear, inverse, softmax", "'softmax'?"]),
    ({"name": "weighted", "normalization": "meam"}, ["weight_normalization", "'meam'", "mean, sum, max, minmax", "'mean'"]),
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
        spec.validate(RunSpec(**{field: value}))


def test_the_papers_samplers_are_among_the_samplers():
    assert samplers.weighted is by_distance.weighted
    assert samplers.closest is by_distance.closest
    with pytest.raises(AttributeError, match="wieghted"):
        samplers.wieghted  # noqa: B018


def test_goals_at_infinite_distances_are_of_the_future_alone():
    achieved, desired = jnp.full((6, 1), 1e30), jnp.full(1, -1e30)
    apart = lambda a, b: jnp.full(a.shape[:-1], jnp.inf)  # noqa: E731
    numbers = HParams(temperature=1.0)
    options = {"metric": apart}
    chosen = [
        by_distance.closest(achieved, desired, jnp.int32(2), numbers, **options),
        by_distance.weighted(
            achieved, desired, jnp.int32(2), numbers, by_distance.linear, normalization=by_distance.by_scale, **options
        ),
    ]
    for weights in chosen:
        np.testing.assert_allclose(samplers.probabilities(weights), [0, 0, 0, 1 / 3, 1 / 3, 1 / 3], atol=1e-6)
