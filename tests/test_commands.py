"""What users of command lines expect: names, versions, settings from files, dry runs, arguments of environments."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from configs import SHORT, flags
from conftest import EXAMPLES, names
from sweep_helpers import compile_once  # noqa: F401

import mjx_dher
from mjx_dher import RunSpec, cli, presets, spec
from mjx_dher.cli import COMMANDS, show
from mjx_dher.cli import train as cli_train
from mjx_dher.components import COMPONENTS
from mjx_dher.policy import bundled
from mjx_dher.runs.folder import fingerprint, reading

EPISODES = ["--final-episodes", "4"]
FLAGS = [*flags(SHORT), *EPISODES, "--no-curve"]


@pytest.fixture(autouse=True)
def examples(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of the point mass whose episodes have six steps."""
    out = tmp_path_factory.mktemp("commands") / "run"
    sys.path.insert(0, str(EXAMPLES))
    assert cli.main([*FLAGS, "--env-kwargs", "episode_length=6", "--seed", "3", "--out", str(out)]) == 0
    return out


# Names


def test_the_version_is_the_package_s(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"mjx-dher {mjx_dher.__version__}\n"


def test_list_names_all_that_there_is(capsys):
    assert set(show.FIELDS.values()) == set(COMPONENTS)
    assert tuple(show.ENGINES) == spec.ENGINES
    assert tuple(show.PRESETS) == ("auto", *presets.PRESETS)
    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    number = sum(map(len, [*COMPONENTS.values(), show.ENGINES, show.PRESETS, bundled.names()]))
    assert len(lines) == len(show.KINDS) + number
    assert "kernels (--weight-kernel)" in lines
    assert cli.main(["list", "tasks", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"tasks": {name: row.line for name, row in COMPONENTS["env"].items()}}
    assert cli.main(["list", "sampler"]) == 2
    names(capsys.readouterr().err, "kind", "sampler", "tasks")


def test_every_command_has_a_help_that_names_it(capsys):
    for name in COMMANDS:
        assert cli.main([name, "--help"]) == 0
        usage = capsys.readouterr().out.split("\n")[0]
        assert usage.startswith("usage: python train.py" + ("" if name == "train" else f" {name}")), usage


def test_the_help_names_the_preset_of_its_defaults(capsys, tmp_path, trained):
    for argv, told in (
        (["--env", "slide"], "Defaults below are those of preset cpu for slide."),
        (["--preset", "paper"], "Defaults below are those of preset paper for push."),
        (["--config", str(trained)], f"Defaults below are those of {trained}."),
    ):
        assert cli.main([*argv, "--help"]) == 0
        assert told in " ".join(capsys.readouterr().out.split())


def completions(words, script):
    """What bash offers for the last of `words`."""
    code = f'source "{script}"; COMP_WORDS=({" ".join(map(repr, words))}); COMP_CWORD={len(words) - 1}\n'
    code += "$(complete -p mjx-dher | sed -E 's/.*-F ([^ ]+) .*/\\1/'); printf '%s\\n' \"${COMPREPLY[@]}\""
    return subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_bash_completes_commands_and_options(tmp_path):
    script = tmp_path / "mjx-dher"
    script.write_text(show.completion("bash"))
    assert {"eval", "export", "engines"} == set(completions(["mjx-dher", "e"], script))
    assert completions(["mjx-dher", "eval", "--epi"], script) == ["--episodes"]
    assert {"--sampler"} <= set(completions(["mjx-dher", "train", "--sam"], script))
    assert set(completions(["mjx-dher", "train", "--engine", ""], script)) >= set(spec.ENGINES)


def test_the_other_shells_get_theirs(capsys):
    assert cli.main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef mjx-dher\n")
    assert cli.main(["completion", "fish"]) == 2
    names(capsys.readouterr().err, "shell", "fish", "bash")


# Settings of a file


def test_a_config_gives_the_same_settings_again(trained, capsys):
    args = cli_train.parse_train_args(["--config", str(trained)])
    assert args.spec == reading.read_spec(trained)
    assert (args.options.final_episodes, args.spec.seed, args.spec.env_kwargs) == (4, 3, ("episode_length=6",))
    changed = cli_train.parse_train_args(
        ["--config", str(trained / "config.json"), "--gamma", "0.5", "--seed", "9", "--keep", "1"]
    )
    assert changed.spec == dataclasses.replace(args.spec, seed=9, hparams=args.spec.hparams._replace(gamma=0.5))
    assert changed.options.keep == 1
    assert cli.main(["--config", str(trained), "--gamma", "0.5", "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert f"settings of {trained / 'config.json'}: point_mass:PointMass, sampler future, seed 3" in printed
    assert f"written by mjx-dher {mjx_dher.__version__}, physics none" in printed
    assert "changes: gamma 0.5 (0.95 in the file)" in printed


def test_a_run_that_is_trained_again_from_its_config_is_the_same_to_the_bit(trained, tmp_path):
    assert cli.main(["--config", str(trained), "--no-curve", "--out", str(tmp_path / "again")]) == 0
    first, second = (mjx_dher.load_policy(folder) for folder in (trained, tmp_path / "again"))
    obs = {"observation": np.ones((3, 2), np.float32), "desired_goal": np.zeros((3, 2), np.float32)}
    np.testing.assert_array_equal(first(obs), second(obs))


@pytest.mark.parametrize("content", [None, "", "[]", '{"schema": 3}', '{"schema": 2}'])
def test_what_is_no_config_is_refused(content, tmp_path, capsys):
    file = tmp_path / "config.json"
    if content is not None:
        file.write_text(content)
    assert cli.main(["--config", str(file), "--out", str(tmp_path / "run")]) == 2
    names(capsys.readouterr().err, file)
    assert not (tmp_path / "run").exists()


def test_an_edited_config_is_taken_as_it_is_and_wrong_numbers_in_it_are_named(trained, tmp_path, capsys):
    content = json.loads((trained / "config.json").read_text())
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({**content, "hparams": {**content["hparams"], "gamma": 0.25}}))
    assert cli.main(["--config", str(file), "--dry-run"]) == 0
    assert "edited since" in capsys.readouterr().out
    file.write_text(json.dumps({**content, "devices": 4}))  # the run has one again, unless --devices says otherwise
    assert cli.main(["--config", str(file), "--dry-run"]) == 0
    assert "physics none, on 4 devices\n" in capsys.readouterr().out
    for change, parts in (
        ({"hparams": {**content["hparams"], "gamma": 2}}, ["gamma", 2]),
        ({"hparams": {**content["hparams"], "gama": 0.5}}, ["gama"]),
        ({"config": {**content["config"], "num_envs": 10**20}}, ["num_envs", 10**20]),
        ({"env_kwargs": "episode_length=6"}, ["env_kwargs"]),
        ({"env_kwargs": [1]}, ["env_kwargs"]),
        ({"devices": "all"}, ["devices", "all"]),
    ):
        file.write_text(json.dumps({**content, **change}))
        assert cli.main(["--config", str(file)]) == 2
        names(capsys.readouterr().err, *parts)


def test_config_and_preset_are_not_given_together(trained, capsys):
    assert cli.main(["--config", str(trained), "--preset", "paper"]) == 2
    names(capsys.readouterr().err, "config", "preset")


# Dry runs


def test_a_dry_run_says_what_it_would_take_and_writes_nothing(tmp_path, capsys):
    out = tmp_path / "run"
    assert cli.main([*FLAGS, "--dry-run", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    # 2 environments x 2 cycles x 10 steps are 40 steps an epoch: 120 steps take 3 epochs, 3 x 2 x 4 updates.
    assert "3 epochs of 2 cycles: 120 environment steps, 24 updates of 16 transitions" in printed
    assert "memory: replay ring" in printed
    assert "epsilon" not in printed  # future does not read it
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("command", [["train"], ["sweep", "--seeds", "1"]])
def test_a_dry_run_refuses_what_a_run_would(command, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").write_text("")
    for argv, parts in (
        (["--out", str(taken)], ["out", taken]),
        (["--out", str(taken / "file" / "x")], ["out", taken / "file"]),
        (["--out", "/proc/x"], ["out", "/proc"]),  # also when root asks, who has all permissions
        (["--out", str(tmp_path / "new"), "--replay-size", str(10**10), "--env", "reach"], ["replay_size"]),
        (["--out", str(tmp_path / "new"), "--devices", "2", "--env", "reach", "--engine", "native"], ["devices", 2]),
    ):
        assert cli.main([*command, "--dry-run", *argv]) == 2
        names(capsys.readouterr().err, *parts)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_dry_run_of_a_sweep_counts_runs_and_programs(tmp_path, capsys):
    more = ["--sampler", "future", "weighted", "--learner", "ddpg", "td3", "--seeds", "3", "--sweep.her-k", "2", "4"]
    out = ["--out", str(tmp_path / "sweep")]
    assert cli.main(["sweep", *flags(SHORT), *EPISODES, *more, "--dry-run", *out]) == 0
    printed = capsys.readouterr().out
    assert "24 runs, 0 of them done already" in printed
    assert printed.count("24 updates of 16 transitions; 1,440 steps and 288 updates in all") == 2
    assert "programs: 2;" in printed
    assert not any(tmp_path.iterdir())


# Arguments of the environment


def test_arguments_are_texts_in_one_form():
    run = RunSpec(env_kwargs=("reward_type=dense", "distance_threshold=0.030"))
    assert run.env_kwargs == ("distance_threshold=0.03", "reward_type=dense")
    assert run == RunSpec(env_kwargs=("distance_threshold=3e-2", "reward_type=dense"))
    assert run.env_arguments == {"distance_threshold": 0.03, "reward_type": "dense"}
    assert RunSpec(env_kwargs=("a=true", "b=5")).env_arguments == {"a": True, "b": 5}
    assert spec.to_texts({"a": True, "b": 5}) == ("a=true", "b=5")


def test_arguments_are_part_of_what_a_run_is_and_none_leave_it_as_it_was():
    plain, dense = RunSpec(), RunSpec(env_kwargs=("reward_type=dense",))
    assert "env_kwargs" not in fingerprint.identity(plain, "native", {})
    assert fingerprint.identity(dense, "native", {})["env_kwargs"] == ["reward_type=dense"]
    assert fingerprint.trial_name(plain) == "push-future-s0-22e3e56bd2"
    assert fingerprint.trial_name(dense) != fingerprint.trial_name(plain)
    assert dense.program != plain.program
    told = fingerprint.differences(fingerprint.identity(plain, "native", {}), fingerprint.identity(dense, "native", {}))
    assert told == {"env_kwargs": "env_kwargs was () and is ['reward_type=dense']"}


BAD_KWARGS = [  # texts of --env-kwargs, and what the error must name
    (["dense"], ["env_kwargs", "dense"]),
    (["reward_type="], ["env_kwargs", "'reward_type='"]),
    ([""], ["env_kwargs"]),
    (["a b=3"], ["env_kwargs"]),
    (["distance_threshold=nan"], ["env_kwargs", "distance_threshold", "nan"]),
    (["distance_threshold=1e999"], ["env_kwargs", "distance_threshold", "1e999"]),
    (["reward_type=dense", "reward_type=sparse"], ["env_kwargs", "reward_type"]),
    (["engine=jax"], ["env_kwargs", "engine", "--engine"]),
    ([f"episode_length={10**20}"], ["episode_length", 10**20]),
    (["reward_tpye=dense"], ["reward_tpye", "reward_type"]),
    (["reward_type=densee"], ["reward_type", "densee", "dense"]),
    (["distance_threshold=-1"], ["distance_threshold", -1]),
]


@pytest.mark.parametrize("command", [["train"], ["train", "--dry-run"], ["sweep", "--seeds", "1", "--dry-run"]])
def test_arguments_that_cannot_be_are_refused(command, tmp_path, capsys):
    out = tmp_path / "run"
    for texts, parts in BAD_KWARGS:
        assert cli.main([*command, "--env", "reach", "--engine", "native", "--env-kwargs", *texts, "--out", str(out)]) == 2
        names(capsys.readouterr().err, *parts)
    assert not any(tmp_path.iterdir())


def test_a_run_has_its_arguments_wherever_it_is_played_again(trained, tmp_path, capsys):
    assert json.loads((trained / "config.json").read_text())["env_kwargs"] == ["episode_length=6"]
    # 2 environments x 2 cycles x 6 steps
    assert reading.read_run(trained)[1].env_arguments == {"episode_length": 6}
    assert (trained / "metrics.csv").read_text().splitlines()[1].startswith("1,24,")
    assert cli.main(["eval", str(trained), str(trained), "--episodes", "5", "--json"]) == 0
    captured = capsys.readouterr()
    first, second = map(json.loads, captured.out.splitlines())
    assert first == second
    assert (first["run"], first["env_kwargs"], first["episodes"]) == (str(trained), {"episode_length": 6}, 5)
    assert 0 <= first["success_low"] <= first["success_rate"] <= first["success_high"] <= 1
    # An action moves the point by 0.1 at most, and a goal is 0.8 away at most along an axis: one step is less than six.
    assert cli.main(["eval", str(trained), "--env-kwargs", "episode_length=1", "--episodes", "5", "--json"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["env_kwargs"] == {"episode_length": 1}
    assert json.loads(line)["return_mean"] >= -1


def test_eval_reads_all_runs_before_it_plays_one(trained, tmp_path, capsys):
    assert cli.main(["eval", str(trained), str(tmp_path / "none"), "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "is not a run folder" in captured.err
    assert cli.main(["eval", "reach", str(trained), "--env-kwargs", "reward_type=dense", "--json"]) == 2  # the point has none
    captured = capsys.readouterr()
    assert captured.out == ""
    names(captured.err, "point_mass:PointMass", "reward_type")
    assert cli.main(["eval"]) == 2


def test_trials_of_a_sweep_have_their_arguments(tmp_path, capsys):
    more = ["--env-kwargs", "episode_length=6", "--sampler", "future", "--seeds", "1", "--out", str(tmp_path / "sweep")]
    assert cli.main(["sweep", *flags(SHORT), *EPISODES, *more]) == 0
    header, line = (tmp_path / "sweep" / "finals.csv").read_text().splitlines()
    assert dict(zip(header.split(","), line.split(",")))["env_kwargs"] == "episode_length=6"
    (config,) = (tmp_path / "sweep" / "cells").glob("*/config.json")
    assert reading.read_spec(config.parent).env_kwargs == ("episode_length=6",)


def test_python_does_not_look_for_cycles_at_the_end():
    """What is registered first is called last: after the command line's own handler."""
    program = (
        "import atexit, gc; atexit.register(lambda: print(gc.get_freeze_count() > 0));"
        "from mjx_dher.cli import main; main(['--version'])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.splitlines()[-1] == "True"
