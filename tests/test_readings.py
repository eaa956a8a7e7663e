"""Readings of method 3 of the paper: each normalization of distances, by hand, and what each has in common with `future`."""

import collections
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses
from test_samplers import ACHIEVED, DESIRED, HP, table

from mjx_dher import samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.config import HParams
from mjx_dher.testing import check_normalization

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


def test_readings():
    for normalization, kernel, temperature, weights in READINGS:
        sampler = samplers.make("weighted", kernel, normalization=normalization)
        got = table(sampler, 1, HP._replace(temperature=temperature, weight_scale=2.0))
        expected = np.array([0, 0, *weights]) / np.sum(weights)
        np.testing.assert_allclose(got, expected, atol=1e-6, err_msg=f"{normalization}, {kernel}, {temperature}")


@pytest.mark.parametrize("normalization", COMPONENTS["weight_normalization"])
@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
def test_equal_distances_make_every_reading_exactly_future(normalization, kernel):
    """Of 0, of a millionth, of twice and a hundred times the scale; and the last step, after which one goal is left."""
    sampler = samplers.make("weighted", kernel, normalization=normalization)
    weighted, future = jax.jit(sampler.log_weights), jax.jit(samplers.future)
    for distance, step, temperature in itertools.product((0.0, 1e-6, 0.1, 5.0), range(6), (0.25, 1.0)):
        arguments = jnp.full((7, 3), distance) * jnp.array([1.0, 0, 0]), DESIRED, jnp.array(step)
        got = samplers.probabilities(weighted(*arguments, HP._replace(temperature=temperature)))
        np.testing.assert_array_equal(got, samplers.probabilities(future(*arguments, HP)))


@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
@pytest.mark.parametrize("normalization", [name for name in COMPONENTS["weight_normalization"] if name != "none"])
def test_readings_that_have_no_scale(normalization, kernel):
    sampler = samplers.make("weighted", kernel, normalization=normalization)
    np.testing.assert_allclose(table(sampler, 0), table(sampler, 0, achieved=ACHIEVED * 1e-3), atol=1e-5)


@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
def test_weights_of_a_length_even_out_as_distances_shrink(kernel):
    """What the paper says of its method 3: "more and more random as the network learns"."""
    sampler, far_off = samplers.make("weighted", kernel, normalization="none"), []
    for shrunk in (1.0, 0.1, 0.01, 0.001):
        probabilities = table(sampler, 0, HP._replace(weight_scale=2.0), ACHIEVED * shrunk)
        far_off.append(0.5 * np.abs(probabilities - table(samplers.make("future"), 0)).sum())
    assert far_off == sorted(far_off, reverse=True)
    assert far_off[0] > 0.1
    assert far_off[-1] < 1e-3


@pytest.mark.parametrize("normalization", COMPONENTS["weight_normalization"])
def test_a_candidate_on_the_goal_is_no_trouble(normalization):
    """The candidates after step 0 are at 0, 0, 3 and 2; of the nearest two neither is preferred."""
    achieved = ACHIEVED.at[1:3].set(0.0)
    for kernel in COMPONENTS["weight_kernel"]:
        got = table(samplers.make("weighted", kernel, normalization=normalization), 0, achieved=achieved)
        assert np.isfinite(got).all()
        assert got[0] == 0
        assert got[1] == got[2]
        assert (got[1] > got[3]) == (normalization != "far")


def test_a_distance_that_is_none_leaves_no_goal_in_any_reading():
    for normalization in COMPONENTS["weight_normalization"]:
        for kernel in COMPONENTS["weight_kernel"]:
            sampler = samplers.make("weighted", kernel, lambda a, d: a[:, 0].at[3].set(jnp.nan), normalization)
            log_weights = sampler.log_weights(ACHIEVED, DESIRED, jnp.array(1), HP)
            assert samplers.draw(jax.random.key(0), log_weights[None])[0] == 5, (normalization, kernel)


def test_readings_are_lanes_of_one_program():
    """The choice is traced, so one compiled function serves all."""
    every = [
        samplers.make("weighted", k, normalization=n)
        for n in COMPONENTS["weight_normalization"]
        for k in COMPONENTS["weight_kernel"]
    ]
    lane = collections.namedtuple("Lane", (*HParams._fields, "choice"))
    joined = jax.jit(lambda choice: samplers.join(every).log_weights(ACHIEVED, DESIRED, jnp.array(1), lane(*HP, choice)))
    for choice, sampler in enumerate(every):
        np.testing.assert_allclose(samplers.probabilities(joined(choice)), table(sampler, 1), atol=1e-6)
    assert joined._cache_size() == 1


@pytest.mark.parametrize("kernel", COMPONENTS["weight_kernel"])
def test_a_scale_of_any_size_that_is_allowed_leaves_goals(kernel):
    """With a micrometre the nearest is likeliest, by however little; with 1,000 km it is `future` but for rounding."""
    sampler, future = samplers.make("weighted", kernel, normalization="none"), table(samplers.make("future"), 0)
    tiny, huge = (table(sampler, 0, HP._replace(weight_scale=scale)) for scale in (1e-6, 1e6))
    assert np.isfinite(tiny).all()
    assert np.argmax(tiny) == 2
    np.testing.assert_allclose(huge, future, atol=1e-5)


@pytest.mark.parametrize(
    ("normalization", "given"),
    [
        (lambda distance, candidates, scale: jnp.mean(distance), "float32[]"),
        (lambda distance, candidates, scale: jnp.argsort(distance), "int32[30]"),
        (lambda distance, candidates, scale: jnp.where(candidates, distance, jnp.nan), "not finite"),
        (lambda distance, candidates: distance, "(distance, candidates, scale)"),
    ],
)
def test_what_is_no_normalization_is_named(normalization, given):
    with refuses("weight_normalization", given):
        check_normalization(normalization)
