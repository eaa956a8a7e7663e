"""Runs, sweeps and policies at their odd ends: cut in the last evaluation, stopped early, split, without a number or a file."""

import contextlib
import dataclasses
import importlib
import json
import math
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from configs import SHORT, TINY
from conftest import refuses
from sweep_helpers import LONGER, compile_once, make_grid, run  # noqa: F401
from test_comparison import cell

import mjx_dher
from mjx_dher import HParams, Options, RunSpec, cli, gym, import_paths, relabel, replay, samplers, trainer
from mjx_dher.cli import sweep
from mjx_dher.cli.report import compare
from mjx_dher.cli.sweep import parse_sweep_args
from mjx_dher.cli.train import parse_train_args
from mjx_dher.context import Context, return_bounds
from mjx_dher.fleet import chunks
from mjx_dher.policy import bundled, learner_policy
from mjx_dher.runs import driver, program
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder
from mjx_dher.sweeps import comparison, grid, tables
from mjx_dher.system.files import FolderError
from point_mass import PointMass

SPEC = RunSpec(env="point_mass:PointMass", config=TINY)


def cut(*args, **options):
    raise KeyboardInterrupt


@pytest.mark.parametrize("stop_at", [None, 0.5])
def test_a_run_that_keeps_its_end_and_is_cut_in_its_last_evaluation_is_finished(tmp_path, monkeypatch, stop_at):
    monkeypatch.setattr(Options, "is_reached", lambda self, rates: self.stop_at is not None and len(rates) == 2)
    spec = dataclasses.replace(SPEC, config=SHORT)
    options = Options(final_episodes=4, keep_end=True, stop_at=stop_at)
    (whole,) = driver.train_runs(PointMass(), [spec], [tmp_path / "whole"], options=options)
    with monkeypatch.context() as patch:
        patch.setattr(program, "evaluate", cut)
        with pytest.raises(KeyboardInterrupt):
            driver.train_runs(PointMass(), [spec], [tmp_path / "cut"], options=options)
    assert not results.has_result(tmp_path / "cut")
    assert cli.main(["resume", str(tmp_path / "cut"), "--no-curve"]) == 0
    assert results.read_result(tmp_path / "cut")["epochs"] == whole.epoch
    first, second = (results.read(tmp_path / name) for name in ("whole", "cut"))
    assert [row["success_rate"] for row in first.rows] == [row["success_rate"] for row in second.rows]
    assert first.result["return_mean"] == second.result["return_mean"]
    first, second = (mjx_dher.load_policy(tmp_path / name / "policy.npz") for name in ("whole", "cut"))
    np.testing.assert_array_equal(first.layers[0][0], second.layers[0][0])
    with refuses("has ended", error=FolderError) if stop_at is None else contextlib.nullcontext():  # else it ends there again
        driver.train_runs(PointMass(), [spec], [tmp_path / "cut"], options=options)


def test_episode_lengths_of_numpy_end_with_a_result(tmp_path):
    (ended,) = driver.train_runs(PointMass(np.int64(10)), [SPEC], [tmp_path / "run"], options=Options(final_episodes=2))
    assert ended.status == "finished"


def test_a_mean_at_the_limit_stops_live_and_read_again():
    live = [float(np.float32(rate)) for rate in (0.7, 1.0, 1.0)]
    assert Options(stop_at=0.9).is_reached(live)
    assert Options(stop_at=0.9).is_reached([0.7, 1.0, 1.0])
    assert Options(stop_at=0.95).is_reached([0.95] * 3)
    assert not Options(stop_at=0.9).is_reached([0.69, 1.0, 1.0])


def test_a_trial_that_stopped_early_is_trained_again(tmp_path):
    trials = make_grid(samplers=("future",), seeds=(0,), static=LONGER)
    run(tmp_path, trials)
    folder = grid.folder_of(tmp_path, trials[0])
    assert results.is_done(folder, trials[0])
    for name, field in (("result.json", "epochs"), ("metrics.csv", "")):
        text = (folder / name).read_text()
        if field:
            (folder / name).write_text(json.dumps({**json.loads(text), field: 1}))
        else:
            (folder / name).write_text("\n".join(text.splitlines()[:2]) + "\n")
    assert not results.is_done(folder, trials[0])
    with refuses("240 of 1,200 steps", "train it again", error=FolderError):
        tables.read(tmp_path)


def test_a_trial_without_a_return_is_in_the_tables(tmp_path):
    trials = make_grid(samplers=("future",), seeds=(0,))
    run(tmp_path, trials)
    path = grid.folder_of(tmp_path, trials[0]) / "result.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "return_mean": None}))
    (trial,) = found = tables.read(tmp_path)
    assert math.isnan(trial["final"]["return_mean"])
    tables.write(tmp_path, found)
    for name, column in np.load(tmp_path / "results.npz").items():  # without pickled objects
        assert column.dtype != object, name


def test_a_sweep_says_which_episodes_it_keeps_and_ends_with_2_if_all_runs_failed(tmp_path, capsys):
    trials = make_grid(samplers=("future",), seeds=(0, 1))
    run(tmp_path, trials)
    args = SimpleNamespace(out=tmp_path, baseline="future", threshold=0.9, options=Options(final_episodes=99))
    console = cli.PlainConsole()
    assert sweep.announce(args, trials, console) == []
    assert "final_episodes: done runs keep theirs, which had 15" in capsys.readouterr().out
    args.options = Options(final_episodes=15)
    sweep.announce(args, trials, console)
    assert "final_episodes" not in capsys.readouterr().out
    for number, trial in enumerate(trials):
        path = grid.folder_of(tmp_path, trial) / "result.json"
        failed = {"status": "failed", "reason": "it is not finite", "epochs": 2}
        path.write_text(json.dumps({**json.loads(path.read_text()), **failed}))
        assert sweep._end(args, trials, [], 0, console) == (2 if number else 0)


def test_runs_that_devices_share_are_a_setting_of_their_own(tmp_path):
    trials = make_grid(samplers=("future",), seeds=(0, 1))
    run(tmp_path, trials)
    path = grid.folder_of(tmp_path, trials[1]) / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "devices": 2}))
    assert [trial["settings"]["source"] for trial in tables.read(tmp_path)] == ["", "2 devices"]


def test_an_engine_that_was_named_or_chosen_is_the_same_run():
    first, second = ({**cell("future", 0, [0.1]), "asked_engine": name, "folder": name} for name in ("auto", "native"))
    (group,) = comparison.groups([first, second])["push"]
    assert group.seeds == (0,)
    with refuses("the same run", error=FolderError):
        comparison.groups([first, {**first, "folder": "a copy"}])
    given, meant = (fingerprint.trial_name(RunSpec(hparams=HParams(her_k=k))) for k in (4, 4.0))
    assert given == meant


def test_settings_of_other_flags_devices_or_lengths_are_not_compared(tmp_path, capsys):
    settings = (("future", {"source": ""}), ("weighted", {"source": "JAX_RANDOM_SEED_OFFSET 1000"}))
    cells = [cell(sampler, i, [0.1, 0.5, i / 9], **own) for i in (0, 1) for sampler, own in settings]
    rows = comparison.compare(comparison.groups(cells)["push"], "future", 0.9)
    assert all(math.isnan(row.better) for row in rows)
    longer = [cell("weighted", i, [0.1, 0.5, i / 9, 0.9, 0.9, 0.9], source="") for i in (0, 1)]
    rows = comparison.compare(comparison.groups([*cells[::2], *longer])["push"], "future", 0.9)
    assert [math.isnan(value) for value in (rows[1].better, rows[1].area_gain, rows[1].p_value)] == [True] * 3
    arms = [(sampler, on) for sampler in ("future", "weighted") for on in ("", "2 devices")]
    placed = [cell(sampler, i, [0.1, 0.5, i / 9], source=on) for sampler, on in arms for i in (0, 1)]
    by_env = comparison.groups(placed)
    bases = [comparison._baseline_of(group, by_env["push"], "future") for group in by_env["push"]]
    assert [base and base.label for base in bases] == [None, None, "future", "future, 2 devices"]
    by_env["push"].pop(0)
    compare(tmp_path, by_env, "future", 0.9, cli.PlainConsole(width=500))
    told = "push: no baseline 'future' of the same length and other settings for: weighted\n"
    assert told in capsys.readouterr().out
    as_long = [cell("weighted", i, [0.1, 0.5, i / 9, 0.9], source="") for i in (0, 1)]
    rows = comparison.compare(comparison.groups([*cells[::2], *as_long])["push"], "future", 0.9)
    assert not math.isnan(rows[1].area_gain)  # one epoch more: totals are rounded up


def test_environments_whose_names_differ_in_case_have_their_own_pictures():
    stems = fingerprint.in_paths(["mine:Reach", "mine:reach", "push"])
    assert stems["push"] == "push"
    assert len(set(stems.values())) == 3
    assert {stem[:10] for name, stem in stems.items() if name != "push"} == {"mine-reach"}


def test_chunks_that_share_a_run_are_not_both_trained(tmp_path):
    trials = make_grid(samplers=("future",), seeds=(33, 34, 35, 36))
    task = chunks.Task(0, 1)
    for own in (trials[:2], trials):
        chunks.make_folder(chunks.make(tuple(own), Options(), None, task, tmp_path, {}))
    assert chunks.unfinished(tmp_path, trials, trials) == [tuple(trials)]


def test_lists_in_two_parts_are_refused_and_unread_components_told(tmp_path):
    out = ["--out", str(tmp_path / "sweep"), "--seeds", "1"]
    with refuses("--sampler", "2 times"):
        parse_sweep_args([*out, "--sampler", "future", "--sampler", "weighted"])
    with refuses("--sweep.her-k", "2 times"):
        parse_sweep_args([*out, "--sweep.her-k", "2", "--sweep.her-k", "4"])
    with refuses("--env-kwargs", "2 times"):
        parse_train_args(["--env-kwargs", "reward_type=dense", "--env-kwargs=episode_length=20"])
    assert parse_train_args(["--env", "reach", "--seed", "1", "--env", "push", "--seed", "2"]).spec.seed == 2
    said = []
    parse_sweep_args([*out, "--sampler", "future", "--metric", "velocity", "--weight-kernel", "softmax"], said.append)
    assert len(said) == 1
    assert said[0].endswith(": weight_kernel, metric")
    for command in (parse_sweep_args, parse_train_args):
        said.clear()
        own = out if command is parse_sweep_args else []
        command([*own, "--env", "arm_reach", "--sampler", "final", "--priority", "energy"], said.append)
        assert len(said) == 1
        assert "no effect at priority_fraction 0" in said[0]
        command([*own, "--env", "push", "--sampler", "future", "--priority", "energy"], said.append)
        assert len(said) == 1


@pytest.mark.parametrize("flag", ["--env", "--preset", "--learner", "--config"])
def test_a_flag_without_its_value_is_named(capsys, flag):
    assert cli.main(["--seed", "1", flag]) == 2
    said = capsys.readouterr()
    assert flag in said.err + said.out
    assert "sys.exit" not in said.err


def test_arguments_of_a_file_need_trust_although_the_name_is_typed(tmp_path, monkeypatch):
    (tmp_path / "owned.py").write_text("class Env:\n    def __init__(self, hook=''):\n        raise OSError(hook)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    evil = dataclasses.replace(SPEC, env="owned:Env", env_kwargs=("hook=echo",))
    run_folder.write_config(tmp_path / "evil", evil, "none", {"lanes": 1})

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another user"))

    def load(*words):
        run = parse_train_args(["--config", "evil", *words]).spec
        return import_paths.load("env", run.env), run.env_kwargs

    for words in ((), ("--env", "owned:Env"), ("--env", "owned:Env", "--env-kwargs", "other=1")):
        with refuses("owned:Env", "with the arguments hook=echo", "--trust"):
            load(*words)
    made, arguments = load("--env", "owned:Env", "--env-kwargs", "hook=echo")  # all is typed
    assert (made.__name__, arguments) == ("Env", ("hook=echo",))


def test_a_folder_that_lost_its_config_is_not_taken_for_a_bundled_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reach").mkdir()
    assert bundled.is_shipped(bundled.find("reach"))
    mjx_dher.load_policy("reach").save(tmp_path / "reach" / "policy.npz")
    with refuses("config.json", error=FolderError):
        mjx_dher.load_policy("reach")
    with refuses("it is a file", error=FolderError):
        reading.read_config(tmp_path / "reach" / "policy.npz")


def test_a_policy_that_was_not_copied_is_told_from_one_that_was_never_written(tmp_path):
    driver.train_runs(PointMass(), [SPEC], [tmp_path / "run"], options=Options(final_episodes=2))
    os.unlink(tmp_path / "run" / "policy.npz")
    with refuses("removed or not copied", error=FolderError):
        mjx_dher.load_policy(tmp_path / "run")
    (tmp_path / "run" / "policy.npz").mkdir()
    with refuses("is not a file", error=FolderError):
        mjx_dher.load_policy(tmp_path / "run")


def test_a_policy_keeps_its_interface_in_a_copy(tmp_path):
    policy = dataclasses.replace(mjx_dher.load_policy("reach"), interface={"dt": 0.04})
    policy.save(str(tmp_path / "copy.npz"))
    assert mjx_dher.load_policy(tmp_path / "copy.npz").interface == policy.interface


def test_a_tuple_stands_for_a_list_of_observations():
    leaf = jax.ShapeDtypeStruct((2,), jnp.float32)
    like = {"a": [leaf, (leaf, leaf)], "b": leaf}
    x = np.zeros(2, np.float32)
    found = learner_policy._with_lists({"a": (x, [x, x]), "b": x}, like)
    assert jax.tree.structure(found) == jax.tree.structure(like)


def test_equal_arguments_of_other_types_and_reloaded_modules_are_other_environments(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    body = "from point_mass import PointMass\nclass Mode(PointMass):\n    def __init__(self, mode=0):\n"
    (tmp_path / "moded.py").write_text(f"{body}        super().__init__(10)\n        self.mode = mode\n")
    made = [gym.GymEnv("moded:Mode", mode=mode).unwrapped._compiled.env.mode for mode in (1, True, 1.0)]
    assert [type(mode) for mode in made] == [int, bool, float]
    import moded

    (tmp_path / "moded.py").write_text(f"{body}        super().__init__(13)\n        self.mode = mode  # changed\n")
    importlib.reload(moded)
    assert gym.GymEnv("moded:Mode", mode=1).unwrapped._compiled.env.episode_length == 13


def test_numbers_of_a_run_without_a_folder_are_checked_and_bounds_are_finite():
    train = trainer.make_train(PointMass(), TINY)
    with refuses("gamma", 1.0):
        train.init(jax.random.key(0), HParams(gamma=1.0))
    for gamma in (1.0, jnp.float32(1.0)):
        low, high = return_bounds((-1.0, 0.0), gamma)
        assert (low < -1e37, high) == (True, 0)
    assert [float(x) for x in return_bounds((-1.0, 2.0), 0.5)] == [-2.0, 4.0]
    with refuses("norm_clip", 3e38):
        mjx_dher.validation.validate(TINY, HParams(norm_clip=3e38), 10)
    with refuses("temperature", 1e-7):
        mjx_dher.validation.validate(TINY, HParams(temperature=1e-7), 10)


@pytest.mark.parametrize("normalization", ["mean", "far"])
def test_equally_far_goals_have_a_weight_at_the_least_temperature(normalization):
    sampler = samplers.make("weighted", normalization=normalization)
    hparams = HParams(temperature=1e-6)
    for number in range(100):
        rng = np.random.default_rng(number)
        achieved = jnp.full((21, 3), rng.uniform(0.1, 1), jnp.float32)
        weights = samplers.weigh(sampler, achieved, jnp.asarray(rng.uniform(size=3), jnp.float32), jnp.int32(0), hparams)
        assert jnp.max(weights) > -jnp.inf


def test_a_goal_that_no_sampler_offers_is_the_achieved_one():
    goals = jnp.arange(8.0).reshape(1, 4, 2)
    one = jnp.ones(1, jnp.int32)
    sample = replay.Sample(
        *(goals[:, 1], goals[:, 2], jnp.zeros((1, 2)), goals),
        **{"desired_goal": jnp.full((1, 2), 99.0), "step": one, "row": 0 * one, "length": 3 * one, "terminal": one > 1},
    )
    nothing = lambda achieved, desired, step, hparams: jnp.full(achieved.shape[0], -jnp.inf)  # noqa: E731
    context = Context(PointMass().compute_reward, HParams(her_k=math.inf))
    batch = jax.jit(lambda sample: relabel.relabel(sample, nothing, context, jax.random.key(0)).batch)(sample)
    np.testing.assert_array_equal(batch.desired_goal, [[99.0, 99.0]])
    np.testing.assert_array_equal(batch.hindsight_goal, goals[:, 2])
