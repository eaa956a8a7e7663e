import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import replay
from mjx_dher.types import Episode

T = 4
# Compiled as a whole. Tests of errors call them uncompiled, because only then do they see the values.
add, cumulative_of = jax.jit(replay.add), jax.jit(replay.cumulative)
sample_of, rows_of = jax.jit(replay.sample, static_argnums=2), jax.jit(replay.draw_rows, static_argnums=2)


def make_episodes(ids, num_steps=T):
    """Episodes in which every number says whose it is: episode id x 1000 + step (the goal: id x 1000 + 500)."""
    base = np.asarray(ids, np.float32)[:, None, None] * 1000
    steps = base + np.arange(num_steps + 1, dtype=np.float32)[None, :, None]
    episodes = Episode(
        observation={"vector": np.tile(steps, (1, 1, 3)), "scalar": steps[..., 0]},
        achieved_goal=np.tile(steps, (1, 1, 2)),
        desired_goal=np.tile(base[:, 0] + 500, (1, 2)),
        action=steps[:, :-1],
    )
    return jax.tree.map(jnp.asarray, episodes).filled()


def make_ring(num_rows):
    return replay.init(jax.tree.map(lambda x: x[0], make_episodes([0])), num_rows)


@pytest.mark.parametrize(("num_rows", "num_new"), [(1, 1), (3, 2), (3, 3), (8, 5)])
def test_wrap_around_never_mixes_episodes(num_rows, num_new):
    ring, added = make_ring(num_rows), 0
    for _ in range(7):
        ring = add(ring, make_episodes(np.arange(added, added + num_new)))
        added += num_new
        size = int(ring.size)
        assert size == min(added, num_rows)
        rows = ring.episodes
        ids = np.asarray(rows.action[:size, 0, 0]) // 1000
        # Exactly the newest episodes are there ...
        assert sorted(ids) == list(range(added - size, added))
        # ... each whole: every leaf of a row carries the row's id and its own step.
        expected = make_episodes(ids)
        jax.tree.map(lambda got, want, size=size: np.testing.assert_array_equal(got[:size], want), rows, expected)


def test_samples_are_transitions_of_one_episode_and_cover_all():
    ring = add(make_ring(6), make_episodes([1, 2, 3]))  # half full: the empty rows must not be drawn
    sample = sample_of(ring, jax.random.key(0), 4000)
    ids = np.asarray(sample.desired_goal[:, 0] - 500)
    step = np.asarray(sample.step)
    np.testing.assert_array_equal(sample.observation["vector"][:, 2], ids + step)
    np.testing.assert_array_equal(sample.observation["scalar"], ids + step)
    np.testing.assert_array_equal(sample.next_observation["vector"][:, 0], ids + step + 1)
    np.testing.assert_array_equal(sample.action[:, 0], ids + step)
    np.testing.assert_array_equal(sample.episode_goals[:, :, 1], ids[:, None] + np.arange(T + 1))
    assert set(zip(ids // 1000, step)) == {(i, t) for i in (1, 2, 3) for t in range(T)}


def test_can_sample_from_the_first_add_on():
    ring = make_ring(2)
    assert not replay.can_sample(ring)
    assert replay.can_sample(replay.add(ring, make_episodes([7])))


def test_nbytes_is_what_the_arrays_take():
    template = jax.tree.map(lambda x: x[0], make_episodes([0]))
    ring = replay.init(template, 11)
    assert replay.nbytes(template, 11) == sum(leaf.nbytes for leaf in jax.tree.leaves(ring.episodes))
    assert replay.capacity(ring) == 11
    without = dataclasses.replace(template, length=None, terminal=None)
    assert replay.nbytes(without, 11) == replay.nbytes(template, 11)


def test_refuses_more_than_it_holds():
    with refuses(3, 2):
        replay.add(make_ring(2), make_episodes([1, 2, 3]))


def test_refuses_an_empty_ring_and_lengths_that_disagree():
    template = jax.tree.map(lambda x: x[0], make_episodes([0]))
    with refuses("num_episodes", 0):
        replay.init(template, 0)
    with refuses("scalar", 5):
        replay.init(template.replace(observation=template.observation | {"scalar": jnp.zeros(4)}), 2)


def test_short_episodes_need_a_ring_for_them():
    """Else their padding would be drawn. Lengths of episodes that are not written do not matter."""
    episodes = dataclasses.replace(make_episodes([0, 1]), length=jnp.array([1, 2]))
    ring, ends = make_ring(4), replay.init(jax.tree.map(lambda x: x[0], episodes), 4, ends=True)
    with refuses("length", [1, 2], [T, T], "ends=True"):
        replay.add(ring, episodes)
    assert replay.add(ends, episodes).size == 2
    with refuses("length", [0, 2]):
        replay.add(ends, dataclasses.replace(episodes, length=jnp.array([0, 2])))
    kept = replay.add(ring, dataclasses.replace(episodes, length=jnp.array([1, T])), valid=jnp.array([False, True]))
    assert kept.size == 1


def test_draw_rows_mixes_by_priority_and_uniform():
    ring = add(make_ring(6), make_episodes([0, 1, 2, 3]), jnp.array([0.0, 1.0, 0.0, 1.0]))
    cumulative = cumulative_of(ring)
    np.testing.assert_array_equal(cumulative.priority, np.array([0, 1, 1, 2, 2, 2]) << 28)

    def shares(ring, share):
        rows = rows_of(ring, jax.random.key(0), 40_000, share, cumulative_of(ring))
        return np.bincount(rows, minlength=6) / 40_000

    # Rows 1 and 3 have a priority; rows 4 and 5 are empty.
    np.testing.assert_allclose(shares(ring, 0.0), [0.25, 0.25, 0.25, 0.25, 0, 0], atol=0.01)
    np.testing.assert_allclose(shares(ring, 1.0), [0, 0.5, 0, 0.5, 0, 0], atol=0.01)
    np.testing.assert_allclose(shares(ring, 0.6), [0.1, 0.4, 0.1, 0.4, 0, 0], atol=0.01)
    # What is written over has its new priority, and without any priority all are drawn alike.
    ring = add(ring, make_episodes([4, 5, 6, 7]), 0.0)
    np.testing.assert_allclose(shares(ring, 1.0), [0, 0, 0, 1, 0, 0], atol=0.01)
    ring = add(ring, make_episodes([8, 9]), 0.0)
    np.testing.assert_allclose(shares(ring, 1.0), np.full(6, 1 / 6), atol=0.01)


def test_rows_are_drawn_in_proportion_to_any_weights():
    """Weights of very different sizes; 1e-30 and 0 are never drawn beside 1e30."""
    for weights in ([3.0, 1.0, 0.0, 6.0], [3e-30, 1e-30, 0.0, 6e-30], [0.0, 1e-30, 0.0, 1e30]):
        ring = add(make_ring(4), make_episodes([0, 1, 2, 3]), jnp.array(weights))
        rows = rows_of(ring, jax.random.key(0), 40_000, 1.0, cumulative_of(ring))
        expected = np.array(weights) / sum(weights)
        np.testing.assert_allclose(np.bincount(rows, minlength=4) / 40_000, expected, atol=0.01)
        assert not np.any((np.array(weights) == 0)[rows])


def test_cumulative_priorities_are_exact_and_never_fall():
    """As counts of zeros and ones, and to a unit of the total in 2^29 for any weights."""
    rng = np.random.default_rng(0)
    for weights in (rng.integers(0, 2, 3000), rng.exponential(size=3000), rng.exponential(size=3000) ** 8):
        ring = make_ring(3000).replace(priority=jnp.asarray(weights, jnp.float32))
        cumulative = np.asarray(cumulative_of(ring).priority, np.int64)
        assert np.all(np.diff(cumulative) >= 0)
        assert 2**29 - 3000 <= cumulative[-1] <= 2**30 + 3000
        np.testing.assert_allclose(cumulative / cumulative[-1], np.cumsum(weights) / np.sum(weights), atol=1e-5)


def test_sample_takes_the_rows_it_is_given():
    ring = add(make_ring(6), make_episodes([1, 2, 3]))
    sample = sample_of(ring, jax.random.key(0), 4, jnp.array([2, 0, 2, 1]))
    np.testing.assert_array_equal(sample.desired_goal[:, 0], [3500, 1500, 3500, 2500])


def test_only_valid_episodes_are_written():
    """The others leave the ring as if they had never been: rows, cursor and size, over the wrap-around too."""
    four = make_episodes([10, 11, 12, 13])
    ring = add(ring_of_two(), four, jnp.array([1.0, 0.0, 2.0, 3.0]), jnp.array([False, True, False, True]))
    expected = replay.add(ring_of_two(), make_episodes([11, 13]), jnp.array([0.0, 3.0]))
    jax.tree.map(np.testing.assert_array_equal, ring, expected)
    ring = replay.add(ring, make_episodes([14, 15]), 1.0, jnp.array([False, True]))
    expected = replay.add(expected, make_episodes([15]), 1.0)
    jax.tree.map(np.testing.assert_array_equal, ring, expected)
    assert (int(ring.cursor), int(ring.size)) == (1, 4)
    untouched = replay.add(ring, make_episodes([16, 17]), 1.0, jnp.zeros(2, bool))
    jax.tree.map(np.testing.assert_array_equal, untouched, ring)


def ring_of_two():
    return replay.add(make_ring(4), make_episodes([1, 2]), jnp.array([1.0, 0.0]))


@pytest.mark.parametrize("number", [0, 1, 2, 50, 20_000, 65_535, 65_536, 65_537, 1_000_000_007, 2**31 - 1])
def test_randint_from_bits_is_the_upper_half_of_the_product(number):
    """Exactly, at the ends and on random bits; against 64-bit integers."""
    edges = [0, 1, 0xFFFF, 0x10000, 2**31 - 1, 2**31, 2**32 - 1]
    bits = np.concatenate([edges, np.random.default_rng(0).integers(0, 2**32, 10_000)]).astype(np.uint32)
    expected = (bits.astype(np.uint64) * np.uint64(number)) >> np.uint64(32)
    np.testing.assert_array_equal(replay.randint_from_bits(jnp.asarray(bits), number), expected)
    np.testing.assert_array_equal(jax.jit(replay.randint_from_bits)(jnp.asarray(bits), jnp.int32(number)), expected)
