"""A run on disk: config.json, metrics.csv, policy.npz, checkpoints, result.json."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import math
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher import __version__, lookup, trust
from mjx_dher import spec as spec_lib
from mjx_dher.config import Config, HParams
from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.folder.fingerprint import in_a_path
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

SCHEMA = 2
CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
POLICY_FILE = "policy.npz"
RESULT_FILE = "result.json"
CHECKPOINTS = "checkpoints"
MANIFEST = "manifest.json"  # of a checkpoint
INFINITE = "inf"  # in place of an infinite number, which JSON lacks

# Statuses in result.json.
FINISHED = "finished"
FAILED = "failed"


@contextlib.contextmanager
def claim_new(out: Path | None, spec: RunSpec) -> Iterator[Path]:
    """Makes and locks the folder for a new run: `out`, or a fresh one under runs/. Removes it if it stays empty.

    Raises:
      FolderError: `out` is not an empty folder, or another process has locked it.
      OSError: the folder cannot be made or written to.
    """
    if out is not None and (out.is_symlink() or out.exists()) and not out.is_dir():
        raise FolderError(f"out: {out} is there already and is no folder")
    while True:
        folder = _fresh(spec) if out is None else out
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(files.new_folder(folder))
            except FolderError:
                if out is not None:
                    raise
                continue  # another process has just taken it
            yield folder
            return


def _fresh(spec: RunSpec) -> Path:
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{in_a_path(spec.env)}-{in_a_path(spec.sampler)}-s{spec.seed}-{now}"
    paths = (Path("runs") / (name + suffix) for suffix in ("", *(f"-{n}" for n in range(2, 1000))))
    return next(path for path in paths if not path.exists())


def engine_name(env: Any) -> str:
    """Name of the physics of an environment: of its `engine`, or of another attribute that is one; "none" without any."""
    values = [getattr(env, "engine", None), *getattr(env, "__dict__", {}).values()]
    return next((value.name for value in values if hasattr(value, "advance") and hasattr(value, "name")), "none")


def write_config(path: Path, spec: RunSpec, engine: str, extra: dict[str, Any]) -> None:
    """Makes the folder and writes config.json.

    Args:
      path: of the folder.
      spec: the run's description.
      engine: the physics that runs (`spec.engine` may be auto).
      extra: further entries, for the reader and for `resume`.
    """
    hparams = {name: INFINITE if value == math.inf else float(value) for name, value in spec.hparams._asdict().items()}
    description = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    description |= {"config": dataclasses.asdict(spec.config), "hparams": hparams}
    own = fingerprint.sources(spec)
    run = {"physics": engine, "sources": own, "digest": fingerprint.digest(fingerprint.identity(spec, engine, own))}
    files.make_folder(path)
    files.write_json(path / CONFIG_FILE, {"schema": SCHEMA, **description, **run, **extra, "versions": _versions()})
    record_names(spec)


def record_names(spec: RunSpec) -> None:
    """Records the custom components and demonstrations of a run that the user trains (`trust`)."""
    for field, name in spec_lib.custom_components(spec).items():
        trust.record(field, name, lookup.module_file(name), spec.env_kwargs if field == "env" else ())
    if spec.demonstrations is not None:
        trust.record("demonstrations", spec.demonstrations, spec_lib.find_demonstrations(spec.demonstrations))


def _versions() -> dict[str, str]:
    from importlib import metadata

    names = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {"mjx_dher": __version__, "python": platform.python_version(), **{n: metadata.version(n) for n in names}}


def checkpoints(path: Path) -> list[Path]:
    """Checkpoints of the run in `path`, the newest first."""
    paths = (path / CHECKPOINTS).glob("epoch-*")
    return sorted((path for path in paths if path.name[6:].isdecimal()), key=epoch_of, reverse=True)


def epoch_of(checkpoint: Path) -> int:
    """Epochs that had ended when a checkpoint was made, from its name."""
    return int(checkpoint.name[6:])


def checkpoints_to_resume(path: Path) -> list[Path]:
    """Checkpoints of the run in `path`, the newest first. Raises FolderError if there is none."""
    if paths := checkpoints(path):
        return paths
    raise FolderError(
        f"{path} has no checkpoint to go on from: it was stopped before it had saved any (see --checkpoint-every)"
    )


def read_versioned(file: Path, schema: int) -> dict[str, Any]:
    """Reads a JSON object whose key "schema" is `schema`.

    Raises:
      FileNotFoundError: there is no such file.
      FolderError: it cannot be read, or is of another schema.
    """
    content = files.read_json(file)
    written = content.get("schema") if isinstance(content, dict) else None
    if written != schema:
        raise FolderError(f"{file} is not of this program's schema {schema} (found {written!r})")
    return content


def read_config(path: Path) -> dict[str, Any]:
    """Reads config.json of the run in `path`.

    Raises:
      FolderError: no run folder, or one of another schema.
    """
    if not path.is_dir():
        raise FolderError(f"{path} is not a run folder: no such folder")
    try:
        return read_config_file(path / CONFIG_FILE)
    except FileNotFoundError:
        raise FolderError(f"{path} is not a run folder: it has no {CONFIG_FILE}") from None


def read_config_file(file: Path) -> dict[str, Any]:
    """Reads a run's config.json, wherever it lies and whatever its name is.

    Raises:
      FileNotFoundError: there is no such file.
      FolderError: it does not describe a run, or is of another schema.
    """
    try:
        content = read_versioned(file, SCHEMA)
        _check_kinds(content)
        return content
    except (KeyError, AttributeError, TypeError) as error:
        raise FolderError(f"{file} does not describe a run ({error})") from error


def _check_kinds(content: dict[str, Any]) -> None:
    """Raises TypeError if a value in config.json has another type than the readers need."""
    kinds = {"config": dict, "hparams": dict, "physics": str, "env_kwargs": list, "sources": dict, "digest": str}
    values = {name: (content[name], kind) for name, kind in kinds.items()}
    if isinstance(content["config"], dict):
        values["config.hidden_sizes"] = content["config"]["hidden_sizes"], list
    if isinstance(content["sources"], dict):
        values |= {f"sources.{name}": (text, str) for name, text in content["sources"].items()}
    if wrong := [f"{name} must be a {kind.__name__}" for name, (value, kind) in values.items() if not isinstance(value, kind)]:
        raise TypeError("; ".join(wrong))


def read_spec(path: Path, trusted: bool = False) -> RunSpec:
    """Reads the description of the run in `path`; raises FolderError as `read_run` does."""
    return read_run(path, trusted)[1]


def read_run(path: Path, trusted: bool = False) -> tuple[dict[str, Any], RunSpec]:
    """Reads config.json of the run in `path`: its content, and the run's description.

    The code that it names is imported only if `trusted`, or if the user has trained with it (`trust`).

    Raises:
      FolderError: no run folder, one of another schema, or a config.json that was edited.
    """
    content = read_config(path)
    spec = to_spec(path, content, trusted)
    if edits := edited(path, content, spec):
        raise FolderError(f"{path / CONFIG_FILE} is not as the run wrote it: {'; '.join(edits.values())}")
    return content, spec


def identity_of(content: dict[str, Any], spec: RunSpec) -> dict[str, Any]:
    """The `identity` of the run that config.json describes."""
    return fingerprint.identity(spec, content["physics"], content["sources"])


def edited(path: Path, content: dict[str, Any], spec: RunSpec) -> dict[str, str]:
    """Settings in config.json that differ from those that the run was trained with: a sentence for each, by name.

    The settings of training are in the newest checkpoint, or else in the policy.
    """
    now, written = identity_of(content, spec), written_identity(path)
    changed = {} if written is None else fingerprint.differences(written, now)
    if content["digest"] == fingerprint.digest(now):  # by `resume`, if at all
        return {name: text for name, text in changed.items() if name not in fingerprint.MAY_CHANGE}
    return changed or {"digest": f"its digest is {content['digest']}, and that of its settings is {fingerprint.digest(now)}"}


def changed_code(content: dict[str, Any], spec: RunSpec) -> list[str]:
    """Sentences about custom source files that have changed since the run was trained."""
    before = identity_of(content, spec)
    return list(
        fingerprint.differences(before, {**before, "sources": {**content["sources"], **fingerprint.sources(spec)}}).values()
    )


def written_identity(path: Path) -> dict[str, Any] | None:
    """The `identity` in the run's newest checkpoint, or else in its policy; None without either."""
    for checkpoint in checkpoints(path):
        try:
            (content,) = read_versioned(checkpoint / MANIFEST, SCHEMA)["runs"]
            return dict(content)
        except (OSError, ValueError, KeyError, TypeError):  # damaged, or of several runs
            continue
    try:
        if not (path / POLICY_FILE).is_file():
            return None
        with np.load(path / POLICY_FILE, allow_pickle=False) as arrays:
            return dict(json.loads(arrays["settings"].tobytes()))
    except Exception:  # NumPy, zipfile and zlib raise many errors for a damaged file; `load_policy` reports them
        return None


def to_spec(path: Path, content: dict[str, Any], trusted: bool = False) -> RunSpec:
    """Makes the description of a run from the content of its config.json, at `path` or in the folder `path`.

    Names of code and of demonstrations are marked as coming from a file, unless `trusted`.

    Raises:
      FolderError: an entry is missing or invalid.
    """
    file = path / CONFIG_FILE if path.is_dir() else path
    try:
        fields = {f.name for f in dataclasses.fields(RunSpec)} - {"config", "hparams"}
        config = {**content["config"], "hidden_sizes": tuple(content["config"]["hidden_sizes"])}
        if missing := fingerprint.ALWAYS - {*content, *config, *content["hparams"]}:  # a default is not what was meant
            raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        spec = RunSpec(
            config=Config(**config),
            hparams=HParams(**{name: math.inf if x == INFINITE else x for name, x in content["hparams"].items()}),
            **{name: content[name] for name in fields - {"env_kwargs"} if name in content},
            env_kwargs=tuple(content["env_kwargs"]),
        )
        spec_lib.validate_values(spec)
    except (KeyError, TypeError, ValueError) as error:
        raise FolderError(f"{file} does not describe a run ({error})") from error
    if trusted:
        return spec
    names = {**spec_lib.custom_components(spec), "demonstrations": spec.demonstrations}
    marked: dict[str, Any] = {
        field: trust.FromFile.of(name, file, spec.env_kwargs if field == "env" else ()) for field, name in names.items() if name
    }
    return dataclasses.replace(spec, **marked)
