"""Settings of a run from a file, and the amount of work and memory that they need."""

import dataclasses
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjx_dher import config as config_lib
from mjx_dher.config import Config
from mjx_dher.runs.folder import fingerprint, reading, run_folder
from mjx_dher.runs.folder.fingerprint import text
from mjx_dher.spec import Options, RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError


def load(path: Path) -> tuple[RunSpec, Options, list[str]]:
    """Reads settings and options from a run folder or any config.json, and lines about their origin. Raises FolderError if it
    does not describe a run, or has another schema.
    """
    file = path / run_folder.CONFIG_FILE if path.is_dir() else path
    try:
        content = reading.read_config_file(file)
    except FileNotFoundError:
        raise FolderError(f"config: there is no file {file}") from None
    run = reading.to_spec(file, content)
    options = options_of(content)
    options.check()
    return run, options, [_origin(file, content, run), *reading.changed_code(content, run)]


def options_of(content: dict[str, Any]) -> Options:
    """Options in a config.json. Raises ValueError for an invalid one."""
    options = Options(**{field.name: content[field.name] for field in dataclasses.fields(Options) if field.name in content})
    options.check(installed=False)
    return dataclasses.replace(options, log=tuple(options.log))


def _origin(file: Path, content: dict[str, Any], run: RunSpec) -> str:
    """Origin of settings: the run, the version that wrote them, and whether they were edited since."""
    version = content.get("versions", {}).get("mjx_dher", "unknown")
    now = fingerprint.digest(reading.identity_of(content, run))
    edited = "; edited since" if content["digest"] != now else ""
    devices = content.get("devices", 1) // content.get("lanes", 1)  # not a setting, but batches depend on it
    shared = f", on {devices} devices" if devices > 1 else ""
    lacking = fingerprint.settings(run).keys() - {*content, *content["config"], *content["hparams"]} if edited else ()
    if lacking:
        edited += f"; it lacks {', '.join(sorted(lacking))}, for which defaults are used"
    return (
        f"settings of {file}: {run.env}, sampler {run.sampler}, seed {run.seed}; written by mjx-dher {version}, physics"
        f" {content['physics']}{shared}{edited}"
    )


def changes(before: RunSpec, now: RunSpec) -> str:
    """Settings that differ from a file: "gamma 0.9 (0.98 in the file)"."""
    old, new = ({**fingerprint.settings(spec), "seed": spec.seed} for spec in (before, now))
    told = [f"{name} {text(new[name])} ({text(old[name])} in the file)" for name in new if new[name] != old[name]]
    return "changes: " + (", ".join(told) or "none")


def check_out(out: Path | None) -> None:
    """Raises FolderError if there is something at `out`, or no run can be written there. Leaves no trace."""
    if out is None:
        return
    run_folder.check_place(out)
    if out.exists() and files.is_used(out):
        raise FolderError(f"out: {out} exists and is never overwritten; pass a new or empty folder")
    check_writable(out)


def check_writable(out: Path) -> None:
    """Checks that a folder is writable or can be made, without leaving a trace. Raises FolderError if it cannot."""
    parent = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    try:
        os.rmdir(tempfile.mkdtemp(dir=parent))  # permissions do not suffice for root, or if the disk is full
    except OSError as error:
        raise FolderError(f"out: {parent} cannot be written to ({error.strerror})") from None


def amount(config: Config, episode_length: int, runs: int = 1) -> str:
    """Amount of play and learning of `runs` runs, as a line."""
    epochs = config_lib.num_epochs(config, episode_length)
    steps = epochs * config_lib.steps_per_epoch(config, episode_length)
    updates = config_lib.num_updates(config, episode_length)
    each = " each" if runs > 1 else ""
    whole = f"; {steps * runs:,} steps and {updates * runs:,} updates in all" if runs > 1 else ""
    return (
        f"{epochs} epochs of {config.cycles_per_epoch} cycles{each}: {steps:,} environment steps,"
        f" {updates:,} updates of {config.batch_size:,} transitions{whole}"
    )


def memory_lines(env: Any, specs: Sequence[RunSpec], lanes: int | None, devices: int | str, sweep: bool = False) -> list[str]:
    """Lines about the memory of runs of one program, without compiling it. Raises ValueError if they cannot be trained."""
    import jax

    from mjx_dher.runs import program
    from mjx_dher.system import machine

    train = program.check_runs(env, specs, lanes, devices, sweep)
    leaves = jax.tree.leaves(jax.eval_shape(train.learner.init, jax.random.key(0)))
    learner = sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)
    available = machine.available_bytes()
    free = "unknown" if available is None else machine.format_bytes(available)
    each = (" a run" if len(specs) > 1 else "") + (" on each device" if train.axis_name else "")
    return [
        f"memory{each}: replay ring {machine.format_bytes(train.replay_bytes)}, learner {machine.format_bytes(learner)};"
        f" the compiled program needs more; {free} is free",
        f"physics {run_folder.engine_name(env)}, learner on {jax.devices()[0].device_kind}",
    ]
