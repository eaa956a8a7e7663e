"""Runs on four devices: tests/test_devices.py calls pytest with this file in a process where a CPU stands for four."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SMALL
from jax.sharding import PartitionSpec

from mjx_dher import HParams, Options, RunSpec, envs, learners, normalizer, trainer
from mjx_dher.contract import env_spec
from mjx_dher.parallel import mesh
from mjx_dher.parallel import split as split_lib
from mjx_dher.runs import driver, loop
from mjx_dher.runs.folder import results
from mjx_dher.types import Batch
from probes import Explodes, PointMass, spec_of

ENV = PointMass()
# Two epochs of 240 steps; rings of 40 episodes.
CONFIG = dataclasses.replace(SMALL, num_envs=8, batch_size=32, replay_size=400, hidden_sizes=(16,), total_steps=480)
SPEC = spec_of(3, 2, 2)
DEVICES = (1, 2, 4)


def in_parts(number, function, in_specs, out_specs):
    """`function` of an axis name, on so many devices."""
    if number == 1:
        return jax.jit(functools.partial(function, None))
    layout = mesh.arrange(mesh.find(number), 1)
    local = functools.partial(function, layout.axis_name)
    return jax.jit(jax.shard_map(local, mesh=layout.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False))


WHOLE, PARTED = PartitionSpec(), PartitionSpec(mesh.DATA)


def make_batch(size=64):
    keys = jax.random.split(jax.random.key(5), 5)
    return Batch(
        observation=jax.random.normal(keys[0], (size, 3)),
        next_observation=jax.random.normal(keys[1], (size, 3)),
        desired_goal=jax.random.normal(keys[2], (size, 2)),
        action=jax.random.uniform(keys[3], (size, 2), minval=-1, maxval=1),
        reward=-jax.random.bernoulli(keys[4], 0.5, (size,)).astype(jnp.float32),
        discount=jnp.full(size, 0.98),
        row=jnp.arange(size),
        hindsight_goal=jax.random.normal(keys[2], (size, 2)),
    )


SLOW = [pytest.param(name, "mlp", marks=pytest.mark.slow) for name in ("td3", "sac", "csac", "redq", "tqc", "dtqc", "crl")]


@pytest.mark.parametrize(("name", "networks"), [("ddpg", "mlp"), ("sac", "layer_norm"), *SLOW])
def test_the_gradient_of_a_batch_is_that_of_its_parts(name, networks):
    """By Adam's moments after one update, a tenth and a thousandth of the gradient and its square."""
    learner = learners.make(name, dataclasses.replace(CONFIG, learner_dtype="float32"), SPEC, networks)
    state = learner.init(jax.random.key(0))

    def update(axis_name, state, batch):
        own = learners.over_axis(learner, axis_name)
        state, metrics = own.update(state, batch, trainer.as_arrays(HParams()))
        return state, split_lib.mean(metrics, axis_name)

    states = [in_parts(n, update, (WHOLE, PARTED), (WHOLE, WHOLE))(state, make_batch()) for n in DEVICES]
    moments = [[getattr(s, field) for field in vars(s) if field.endswith(("moments", "opt_state"))] for s, _ in states]
    assert max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(moments[0])) > 1e-3
    for other, (_, metrics) in zip(moments[1:], states[1:]):
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-7), other, moments[0])
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), metrics, states[0][1])


def test_parts_that_do_not_average_learn_something_else():
    """So that the test above can fail."""
    learner = learners.make("ddpg", CONFIG, SPEC)
    state = learner.init(jax.random.key(0))
    update = lambda axis_name, state, batch: learner.update(state, batch, trainer.as_arrays(HParams()))[0]  # noqa: E731
    one, two = (in_parts(n, update, (WHOLE, PARTED), WHOLE)(state, make_batch()) for n in (1, 2))
    difference = jax.tree.map(lambda a, b: float(jnp.max(jnp.abs(a - b))), one.opt_state, two.opt_state)
    assert max(jax.tree.leaves(difference)) > 1e-4


def test_moments_of_the_normalizers_are_those_of_all_parts():
    """Also where valid values lie in some parts only."""
    values = 3.0 + jax.random.normal(jax.random.key(0), (16, 5, 2))
    valid = (jnp.arange(16) % 3 > 0) & (jnp.arange(16) < 12)  # none in the last of four parts
    before = normalizer.update(normalizer.init(jnp.zeros(2)), values[:3] - 1.0, 200.0)

    def update(axis_name, state, values, valid):
        return normalizer.update(state, values, 200.0, valid[:, None], axis_name)

    kept = np.concatenate([np.asarray(values[:3] - 1.0).reshape(-1, 2), np.asarray(values[valid]).reshape(-1, 2)])
    for number in DEVICES:
        after = in_parts(number, update, (WHOLE, PARTED, PARTED), WHOLE)(before, values, valid)
        assert float(after.count) == len(kept)
        np.testing.assert_allclose(after.mean, kept.mean(0), rtol=1e-5)
        np.testing.assert_allclose(after.var, kept.var(0), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("devices", [2, 4])
def test_each_device_plays_episodes_of_its_own(devices):
    """All episodes are counted, the discarded ones too, and no two are alike."""
    env, config = Explodes(jnp.nan), dataclasses.replace(CONFIG, cycles_per_epoch=1, eval_episodes=10)
    progress = next(loop.train(env, config, HParams(random_eps=1.0), devices=devices))
    sizes = np.asarray(progress.state.replay.size)
    assert sizes.shape == (devices,)
    assert progress.metrics["discarded_episodes"] == 8 - sizes.sum() > 0
    episodes = np.asarray(progress.state.replay.episodes.action).reshape(40, -1)
    played = [row.tobytes() for row in episodes if row.any()]
    assert len(set(played)) == len(played) == sizes.sum()
    assert float(progress.state.learner.observation_norm.count) == sizes.sum() * (env.episode_length + 1)


def specs_of(number):
    spec = RunSpec(env="point_mass", config=CONFIG)
    return [dataclasses.replace(spec, seed=seed) for seed in range(number)]


def train(folder, number=1, epoch=None, env=ENV, **options):
    """Trains runs; stops after `epoch`. Returns what their files say, times left out, and their last learners."""
    seen, states = [], []

    def on_epoch(specs, progress):
        seen.append(progress.epoch)
        states.append(jax.device_get(progress.state.learner))

    driver.train_runs(
        env,
        specs_of(number),
        [folder / str(seed) for seed in range(number)],
        options=Options(final_episodes=15, checkpoint_every=0),
        on_epoch=on_epoch,
        should_stop=lambda: seen[-1] == epoch,
        sweep=number > 1,
        **options,
    )
    times = ("wall_seconds", "steps_per_second", "updates_per_second", "memory_bytes")
    rows = [results.read_rows(folder / str(seed) / "metrics.csv") for seed in range(number)]
    return [[{k: v for k, v in row.items() if k not in times} for row in run] for run in rows], states[-1]


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_close(row, other):
    """Numbers of a row agree to rounding, and texts, such as the settings' digest, are the same."""
    assert row.keys() == other.keys()
    for name, value in row.items():
        assert other[name] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-3, nan_ok=True)), name


def test_lanes_on_two_devices_are_those_of_one_to_the_bit(tmp_path):
    rows, learner = train(tmp_path / "one", 4, lanes=4)
    rows_of_two, learner_of_two = train(tmp_path / "two", 4, lanes=4, devices=2)
    assert rows == rows_of_two
    assert_same(learner, learner_of_two)


@pytest.mark.slow
def test_lanes_are_filled_up_to_what_the_devices_divide(tmp_path):
    """Three runs on four devices; as one by one."""
    rows, _ = train(tmp_path / "one", 3, lanes=1)
    rows_of_four, _ = train(tmp_path / "four", 3, devices="all")
    assert len(rows) == 3
    for run, other in zip(rows, rows_of_four):
        for row, row_of_four in zip(run, other):
            assert_close(row, row_of_four)


@pytest.mark.slow
def test_a_run_resumes_on_as_many_devices_to_the_bit(tmp_path):
    rows, learner = train(tmp_path / "whole", devices=2)
    train(tmp_path / "cut", epoch=1, devices=2)
    rows_again, learner_again = train(tmp_path / "cut", devices=2)
    assert rows == rows_again
    assert_same(learner, learner_again)


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(4, 1), (4, 2), (1, 4)])
def test_a_run_resumes_on_another_number_of_devices(tmp_path, before, after):
    """All its episodes and steps count on."""
    train(tmp_path, epoch=1, devices=before)
    rows, learner = train(tmp_path, devices=after)
    assert [row["epoch"] for row in rows[0]] == [1, 2]
    assert [row["discarded_episodes"] for row in rows[0]] == [0, 0]
    assert learner.observation_norm.count == CONFIG.total_steps / ENV.episode_length * (ENV.episode_length + 1)


@pytest.mark.slow
def test_lanes_go_on_with_another_number_of_devices(tmp_path):
    """Three lanes on one device, then on four, which are filled up by one; and back."""
    rows, _ = train(tmp_path / "whole", 3, lanes=3)
    for before, after in (({"lanes": 3}, {"devices": 4}), ({"devices": 4}, {"lanes": 3})):
        folder = tmp_path / "-".join(before)
        train(folder, 3, epoch=1, **before)
        again, _ = train(folder, 3, **after)
        for run, other in zip(rows, again):
            assert [row["epoch"] for row in other] == [1, 2]
            assert_close(run[1], other[1])
        assert not (folder / "unfinished").exists()


def refuse(match, tmp_path, number=1, env=ENV, config=CONFIG, **options):
    specs = [dataclasses.replace(spec, config=config) for spec in specs_of(number)]
    folders = [tmp_path / str(seed) for seed in range(number)]
    with pytest.raises(ValueError, match=match):
        driver.train_runs(env, specs, folders, **options)
    assert not tmp_path.exists() or not any(tmp_path.iterdir())


@pytest.mark.parametrize("devices", [5, 10**20, 0, -1, True, 1.5, "", "two", None, float("nan")])
def test_devices_that_are_not_there_are_refused(tmp_path, devices):
    match = r"devices must lie in \[1, 4\].* or be all; got 5" if devices == 5 else r"devices must be an integer in \[1, "
    refuse(match, tmp_path / "runs", devices=devices)


@pytest.mark.parametrize(
    ("field", "value", "nearest"),
    [("num_envs", 6, "4 or 8"), ("batch_size", 33, "32 or 36"), ("replay_size", 410, "400 or 440")],
)
def test_sizes_that_devices_do_not_divide_are_refused(tmp_path, field, value, nearest):
    config = dataclasses.replace(CONFIG, **{field: value})
    refuse(
        f"{field} must be .*multiple of 4.*; got {value}, the nearest are {nearest}",
        tmp_path / "runs",
        config=config,
        devices=4,
    )
    with pytest.raises(ValueError, match=f"{field} must be"):
        next(loop.train(ENV, config, devices=4))


def test_lanes_that_devices_do_not_divide_are_refused(tmp_path):
    refuse("lanes must be a multiple of 4, the devices, or 1, 2; got 3", tmp_path / "runs", number=6, lanes=3, devices=4)


def test_a_learner_that_cannot_be_split_is_refused():
    class Own:
        def __init__(self, learner):
            for method in vars(learners.Learner):
                if not method.startswith("_"):
                    setattr(self, method, getattr(learner, method))

    own = Own(learners.make("ddpg", CONFIG, env_spec(ENV)))
    with pytest.raises(ValueError, match=r"learner Own .* axis_name"):
        next(loop.train(ENV, CONFIG, learner=own, devices=2))


def test_layouts():
    devices = tuple(jax.devices())
    found = {runs: mesh.arrange(devices, runs) for runs in (1, 2, 3, 4, 40)}
    assert {runs: (layout.lanes, layout.shards) for runs, layout in found.items()} == {
        1: (1, 4),
        2: (2, 2),
        3: (4, 1),
        4: (4, 1),
        40: (4, 1),
    }
    assert mesh.arrange((), 3) is mesh.ONE
    assert mesh.ONE.axis_name is None
    assert found[1].axis_name == mesh.DATA
    assert found[4].axis_name is None
    assert found[1].sharers == 4  # of the memory of one CPU
    assert mesh.find(1) == ()
    assert len(mesh.find("all")) == 4


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_engines_on_several_devices(engine):
    """The callback of `native` is called by all devices at once, each with its share of the environments."""
    env = envs.make("reach", engine=engine)
    config = dataclasses.replace(CONFIG, replay_size=50 * 80, total_steps=2 * 3 * 8 * 50, eval_episodes=6)
    several = [jax.device_get(progress) for progress in loop.train(env, config, devices=4)]
    assert len(several) == 2
    assert several[-1].metrics["discarded_episodes"] == 0.0
    assert bool(several[-1].finite)
