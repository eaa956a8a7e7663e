import dataclasses
import errno
import re
import signal
import tempfile

import pytest
from sweep_helpers import CONFIG, DEFAULT, LONGER, TIMES, compile_once, cut_short, make_grid, run, spec_of, table  # noqa: F401

import point_mass as point_mass_module
from mjx_dher import HParams, cli, config
from mjx_dher.cli import common
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.components import COMPONENTS, Component
from mjx_dher.runs.folder import fingerprint
from mjx_dher.sweeps import grid, tables


@pytest.mark.slow
def test_two_commands_share_a_sweep_and_the_last_one_s_tables_have_it_all(tmp_path, point_mass, capsys):
    out = ["--lanes", "2", "--out", str(tmp_path / "shared")]
    assert cli.main([*COMMAND, *out, "--seeds", "1", "--first-seed", "1"]) == 0
    assert {row["seed"] for row in table(tmp_path / "shared", tables.FINALS)} == {"1"}
    assert cli.main([*COMMAND, *out, "--seeds", "1"]) == 0
    written = {name: (tmp_path / "shared" / name).read_bytes() for name in ("results.csv", "finals.csv", "comparison.csv")}
    assert len(table(tmp_path / "shared", tables.FINALS)) == 4
    assert cli.main([*COMMAND, *out]) == 0
    assert "4 runs; 4 of them are done already" in capsys.readouterr().out
    assert written == {name: (tmp_path / "shared" / name).read_bytes() for name in written}


@pytest.fixture
def point_mass(monkeypatch):
    monkeypatch.setitem(COMPONENTS["env"], "point_mass", Component("point_mass:PointMass", ""))


COMMAND = [
    *(
        "sweep",
        "--preset",
        "cpu",
        "--env",
        "point_mass",
        "--sampler",
        "future",
        "weighted",
        "--seeds",
        "2",
        "--final-episodes",
        "20",
    ),
    *("--num-envs", "8", "--cycles-per-epoch", "3", "--updates-per-cycle", "4", "--batch-size", "32", "--total-steps", "800"),
    *("--replay-size", "400", "--hidden-sizes", "16", "--eval-episodes", "20", "--lanes", "4", "--threshold", "0.2"),
]


def test_the_command_line_sweeps_and_goes_on_and_plots(tmp_path, point_mass, capsys):
    out = ["--out", str(tmp_path / "sweep")]
    assert cli.main([*COMMAND, *out]) == 0
    first = capsys.readouterr().out
    assert "4 runs; writing to" in first
    assert "100%  point_mass, 4 runs: epoch 4/4" in first
    assert cli.main([*COMMAND, *out, "--sweep.her-k", "4", "8"]) == 0
    # The preset's k is 16; two samplers, two numbers, two seeds are new.
    assert "8 runs; writing to" in capsys.readouterr().out
    assert cli.main([*COMMAND, *out]) == 0
    assert "4 runs; 4 of them are done already" in capsys.readouterr().out
    assert len(table(tmp_path / "sweep", tables.FINALS)) == 12
    assert cli.main(["plot", str(tmp_path / "sweep"), "--out", str(tmp_path / "pictures"), "--threshold", "0.2"]) == 0
    written = {path.name: path.stat().st_size for path in (tmp_path / "pictures").iterdir()}
    names = [f"point_mass_{name}.{end}" for name in ("curves", "thresholds", "comparison") for end in ("png", "svg")]
    assert sorted(written) == sorted(["comparison.csv", *names])
    assert min(written[name] for name in names) > 5000
    before = (tmp_path / "sweep" / "comparison.csv").read_bytes()
    for command in ("plot", "report"):
        assert cli.main([command, str(tmp_path / "sweep"), "--baseline", "weigted"]) == 2
        assert "error: baseline must be one of future, " in capsys.readouterr().err
    assert before == (tmp_path / "sweep" / "comparison.csv").read_bytes()
    own = ["--baseline", "weighted, her_k 8", "--formats", "svg"]
    assert cli.main(["plot", str(tmp_path / "sweep"), *own, "--out", str(tmp_path / "pictures")]) == 0
    assert before != (tmp_path / "pictures" / "comparison.csv").read_bytes()


def test_a_folder_that_cannot_be_written_to_is_reported_before_anything_compiles(tmp_path, point_mass, capsys, monkeypatch):
    def read_only(dir):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "mkdtemp", read_only)  # as permissions do not stop root
    assert cli.main([*COMMAND, "--out", str(tmp_path / "sweep")]) == 2
    told = capsys.readouterr()
    assert "cannot be written to (Read-only file system)" in told.err
    assert "compiling" not in told.out


def interrupting(monkeypatch, after, number):
    """The epochs that are shown; in the one after which `after` are, the signal comes."""
    show, seen = common.Screen.show, []

    def interrupt(screen, specs, progress):
        seen.append(progress.epoch)
        if len(seen) == after:
            signal.raise_signal(number)
        show(screen, specs, progress)

    monkeypatch.setattr(common.Screen, "show", interrupt)
    return seen


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_ends_the_sweep_after_the_epoch_and_keeps_what_is_done(tmp_path, point_mass, monkeypatch, capsys, number):
    """In the first epoch of the second of two programs."""
    seen = interrupting(monkeypatch, 5, number)
    handler = signal.getsignal(number)
    command = [*COMMAND, "--lanes", "2", "--out", str(tmp_path)]
    assert cli.main(command) == 128 + number
    said = capsys.readouterr().out
    assert "stopping after this epoch" in said
    assert "stopped; 2 runs are done; run the same command again for the other 2" in said
    assert seen == [1, 2, 3, 4, 1]
    assert signal.getsignal(number) == handler
    assert len(table(tmp_path, tables.FINALS)) == 2
    assert cli.main(command) == 0
    assert seen[5:] == [2, 3, 4]
    said = capsys.readouterr().out
    assert "after epoch 1" in said
    assert "100%  point_mass, 2 runs: epoch 4/4" in said


@pytest.mark.parametrize(("lanes", "done", "status"), [(2, 2, 128 + signal.SIGINT), (4, 4, 0)])
def test_a_signal_in_the_last_epoch_loses_nothing(tmp_path, point_mass, monkeypatch, capsys, lanes, done, status):
    """Of the first of two programs, which has results by then, or of the only one, after which there is nothing to stop."""
    seen = interrupting(monkeypatch, 4, signal.SIGINT)
    assert cli.main([*COMMAND, "--lanes", str(lanes), "--out", str(tmp_path)]) == status
    assert seen == [1, 2, 3, 4]
    assert len(list(tmp_path.glob("cells/*/result.json"))) == done
    assert (tmp_path / tables.FINALS).exists() == (status == 0)
    assert not (tmp_path / "unfinished").exists()
    assert ("run the same command again for the other 2" in capsys.readouterr().out) == (done == 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--env", "pusj"], "env must be one of .*; got 'pusj' .did you mean 'push'"),
        (["--sampler", "future", "weihgted"], "sampler must be one of .*did you mean 'weighted'"),
        (["--sampler"], "sampler must be one or more names; got none"),
        (["--weight-kernel", "cubic"], "weight_kernel must be one of linear, inverse, softmax, .*; got 'cubic'"),
        (["--metric", "speed"], "metric must be one of position, .*; got 'speed'"),
        (["--seeds", "0"], r"seeds must lie in \[1, .*; got 0"),
        (["--first-seed", "-1"], r"first_seed must lie in \[0, .*; got -1"),
        (["--checkpoint-every", "-1"], r"checkpoint_every must lie in \[0, .*; got -1"),
        (["--baseline", "futrue, k 4"], r"baseline, .* must be one of random, .* got 'futrue' \(did you mean 'future'"),
        (["--lanes", "0"], r"lanes must lie in \[1, .*; got 0"),
        (["--threshold", "2"], r"threshold must lie in \(0, 1\]; got 2"),
        (["--sweep.gamma", "0.9", "1.5"], r"gamma must lie in \[0, 0.9999999\]; got 1.5"),
        (["--sweep.gamma"], r"sweep.gamma must be one or more numbers; got none"),
        (["--seeds", "2", "--first-seed", "4294967295"], r"first_seed must lie in \[0, 4294967294\]; got 4294967295"),
        (["--batch-size", "0"], r"batch_size must lie in \[1, .*; got 0"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_written(tmp_path, arguments, said, capsys):
    assert cli.main(["sweep", "--out", str(tmp_path / "new"), *arguments]) == 2
    assert not (tmp_path / "new").exists()
    assert re.search(said, capsys.readouterr().err)


def test_what_a_later_program_cannot_train_is_refused_before_the_first_one_trains(tmp_path, point_mass, monkeypatch, capsys):
    """A cycle of the second task does not fit into its ring."""
    monkeypatch.setattr(point_mass_module, "Long", lambda: point_mass_module.PointMass(60), raising=False)
    monkeypatch.setitem(COMPONENTS["env"], "long", Component("point_mass:Long", ""))
    command = [*COMMAND, "--seeds", "1", "--out", str(tmp_path / "new" / "sweep")]
    command.insert(command.index("point_mass") + 1, "long")
    for more in ([], ["--dry-run"]):
        assert cli.main([*command, *more]) == 2
        assert re.search("replay_size must hold at least one cycle of 8 episodes x 60 steps", capsys.readouterr().err)
        assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_that_shares_a_checkpoint_does_not_resume_alone(tmp_path, capsys):
    trials = make_grid(static=LONGER, seeds=(0,), env="point_mass:PointMass")
    cut_short(tmp_path, trials, 1, lanes=2)
    assert cli.main(["resume", str(grid.folder_of(tmp_path, trials[0]))]) == 2
    assert "the sweep's command resumes them" in capsys.readouterr().err


def test_a_folder_that_holds_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("")
    assert cli.main(["sweep", "--out", str(tmp_path)]) == 2
    assert "holds something other than a sweep" in capsys.readouterr().err
    assert cli.main(["plot", str(tmp_path)]) == 2
    assert "is neither a run folder nor a sweep" in capsys.readouterr().err
    assert cli.main(["plot", str(tmp_path), "--formats", "jpg"]) == 2
    assert "formats must be among png, svg, pdf; got jpg" in capsys.readouterr().err


OTHERS = ("--learner-dtype", "bfloat16", "--engine", "jax")


def test_every_number_and_every_size_can_be_set():
    args, trials = cli_args("--sweep.her-k", "2", "4", "--num-envs", "4", "--hidden-sizes", "8", "8", "--seeds", "3", *OTHERS)
    assert {t.hparams.her_k for t in trials} == {2.0, 4.0}
    assert {t.config.num_envs for t in trials} == {4}
    assert {t.config.hidden_sizes for t in trials} == {(8, 8)}
    assert {(t.config.learner_dtype, t.engine) for t in trials} == {("bfloat16", "jax")}
    assert len(trials) == 4 * 2 * 3
    assert {*vars(args.sweep)} == set(HParams._fields)
    assert {*vars(args.changes)} == {f.name for f in dataclasses.fields(config.Config)}


def test_a_larger_sweep_has_the_trials_of_a_smaller_one():
    """Also of samplers that do not read what is added, whatever comes first."""
    plain = ["--sampler", "future", "--seeds", "1"]
    more = ["--sampler", "weighted", "future", "--metric", "velocity", "--sweep.temperature", "3", "1", "--seeds", "1"]
    small, large = ({fingerprint.trial_name(trial) for trial in cli_args(*argv)[1]} for argv in (plain, more))
    assert small < large
    assert len(large) == 3


def cli_args(*argv):
    return cli_sweep.parse_sweep_args(["--out", "nowhere", "--preset", "cpu", *argv])


@pytest.mark.parametrize(
    ("asked", "priorities"),
    [
        ([], {"energy"}),
        (["--priority", "eventful", "td_error"], {"eventful", "td_error"}),
        (["--learner", "ddpg"], {"eventful"}),
    ],
)
def test_a_sweep_has_the_preset_s_priority_unless_others_are_named(asked, priorities):
    command = ["--out", "x", "--env", "pick_and_place", "--preset", "cpu", "--sampler", "future", "--seeds", "1", *asked]
    assert {trial.priority for trial in cli_sweep.parse_sweep_args(command)[1]} == priorities
