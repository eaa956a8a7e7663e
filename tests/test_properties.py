"""What must hold for all values, tried on many: the same ones in every run."""

import dataclasses
import re

import jax
import numpy as np
from conftest import refuses
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from test_replay import T, make_episodes, make_ring

from mjx_dher import config, replay, validation
from mjx_dher.config import Config, HParams, Number

every_run_alike = settings(deadline=None, max_examples=60, derandomize=True)

INTERVALS = {name: number.interval for owner in (Config, HParams) for name, number in config.metadata(owner, Number).items()}
SIZES = [name for name in config.metadata(Config, Number) if name != "hidden_sizes"]
counts = st.integers(1, 300)


@st.composite
def configs(draw):
    """Configs that can run, by what their docstrings say."""
    num_envs, target_period = draw(counts), draw(st.integers(1, 40))
    replay_size = draw(st.integers(num_envs * 50, num_envs * 50 + 10_000))
    return Config(
        num_envs=num_envs,
        cycles_per_epoch=draw(counts),
        target_period=target_period,
        updates_per_cycle=target_period * draw(st.integers(1, 20)),
        replay_size=replay_size,
        batch_size=draw(st.integers(1, replay_size)),
        total_steps=draw(st.integers(1, 10**7)),
        eval_episodes=draw(counts),
        hidden_sizes=tuple(draw(st.lists(counts, min_size=1, max_size=4))),
    )


@given(configs())
@every_run_alike
def test_what_can_run_is_taken_and_its_sizes_agree(found):
    validation.validate(found, HParams(), 50)
    epochs, steps = config.num_epochs(found, 50), config.steps_per_epoch(found, 50)
    assert steps == found.num_envs * 50 * found.cycles_per_epoch
    assert (epochs - 1) * steps < found.total_steps <= epochs * steps
    capacity = config.episodes_capacity(found, 50)
    assert capacity * 50 <= found.replay_size < (capacity + 1) * 50
    assert capacity >= found.num_envs


def test_every_size_and_every_number_has_a_range():
    assert set(SIZES) == {field.name for field in dataclasses.fields(Config) if type(field.default) is int}
    assert INTERVALS.keys() == {*SIZES, "hidden_sizes", *HParams._fields}


NO_COUNTS = st.one_of(st.integers(-(10**6), 0), st.floats(), st.booleans(), st.none(), st.text(max_size=3))


@given(configs(), st.sampled_from(SIZES), NO_COUNTS)
@every_run_alike
def test_what_is_no_count_is_refused_by_the_name_of_its_field(found, field, value):
    assume(not (type(value) is int and value == 0 and INTERVALS[field].startswith("[0")))
    with refuses(field, INTERVALS[field], repr(value)):
        validation.validate(dataclasses.replace(found, **{field: value}), HParams(), 50)


@given(configs(), st.one_of(st.lists(NO_COUNTS, min_size=1, max_size=3).map(tuple), st.just(()), st.just((True,)), counts))
@every_run_alike
def test_what_are_no_hidden_sizes_is_refused(found, sizes):
    with refuses("hidden_sizes", INTERVALS["hidden_sizes"], repr(sizes[0] if isinstance(sizes, tuple) and sizes else sizes)):
        validation.validate(dataclasses.replace(found, hidden_sizes=sizes), HParams(), 50)


@given(st.sampled_from(HParams._fields), st.one_of(st.floats(), st.text(max_size=3), st.none()))
@every_run_alike
def test_a_number_is_taken_if_and_only_if_it_is_in_its_range(field, value):
    left, low, high, right = re.fullmatch(r"([\[(])(.+), (.+)([\])])", INTERVALS[field]).groups()
    inside = isinstance(value, float) and float(low) <= value <= float(high)
    inside = inside and (left == "[" or value != float(low)) and (right == "]" or value != float(high))
    hparams = HParams(**{field: value})
    if inside:
        validation.validate(Config(), hparams, 50)
    else:
        with refuses(field, INTERVALS[field], repr(value)):
            validation.validate(Config(), hparams, 50)


ROWS = 5
add = jax.jit(replay.add)
cumulate = jax.jit(lambda ring: replay.cumulative(ring).priority)
draw = jax.jit(lambda ring, key: replay.sample(ring, key, 64))
# Of each episode: its priority, exact in binary, and whether it is valid.
added = st.lists(st.tuples(st.sampled_from([0.0, 1.0, 0.25, 3.0, 2.0**20]), st.booleans()), min_size=3, max_size=3)


@given(st.lists(added, max_size=6), st.integers(0, 2**31 - 1))
@every_run_alike
def test_a_ring_holds_the_newest_valid_episodes_and_nothing_else(batches, seed):
    ring, model = make_ring(ROWS), []
    for number, batch in enumerate(batches):
        ids = 3 * number + np.arange(3) + 1
        priority, valid = (np.array(values) for values in zip(*batch))
        ring = add(ring, make_episodes(ids), priority.astype(np.float32), valid)
        model += [(i, p) for i, p, v in zip(ids, priority, valid) if v]
    model = model[-ROWS:]
    size = int(ring.size)
    assert size == len(model)
    rows = ring.episodes.action[:size, 0, 0] // 1000
    assert sorted(zip(rows.tolist(), ring.priority[:size].tolist())) == sorted((float(i), p) for i, p in model)
    assert bool(replay.can_sample(ring)) == bool(model)
    total = sum(p for _, p in model)
    unit = 2.0 ** np.floor(np.log2(total)) / 2**29 if total else 1.0
    expected = np.cumsum(np.array(ring.priority, np.float64) / unit)
    np.testing.assert_array_equal(cumulate(ring), expected)
    assert expected[-1] == total / unit
    if model:
        sample = draw(ring, jax.random.key(seed))
        ids, steps = np.divmod(np.asarray(sample.observation["scalar"]), 1000)
        assert set(ids) <= {i for i, _ in model}
        np.testing.assert_array_equal(steps, sample.step)
        assert ((steps >= 0) & (steps < T)).all()
        np.testing.assert_array_equal(sample.next_observation["scalar"], 1000 * ids + steps + 1)
        np.testing.assert_array_equal(sample.desired_goal[:, 0], 1000 * ids + 500)
        np.testing.assert_array_equal(sample.episode_goals[:, :, 0], 1000 * ids[:, None] + np.arange(T + 1))
