"""Files do not decide which code runs, and their names and links lead nowhere outside of their folder."""

import dataclasses
import importlib.util
import io
import json
import os
import pickle
import re
import sys

import numpy as np
import pytest
from configs import TINY
from conftest import refuses
from rich.table import Table

import mjx_dher
from mjx_dher import RunSpec, cli, envs, import_paths, trust
from mjx_dher.cli import PlainConsole, printable, train
from mjx_dher.components import COMPONENTS
from mjx_dher.policy import Policy
from mjx_dher.runs.folder import reading, run_folder
from mjx_dher.spec import to_arguments, to_texts, validate
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

OWN = RunSpec(env="point_mass:PointMass", config=TINY)
EVIL = """
from pathlib import Path
Path(CANARY).touch()
from os import system
from subprocess import run
class Env:
    def __init__(self, **kwargs):
        Path(CANARY).touch()
def make(*args, **kwargs):
    Path(CANARY).touch()
"""


def policy(observation, goal, action):
    """A policy of these sizes."""
    ones = [np.ones(n, np.float32) for n in (observation, goal)]
    layers = ((np.full((observation + goal, action), 0.1, np.float32), np.zeros(action, np.float32)),)
    return Policy(layers, ones[0], ones[0], ones[1], ones[1], 5.0, 200.0)


def write(folder, spec, physics="none"):
    """A run folder with a policy, as training writes it."""
    (folder / "policy.npz").unlink(missing_ok=True)
    run_folder.write_config(folder, spec, physics, {"lanes": 1})
    policy(*((10, 3, 4) if spec.env == "reach" else (2, 2, 2))).save(folder / "policy.npz", settings=settings_of(folder))
    return folder


def settings_of(folder):
    """The array of a policy that says which run it is of."""
    identity = reading.identity_of(*reading.read_run(folder))
    return np.frombuffer(json.dumps(identity).encode(), np.uint8)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """The current folder, with a module that leaves a canary when it is imported; the user's state is in it, too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    package = tmp_path / "evil_parent"
    package.mkdir()
    for file in (tmp_path / "evil.py", package / "__init__.py", package / "child.py"):
        file.write_text(EVIL.replace("CANARY", repr(str(tmp_path / "canary"))))
    yield tmp_path
    for name in ("evil", "evil_parent", "evil_parent.child"):
        sys.modules.pop(name, None)


@pytest.fixture
def received(here, monkeypatch):
    """Makes a run folder that another user has written."""

    def received(spec, physics="none"):
        with monkeypatch.context() as other:
            other.setenv("XDG_STATE_HOME", str(here / "theirs"))
            return write(here / "received", spec, physics)

    return received


COMMANDS = {
    "train": ("--config", "received", "--dry-run"),
    "resume": ("resume", "received"),
    "eval": ("eval", "received", "--episodes", "2"),
    "view": ("view", "received", "--port", "0", "--no-open"),
    "render": ("render", "received", "--out", "x.png"),
    "transfer": ("transfer", "received"),
    "export": ("export", "received", "--format", "onnx"),
    "plot": ("plot", "received"),
    "report": ("report", "received", "--video"),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("env", ["evil:Env", "evil_parent.child:Env", "os:system", "evil:system"])
def test_no_command_runs_an_environment_that_a_received_folder_names(received, here, command, env):
    arguments = (f"command=touch {here / 'canary'}",)
    received(RunSpec(env=env, env_kwargs=arguments, config=TINY))
    assert cli.main(COMMANDS[command]) == (0 if command == "export" else 2)
    assert not (here / "canary").exists()


PARTS = [field for field in COMPONENTS if field != "env"]


@pytest.mark.parametrize("field", PARTS)
def test_no_command_runs_a_component_that_a_received_folder_names(received, here, field):
    names = {field: "evil:make"} | ({"sampler": "weighted"} if field in ("metric", "weight_kernel") else {})
    received(RunSpec(env="reach", config=TINY, **names), "native")
    for command in ("train", "resume"):
        cli.main(COMMANDS[command])
        assert not (here / "canary").exists(), command
    state = {"state0000": np.zeros(3), "settings": settings_of(here / "received")}  # of a custom learner
    np.savez(here / "received" / "policy.npz", env_spec=np.array("{}"), sizes=np.array([10, 3, 4]), **state)
    with pytest.raises(FolderError):
        mjx_dher.load_policy("received")
    assert not (here / "canary").exists()


def test_a_custom_component_of_a_received_folder_is_named_with_the_way_out(received, capsys):
    received(OWN)
    assert cli.main(COMMANDS["eval"]) == 2
    err = capsys.readouterr().err
    for part in ("env", "'point_mass:PointMass'", "received/config.json", "point_mass.py", "--trust"):
        assert part in err
    assert cli.main([*COMMANDS["eval"], "--trust"]) == 0
    assert cli.main(COMMANDS["eval"]) == 2  # it holds for one command


def test_what_the_user_has_trained_with_needs_no_flag_wherever_the_folder_is(here, received):
    write(here / "own", OWN)
    assert cli.main(["eval", "own", "--episodes", "2"]) == 0
    (here / "own").rename(here / "received")
    assert cli.main(COMMANDS["eval"]) == 0


@pytest.mark.parametrize("known", [True, False])
def test_arguments_that_the_user_types_to_a_trusted_environment_are_recorded(here, known):
    """As `train --config RUN --env-kwargs episode_length=7` does. The new run is the user's own."""
    folder = here / "first"
    run_folder.write_config(folder, OWN, "none", {"lanes": 1})
    if not known:
        for record in (here / "state").rglob("trusted/*"):
            record.unlink()
    other = dataclasses.replace(reading.read_run(folder)[1], env_kwargs=("episode_length=7",))
    run_folder.write_config(here / "second", other, "none", {"lanes": 1})
    assert other.env.arguments == ()
    found = reading.read_run(here / "second")[1]
    if known:
        assert import_paths.load("env", found.env)
    else:
        with refuses("env", "point_mass:PointMass"):
            import_paths.load("env", found.env)


def test_the_same_name_with_other_arguments_or_of_another_file_is_not_trusted(here, received, monkeypatch):
    write(here / "own", OWN)
    received(dataclasses.replace(OWN, env_kwargs=("episode_length=5",)))
    assert cli.main(COMMANDS["eval"]) == 2
    received(OWN)
    assert cli.main(COMMANDS["eval"]) == 0
    (here / "point_mass.py").write_text("raise SystemExit('another module')")
    monkeypatch.syspath_prepend(str(here))
    monkeypatch.delitem(sys.modules, "point_mass")
    spec = reading.read_spec(here / "received")
    with refuses("env", "point_mass:PointMass", here / "point_mass.py"):
        import_paths.load("env", spec.env)


def test_the_current_folder_is_on_the_path_only_for_a_component_from_there(received, here, monkeypatch):
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    received(RunSpec(env="evil:Env", config=TINY))
    cli.main(COMMANDS["eval"])
    cli.main(["eval", "reach", "--episodes", "0"])
    assert importlib.util.find_spec("evil") is None  # nor do JAX's plugins, or an extra that is not installed, come from here
    (here / "mine.py").write_text("from point_mass import PointMass")
    assert cli.main([*COMMANDS["train"], "--env", "mine:PointMass"]) == 0
    assert "" in sys.path


def test_a_name_that_the_user_types_is_trusted(received, here):
    received(OWN)
    assert cli.main(COMMANDS["train"]) == 2
    assert cli.main([*COMMANDS["train"], "--env", "point_mass:PointMass"]) == 0
    assert cli.main([*COMMANDS["train"], "--trust"]) == 0


@pytest.mark.parametrize("home", [{}, {"XDG_STATE_HOME": "relative"}, {"XDG_STATE_HOME": "/proc/nowhere"}])
def test_without_a_folder_for_records_the_flag_is_needed(received, here, monkeypatch, capsys, home):
    for name in ("XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name)
    for name, value in (home or {"HOME": "/proc/nowhere"}).items():
        monkeypatch.setenv(name, value)
    write(here / "received", OWN)
    assert cli.main(COMMANDS["eval"]) == 2
    assert "--trust" in capsys.readouterr().err
    assert cli.main([*COMMANDS["eval"], "--trust"]) == 0


def test_records_that_others_can_write_do_not_count(here, received):
    write(here / "own", OWN)
    (here / "state" / "mjx-dher" / "trusted").chmod(0o777)
    assert cli.main(["eval", "own", "--episodes", "2"]) == 2


def test_demonstrations_that_a_file_names_are_not_read(here, received):
    (here / "secret.npz").write_bytes(b"")
    spec = dataclasses.replace(OWN, demonstrations=str(here / "secret.npz"))
    received(spec)
    validate(spec)
    with refuses("demonstrations", here / "secret.npz", "--trust"):
        validate(reading.read_spec(here / "received"))
    validate(reading.read_spec(here / "received", trusted=True))


@pytest.mark.parametrize(
    "value",
    ["os:system", "subprocess:Popen", "builtins:exec", "numpy.random:seed", "mujoco:MjModel", "jax.numpy:dot", "posix:system"],
)
def test_modules_without_components_are_no_source_of_one(value):
    for field in COMPONENTS:
        with refuses(field, value):
            validate(RunSpec(**{field: value}))
        with refuses(field, value):
            import_paths.load(field, value)


def test_an_argument_can_have_any_name(here):
    with refuses("env", "reach", "name"):
        envs.make("reach", **{"name": 1})


@pytest.mark.parametrize("value", ["evil:system", "evil:run", "evil:Env", "evil:Path", "evil:CANARY"])
def test_an_environment_is_looked_at_before_it_is_called(here, value, monkeypatch):
    monkeypatch.syspath_prepend(str(here))
    with refuses("env", value):
        envs.make(value, command="true")


def test_marks_survive_copies(here):
    name = trust.FromFile.of("evil:Env", here, ("a=1",))
    spec = dataclasses.replace(RunSpec(), env=name, seed=3)
    for copy in (pickle.loads(pickle.dumps(spec)), dataclasses.replace(spec, seed=4), spec.program):
        with refuses("env", "evil:Env", "a=1"):
            trust.check("env", copy.env, None)
    assert json.dumps(name) == '"evil:Env"'


# Texts and sizes


def test_control_characters_of_a_file_are_printed_as_escapes(here, capsys):
    write(here / "run", OWN, "\x1b[31mnative\x9b2J\u202e")
    content = json.loads((here / "run" / "config.json").read_text())
    content["versions"]["mjx_dher"] = "9\x1b]0;title\x07"
    (here / "run" / "config.json").write_text(json.dumps(content))
    cli.main(["--config", "run", "--dry-run"])
    content["env"] = "\x1b[2Jreach\r"
    (here / "run" / "config.json").write_text(json.dumps(content))
    cli.main(["eval", "run"])
    out, err = capsys.readouterr()
    assert "\\x1b]0;title\\x07" in out
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err)
    table, console = Table("a\x1b[2J"), PlainConsole(file=io.StringIO(), force_terminal=True, color_system=None)
    table.add_row("b\x1b[2J")
    console.print(table)
    assert "\x1b" not in console.file.getvalue()


def test_names_that_the_locale_cannot_decode_are_printed():
    assert printable("\udcc3\udca9/\udcff") == "é/\\xff"


def test_half_a_character_is_neither_read_nor_written(here):
    write(here / "run", OWN)
    content = json.loads((here / "run" / "config.json").read_text())
    with pytest.raises(UnicodeEncodeError):
        files.write_json(here / "run" / "config.json", {**content, "physics": "\ud800"})
    (here / "run" / "config.json").write_text(json.dumps({**content, "physics": "\ud800"}))
    for command in ("plot", "report", "eval"):
        assert cli.main([command, "run"]) == 2


def test_a_pipe_in_place_of_metrics_does_not_block(here):
    run = write(here / "run", OWN)
    os.mkfifo(run / "metrics.csv")
    for command in (["plot", "run"], ["report", "run"], ["eval", "run"]):
        assert cli.main(command) == (0 if command[0] == "eval" else 2)


def test_a_huge_file_is_not_read(here, capsys):
    for file in (here / "config.json", here / "run" / "config.json"):
        file.parent.mkdir(exist_ok=True)
        with file.open("wb") as stream:
            stream.truncate(1 << 40)
        assert cli.main(["--config", str(file), "--dry-run"]) == 2
        assert "larger than 8 MB" in capsys.readouterr().err


# Settings from a file


def test_a_file_that_lacks_a_setting_is_rejected_or_names_it(here, capsys):
    write(here / "run", dataclasses.replace(OWN, config=dataclasses.replace(TINY, num_critics=3)))
    content = json.loads((here / "run" / "config.json").read_text())
    del content["config"]["num_critics"]
    (here / "run" / "config.json").write_text(json.dumps(content))
    assert cli.main(["--config", "run", "--dry-run"]) == 0
    assert "edited since; it lacks num_critics" in capsys.readouterr().out
    (here / "run" / "config.json").write_text(json.dumps({**content, "hparams": {**content["hparams"], "gama": 0.9}}))
    assert cli.main(["--config", "run", "--dry-run"]) == 2
    assert "hparams has no setting 'gama' (did you mean 'gamma'?)" in capsys.readouterr().err
    del content["config"]["batch_size"]
    (here / "run" / "config.json").write_text(json.dumps(content))
    assert cli.main(["--config", "run", "--dry-run"]) == 2
    assert "batch_size" in capsys.readouterr().err


def test_arguments_of_an_environment_are_merged_with_those_of_the_file(here):
    write(here / "run", RunSpec(env="reach", env_kwargs=("episode_length=9", "reward_type=dense"), config=TINY), "native")
    args = train.parse_train_args(["--config", "run", "--env-kwargs", "episode_length=7"])
    assert args.spec.env_kwargs == ("episode_length=7", "reward_type=dense")
    args = train.parse_train_args(["--config", "run", "--env", "push", "--env-kwargs", "episode_length=7"])
    assert args.spec.env_kwargs == ("episode_length=7",)


@pytest.mark.parametrize("text", ["007", "true", "1e3", "", '"', '"a"', "nan", "a=b c", "\u00e9"])
def test_a_text_that_looks_like_a_number_can_be_given(text):
    (written,) = to_texts({"tag": text})
    assert to_arguments([written]) == {"tag": text}
    assert RunSpec(env_kwargs=(written,)).env_kwargs == (written,)
