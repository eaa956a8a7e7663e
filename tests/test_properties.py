"""What must hold for all values, tried on many: the same ones in every run."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_replay import T, make_episodes, make_ring

from mjx_dher import config, replay
from mjx_dher.config import Config, HParams

every_run_alike = settings(deadline=None, max_examples=60, derandomize=True)

SIZES = [f.name for f in dataclasses.fields(Config) if f.type == "int"]
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
    config.validate(found, HParams())
    epochs, steps = config.num_epochs(found, 50), config.steps_per_epoch(found, 50)
    assert steps == found.num_envs * 50 * found.cycles_per_epoch
    assert (epochs - 1) * steps < found.total_steps <= epochs * steps
    capacity = config.episodes_capacity(found, 50)
    assert capacity * 50 <= found.replay_size < (capacity + 1) * 50
    assert capacity >= found.num_envs


NO_COUNTS = st.one_of(st.integers(-(10**6), 0), st.floats(), st.booleans(), st.none(), st.text(max_size=3))


@given(configs(), st.sampled_from(SIZES), NO_COUNTS)
@every_run_alike
def test_what_is_no_count_is_refused_by_the_name_of_its_field(found, field, value):
    with pytest.raises(ValueError, match=f"{field} must be an integer of at least 1; got"):
        config.validate(dataclasses.replace(found, **{field: value}), HParams())


@given(configs(), st.one_of(st.lists(NO_COUNTS, min_size=1, max_size=3).map(tuple), st.just(()), st.just((True,)), counts))
@every_run_alike
def test_what_are_no_hidden_sizes_is_refused(found, sizes):
    with pytest.raises(ValueError, match="hidden_sizes must be one or more integers of at least 1"):
        config.validate(dataclasses.replace(found, hidden_sizes=sizes), HParams())


@given(st.sampled_from(HParams._fields), st.one_of(st.floats(), st.text(max_size=3), st.none()))
@every_run_alike
def test_a_number_is_taken_if_and_only_if_it_is_in_its_range(field, value):
    low, with_low, high, with_high = config._HPARAM_RANGES[field]
    inside = isinstance(value, float) and math.isfinite(value)
    inside = inside and (value >= low if with_low else value > low) and (value <= high if with_high else value < high)
    hparams = HParams(**{field: value})
    if inside:
        config.validate(Config(), hparams)
    else:
        with pytest.raises(ValueError, match=f"{field} must (lie in|be a number)"):
            config.validate(Config(), hparams)


ROWS = 5
add = jax.jit(lambda ring, episodes, eventful, valid: replay.add(ring, episodes, eventful, valid))
draw = jax.jit(lambda ring, key: replay.sample(ring, key, 64))
# Of each episode: is it eventful, is it valid.
added = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=3, max_size=3)


@given(st.lists(added, max_size=6), st.integers(0, 2**31 - 1))
@every_run_alike
def test_a_ring_holds_the_newest_valid_episodes_and_nothing_else(batches, seed):
    ring, model = make_ring(ROWS), []
    for number, batch in enumerate(batches):
        ids = 3 * number + np.arange(3) + 1
        eventful, valid = np.array(batch).T
        ring = add(ring, make_episodes(ids), eventful, valid)
        model += [(i, e) for i, e, v in zip(ids, eventful, valid) if v]
    model = model[-ROWS:]
    size = int(ring.size)
    assert size == len(model)
    rows = ring.episodes.action[:size, 0, 0] // 1000
    assert sorted(zip(rows.tolist(), ring.eventful[:size].tolist())) == sorted((float(i), bool(e)) for i, e in model)
    assert bool(replay.can_sample(ring)) == bool(model)
    assert replay.count_eventful(ring)[-1] == sum(e for _, e in model)
    if model:
        sample = draw(ring, jax.random.key(seed))
        ids, steps = np.divmod(np.asarray(sample.observation["scalar"]), 1000)
        assert set(ids) <= {i for i, _ in model}
        np.testing.assert_array_equal(steps, sample.step)
        assert ((steps >= 0) & (steps < T)).all()
        np.testing.assert_array_equal(sample.next_observation["scalar"], 1000 * ids + steps + 1)
        np.testing.assert_array_equal(sample.desired_goal[:, 0], 1000 * ids + 500)
        np.testing.assert_array_equal(sample.episode_goals[:, :, 0], 1000 * ids[:, None] + np.arange(T + 1))
