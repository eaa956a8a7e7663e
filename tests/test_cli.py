import csv
import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT, refuses
from rich.console import Console

import mjx_dher
from mjx_dher import Options, RunSpec, cli, config, presets
from mjx_dher.cli import common
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.cli import train as cli_train
from mjx_dher.runs.loop import Progress

TINY = """
    --num-envs 2 --cycles-per-epoch 1 --updates-per-cycle 2 --target-period 1 --batch-size 16 --total-steps 200
    --replay-size 1000 --hidden-sizes 8 8 --eval-episodes 2 --final-episodes 4
""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A whole tiny run of the command, as a user starts it: (run folder, completed process)."""
    out = tmp_path_factory.mktemp("cli") / "run"
    command = [sys.executable, "train.py", "--env", "push", "--sampler", "weighted", *TINY, "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out, done


def test_a_run_writes_its_folder(finished):
    out, _ = finished
    names = {".lock", "config.json", "metrics.csv", "policy.npz", "result.json"}
    assert {path.name for path in out.iterdir()} == names | {"curve.png"}
    content = json.loads((out / "config.json").read_text())
    assert (content["env"], content["sampler"], content["physics"]) == ("push", "weighted", "native")
    assert {"jax", "mujoco", "mjx_dher", "python"} <= set(content["versions"])
    with (out / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0])[:6] == ("epoch", "env_steps", "updates", "wall_seconds", "success_rate", "return_mean")
    assert [(row["epoch"], row["env_steps"], row["updates"]) for row in rows] == [("1", "100", "2"), ("2", "200", "4")]
    assert {row.pop("digest") for row in rows} == {content["digest"]}
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    result = json.loads((out / "result.json").read_text())
    assert result["success_low"] <= result["success_rate"] <= result["success_high"]
    assert (result["episodes"], result["env_steps"]) == (4, 200)


def test_a_run_says_what_it_does(finished):
    out, done = finished
    lines = done.stdout.splitlines()
    assert lines[0] == f"push, sampler weighted, seed 0; writing to {out}"
    assert lines[1].startswith("push: compiling for one run; physics native, learner on")
    assert "replay ring 130.6 kB" in lines[1]
    assert lines[2].startswith("push: compiled in ")
    for number in (1, 2):
        line = lines[2 + number]
        assert line.startswith(f"epoch {number}/2  {number * 100} steps")
        assert all(word in line for word in ("steps/s", "updates/s", "success", "return", "ETA"))
    assert lines[5].startswith("success ")
    assert "95 % interval" in lines[5]
    assert "already at reset" in lines[5]
    assert lines[6:] == [f"run folder: {out}", f"learning curve: {out / 'curve.png'}"]
    assert done.stderr == ""


def test_the_policy_of_a_run_loads(finished):
    policy = mjx_dher.load_policy(finished[0])
    assert policy({"observation": np.zeros((5, 25)), "desired_goal": np.zeros((5, 3))}).shape == (5, 4)


def test_eval_plays_a_run_again(finished, capsys):
    for _ in range(2):
        assert cli.main(["eval", str(finished[0]), "--episodes", "6"]) == 0
    first, second = capsys.readouterr().out.split("push: 6 episodes")[1:]
    assert "6 episodes); already at reset" in first
    assert first == second


def test_an_existing_run_is_never_overwritten(finished, capsys):
    out = finished[0]
    before = {path: path.read_bytes() for path in out.iterdir()}
    assert cli.main(["--out", str(out)]) == 2
    assert f"error: out: {out} exists and is never overwritten" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.iterdir()} == before


HUGE = str(10**20)
BAD = [
    (["--learning-rate", "0.01"], ["--learning-rate is called --actor-lr and --critic-lr here"]),
    (["--buffer-size", "1000"], ["--buffer-size is called --replay-size here"]),
    (["--tau=0.05"], ["--tau is called --polyak here, which is 1 - tau: tau 0.05 is --polyak 0.95"]),
    (["--seed", HUGE], [f"seed must lie in [0, 4294967295]; got {HUGE}"]),
    (["--cycles-per-epoch", HUGE], [f"cycles_per_epoch must lie in [1, 1000000]; got {HUGE}"]),
    (["--updates-per-cycle", HUGE], [f"updates_per_cycle must lie in [1, 1000000]; got {HUGE}"]),
    (["--total-steps", HUGE], [f"total_steps must lie in [1, 2000000000]; got {HUGE}"]),
    (["--hidden-sizes", HUGE], [f"hidden_sizes must lie in [1, 65536]; got {HUGE}"]),
    (["--eval-episodes", HUGE], [f"eval_episodes must lie in [1, 1000000]; got {HUGE}"]),
    (["--checkpoint-every", HUGE], [f"checkpoint_every must lie in [0, 1000000]; got {HUGE}"]),
    (["sweep", "--out", "x", "--seeds", HUGE], [f"seeds must lie in [1, 1000000]; got {HUGE}"]),
    (["--env", "pusch"], ["env must be one of arm_reach, ", ", or module:attribute; got 'pusch' (did you mean 'push'"]),
    (["--env", "not_there:Task"], ["env 'not_there:Task': there is no module 'not_there' in the current folder or on"]),
    (["--env", "tasks/mine.py:Task"], ["env must be module:attribute, with the module's name as in `import`; got"]),
    (["--sampler", "not_there:soon"], ["sampler 'not_there:soon': there is no module 'not_there'"]),
    (["sweep", "--out", "x", "--sampler", "not_there:soon"], ["sampler 'not_there:soon': there is no module 'not_there'"]),
    (["render", "--env", "not_there:Task", "--out", "x.png"], ["env 'not_there:Task': there is no module 'not_there'"]),
    (["--sampler", "wheighted"], ["sampler must be one of random, episode, future", "(did you mean 'weighted'?)"]),
    (["--preset", "papr"], ["preset must be one of auto, cpu, gpu, frugal, paper; got 'papr' (did you mean 'paper'?)"]),
    (["--weight-kernel", "cubic"], ["weight_kernel must be one of linear, inverse, softmax, or module:attribute; got 'cubic'"]),
    (["--metric", "speed"], ["metric must be one of position", ", or module:attribute; got 'speed'"]),
    (["--num-envs", "0"], ["num_envs must lie in [1, 1000000]; got 0"]),
    (["--num-envs", "-3"], ["num_envs must lie in [1, 1000000]; got -3"]),
    (["--batch-size", "2000001"], ["batch_size must not exceed replay_size (1000000); got 2000001"]),
    (
        ["--replay-size", "1500"],
        ["replay_size must hold at least one cycle of 32 episodes x 50 steps = 1600 transitions; got 1500"],
    ),
    (["--gamma", "1.0"], ["gamma must lie in [0, 0.9999999]; got 1.0"]),
    (["--final-episodes", "0"], ["final_episodes must lie in [1, 1000000]; got 0"]),
    (["--env", "x", "--num-envs", "0", "--gamma", "2"], ["env must be", "num_envs must lie", "gamma must lie"]),
    (
        ["evall", "runs/x"],
        [
            "command must be one of train, resume, eval, render, view, demo, transfer, export, sweep, plot, report, list, ",
            "got 'evall' (did you mean 'eval'?)",
        ],
    ),
    (["eval", "runs/not-there"], ["runs/not-there is not a run folder: no such folder"]),
    (["eval", "docs"], ["docs is not a run folder: it has no config.json"]),
    (["eval", "docs", "--episodes", "0"], ["episodes must lie in [1, 1000000]; got 0"]),
    (["eval", "docs", "--engine", "wrap"], ["engine must be one of auto, native, jax, warp; got 'wrap'"]),
]


@pytest.mark.parametrize(("argv", "messages"), BAD)
def test_bad_arguments_are_refused_with_a_line_each(argv, messages, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert cli.main(argv) == 2
    error = capsys.readouterr().err
    assert all(line.startswith("error: ") for line in error.splitlines())
    assert len(error.splitlines()) == max(1, len([m for m in messages if " must " in m]))
    for message in messages:
        assert message in error


def test_bad_arguments_are_refused_before_jax_or_mujoco_load():
    """So a refusal takes a fraction of a second."""
    code = f"""
import sys
from mjx_dher.cli import main
assert all(main(argv) == 2 for argv in {[argv for argv, _ in BAD]!r})
assert not {{"jax", "mujoco"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)


def test_presets_are_the_base_that_options_override():
    args = cli_train.parse_train_args(["--preset=paper", "--env", "push", "--num-envs", "4", "--gamma", "0.9"])
    base = presets.preset("paper", "push")
    assert args.spec.config == dataclasses.replace(base.config, num_envs=4)
    assert args.spec.hparams == base.hparams._replace(gamma=0.9)
    assert cli_train.parse_train_args([]).spec == presets.preset("cpu", "push")
    assert cli_train.parse_train_args([]).preset == "cpu"


@pytest.mark.parametrize("parse", [cli_train.parse_train_args, lambda argv: cli_sweep.parse_sweep_args(["--out", "x", *argv])])
def test_a_wrong_name_is_refused_before_the_gpu_is_asked_for(parse, monkeypatch):
    """Asking which preset this machine takes starts CUDA, where JAX has a plug-in for it."""
    monkeypatch.setattr(presets, "machine_preset", lambda: pytest.fail("CUDA has started"))
    with refuses("sampler"):
        parse(["--sampler", "futur"])
    with refuses("gamma"):
        parse(["--gamma", "1.5"] if parse is cli_train.parse_train_args else ["--sweep.gamma", "1.5"])


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
def test_the_machine_s_preset_is_taken(preset, monkeypatch):
    monkeypatch.setattr(presets, "machine_preset", lambda: preset)
    args = cli_train.parse_train_args(["--env", "slide", "--gamma", "0.9"])
    expected = presets.preset(preset, "slide")
    assert args.spec == dataclasses.replace(expected, hparams=expected.hparams._replace(gamma=0.9))
    _, trials = cli_sweep.parse_sweep_args(["--out", "x", "--env", "slide", "--seeds", "1", "--sampler", "future"])
    assert trials == [expected]


def test_a_learner_that_is_not_the_preset_s_has_the_numbers_of_ddpg():
    own = presets.preset("gpu", "slide")
    ddpg = presets.preset("gpu", "slide", learner="ddpg")
    assert (own.learner, own.networks, own.config.n_step) == ("dtqc", "layer_norm", 3)
    assert (ddpg.learner, ddpg.networks, ddpg.config.n_step) == ("ddpg", "mlp", 1)
    assert presets.preset("gpu", "slide", learner="sac") == dataclasses.replace(ddpg, learner="sac")
    assert presets.preset("gpu", "slide", learner="dtqc", networks="mlp") == dataclasses.replace(own, networks="mlp")
    gpu = ["--env", "slide", "--preset", "gpu"]
    assert cli_train.parse_train_args(gpu).spec == cli_train.parse_train_args([*gpu, "--learner", "dtqc"]).spec == own
    assert cli_train.parse_train_args([*gpu, "--learner=ddpg"]).spec == ddpg
    _, trials = cli_sweep.parse_sweep_args(
        ["--out", "x", *gpu, "--seeds", "1", "--sampler", "future", "--learner", "ddpg", "dtqc"]
    )
    assert trials == [ddpg, own]


def test_help_names_every_option(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    fields = [f.name for owner in (config.Config, RunSpec, Options) for f in dataclasses.fields(owner)]
    fields = [*(name for name in fields if name not in ("config", "hparams")), *config.HParams._fields]
    for field in [*fields, "seed", "out", "preset", "final_episodes"]:
        assert f"--{field.replace('_', '-')}" in text


@pytest.mark.parametrize("chosen", [True, False])
def test_compiled_programs_are_kept_where_the_user_says_or_in_the_cache_folder(tmp_path, chosen):
    code = (
        "from mjx_dher.system import machine; machine.keep_compiled_programs(); import jax;"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0); jax.jit(lambda x: x + 1)(1.0)"
    )
    clean = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    chosen_folder = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine")} if chosen else {}
    environment = {**clean, "XDG_CACHE_HOME": str(tmp_path), **chosen_folder}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, env=environment)
    kept = tmp_path / ("mine" if chosen else "mjx-dher/xla")
    assert list(kept.glob("jit_*"))
    assert [path.name for path in tmp_path.iterdir()] == ["mine" if chosen else "mjx-dher"]


def progress(epoch, rate):
    metrics = {"success_rate": np.asarray(rate), "return_mean": np.asarray(-20.0)}
    return Progress(epoch, 4, 1000 * epoch, 100 * epoch, 2.0 * epoch, 2.0, metrics, None, True)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_of_one_run(terminal):
    screen = io.StringIO()
    shown = common.Screen(Console(file=screen, force_terminal=terminal, width=200), [RunSpec()])
    shown.show([RunSpec()], progress(1, 0.5))
    shown.close()
    assert "epoch 1/4  1,000 steps  500 steps/s  50 updates/s  success 0.50  return -20.0  ETA 0:06" in screen.getvalue()


def test_progress_of_many_runs():
    specs = [RunSpec(seed=seed, sampler=sampler) for seed in (0, 1) for sampler in ("future", "weighted")]
    screen = io.StringIO()
    shown = common.Screen(Console(file=screen, force_terminal=True, width=200), [*specs, *specs])
    shown.show(specs, progress(2, [0.5, 0.0, 0.7, 0.2]))
    shown.close()
    assert "25%  push, 4 runs: epoch 2/4  success future 0.60  weighted 0.10  ETA" in screen.getvalue()


POINT_MASS = ["--env", "docs.examples.point_mass:PointMass"]


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_learned_and_says_where(tmp_path):
    out = tmp_path / "run"
    long = [*POINT_MASS, *TINY, "--total-steps", "40000", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "train.py", *long], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.time() + 120
    while not (out / "policy.npz").exists() and time.time() < deadline:
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stdout + stderr
    assert "stopping after this epoch" in stdout
    assert f"the policy so far is in {out}" in stdout
    assert stderr == ""
    mjx_dher.load_policy(out)
    epochs = int(stdout.split("stopped after epoch ")[1].split()[0])
    assert 1 <= epochs < 2000
    assert len((out / "metrics.csv").read_text().splitlines()) == 1 + epochs


@pytest.mark.slow
def test_ctrl_c_twice_stops_at_once_with_the_last_saved_policy(tmp_path):
    out = tmp_path / "run"
    slow = [*POINT_MASS, *TINY, "--total-steps", "1000000000", "--num-envs", "1000", "--replay-size", "10000"]
    slow += ["--cycles-per-epoch", "200", "--updates-per-cycle", "10", "--batch-size", "1000"]
    process = subprocess.Popen(
        [sys.executable, "-u", "train.py", *slow, "--out", str(out)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.time() + 120
    while not (out / "policy.npz").exists() and time.time() < deadline:
        time.sleep(0.1)
    time.sleep(1)  # into the second epoch, which takes seven: a signal between two epochs would end the run at once
    os.kill(process.pid, signal.SIGINT)
    time.sleep(0.7)
    os.kill(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stdout
    assert stderr == f"stopped at once; saved work is in {out}\n"
    assert "stopped after epoch" not in stdout
    mjx_dher.load_policy(out)


def test_an_unwritable_out_is_refused(tmp_path, capsys):
    blocker = tmp_path / "file"
    blocker.write_text("")
    for command in ("train", "sweep"):
        assert cli.main([command, "--out", str(blocker / "run")]) == 2
        assert f"error: {blocker / 'run'}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["sweep", "--out", "/proc/x", "--seeds", "1"], "/proc/x"),
        (["sweep", "--out", "/dev/null/x", "--seeds", "1"], "/dev/null/x"),
        (["--env", "json:dumps"], "env must be a component; 'json:dumps'"),
        (["--sampler", "docs.examples.point_mass:nonsense"], "has no 'nonsense'"),
        (["--metric", "json:JSONDecoder"], "metric"),
        (["--networks", "json:dumps"], "networks"),
        (["--learner", "json:dumps"], "learner"),
        (["--env", "breaks:Task"], "env 'breaks:Task': importing it failed: ZeroDivisionError"),
    ],
)
def test_no_file_system_or_plug_in_ends_in_a_traceback(argv, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "breaks.py").write_text("1 / 0")
    assert cli.main([*argv, *([] if "sweep" in argv else ["--out", "run"])]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert not (tmp_path / "run").exists()


def test_a_reader_that_goes_is_no_error():
    """As in `python train.py --help | head -1`."""
    command = [sys.executable, "train.py", "--help"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 128 + signal.SIGPIPE
