"""A run on disk: config.json, metrics.csv, policy.npz, checkpoints, result.json."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import platform
import re
from pathlib import Path
from typing import Any

from mjx_dher import __version__
from mjx_dher.config import Config, HParams
from mjx_dher.host.files import FolderError, write_json
from mjx_dher.spec import RunSpec

SCHEMA = 2
CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
POLICY_FILE = "policy.npz"
RESULT_FILE = "result.json"
CHECKPOINTS = "checkpoints"
LOCK = "lock"

# Statuses in result.json.
FINISHED = "finished"
DIVERGED = "diverged"

RENAMED = {"eventful_share": "priority_fraction"}  # HParams of schema 1, and what they are called now
# Settings of schema 1. Later ones are part of a run's digest only where they differ from their defaults, so that the trials of
# an older sweep keep their names.
_FIRST_SETTINGS = frozenset(
    (
        *("env", "engine", "sampler", "weight_kernel", "metric", "num_envs", "cycles_per_epoch", "updates_per_cycle"),
        *("target_period", "batch_size", "total_steps", "replay_size", "hidden_sizes", "learner_dtype", "learner_kernels"),
        *("eval_episodes", "actor_lr", "critic_lr", "lr_end", "gamma", "polyak", "action_l2", "random_eps", "noise_std"),
        *("her_k", "priority_fraction", "epsilon", "temperature", "obs_clip", "norm_clip", "norm_eps"),
    )
)


def choose(out: Path | None, spec: RunSpec) -> Path:
    """Returns the folder for a new run: `out`, else a fresh one under runs/. Nothing is created.

    Raises:
      FolderError: `out` exists and is not an empty folder.
    """
    if out is None:
        now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{in_a_path(spec.env)}-{in_a_path(spec.sampler)}-s{spec.seed}-{now}"
        paths = (Path("runs") / (name + suffix) for suffix in ("", *(f"-{n}" for n in range(2, 1000))))
        return next(path for path in paths if not path.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FolderError(f"out: {out} is there already and is never overwritten; name a new or empty folder")
    return out


def in_a_path(name: str) -> str:
    """Returns the name of an environment or a sampler as a part of a file's: "Tasks:Mine" is tasks-mine."""
    return re.sub(r"[^a-z0-9_]+", "-", name.lower())


def trial_name(spec: RunSpec) -> str:
    """Returns the name of a trial's folder: readable settings plus a digest of every setting."""
    values = settings(spec)
    defaults = settings(RunSpec())
    kept = {name: value for name, value in values.items() if name in _FIRST_SETTINGS or value != defaults[name]}
    old_names = {new: old for old, new in RENAMED.items()}
    numbers = {old_names.get(name, name): kept.pop(name) for name in HParams._fields if name in kept}
    digest = hashlib.sha256(json.dumps([1, kept, numbers, spec.seed], sort_keys=True).encode()).hexdigest()[:10]
    return f"{in_a_path(spec.env)}-{in_a_path(spec.sampler)}-s{spec.seed}-{digest}"


def settings(spec: RunSpec) -> dict[str, Any]:
    """Returns all settings of a run by name, the seed left out."""
    parts = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    return {
        **{name: value for name, value in parts.items() if name not in ("config", "hparams", "seed")},
        **dataclasses.asdict(spec.config),
        **spec.hparams._asdict(),
    }


def engine_name(env: Any) -> str:
    """Returns the name of the physics that an environment runs on; none for one without an engine."""
    return getattr(getattr(env, "engine", None), "name", "none")


def create(path: Path, spec: RunSpec, engine: str, extra: dict[str, Any]) -> None:
    """Makes the folder and writes config.json.

    Args:
      path: of the folder.
      spec: the run's description.
      engine: the physics that runs, where `spec.engine` may say auto.
      extra: written, too, for the reader and for `resume`.

    Raises:
      FolderError: the folder cannot be made or written to.
    """
    hparams = {name: float(value) for name, value in spec.hparams._asdict().items()}
    description = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    description |= {"config": dataclasses.asdict(spec.config), "hparams": hparams}
    try:
        path.mkdir(parents=True, exist_ok=True)
        write_json(path / CONFIG_FILE, {"schema": SCHEMA, **description, "physics": engine, **extra, "versions": _versions()})
    except OSError as error:
        raise FolderError(f"out: cannot create {path} ({error.strerror})") from error


def _versions() -> dict[str, str]:
    from importlib import metadata

    names = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {"mjx_dher": __version__, "python": platform.python_version(), **{n: metadata.version(n) for n in names}}


def checkpoints(path: Path) -> list[Path]:
    """Returns the checkpoints of the run in `path`, the newest first."""
    return sorted((path / CHECKPOINTS).glob("epoch-*"), reverse=True)


def checkpoints_to_resume(path: Path) -> list[Path]:
    """Returns the checkpoints of the run in `path`, the newest first, of which there must be one.

    Raises:
      FolderError: there is none.
    """
    if paths := checkpoints(path):
        return paths
    raise FolderError(
        f"{path} has no checkpoint to go on from: it was stopped before it had saved any (see --checkpoint-every)"
    )


def read_versioned(file: Path, *schemas: int) -> dict[str, Any]:
    """Returns an object of JSON that names its schema, one of `schemas`.

    Raises:
      FileNotFoundError: there is no such file.
      FolderError: it cannot be read, or is of another schema.
    """
    try:
        content = json.loads(file.read_text())
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise FolderError(f"{file} cannot be read ({error})") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema not in schemas:
        raise FolderError(f"{file} is not of this program's schema {schemas[-1]} (found {schema!r})")
    return content


def read_content(path: Path) -> dict[str, Any]:
    """Returns the config.json of the run in `path`, in today's schema.

    Raises:
      FolderError: no run folder, or one of another schema; the message says which.
    """
    if not path.is_dir():
        raise FolderError(f"{path} is not a run folder: no such folder")
    try:
        content = read_versioned(path / CONFIG_FILE, 1, SCHEMA)
        return _upgraded(content) if content["schema"] == 1 else content
    except FileNotFoundError:
        raise FolderError(f"{path} is not a run folder: it has no {CONFIG_FILE}") from None
    except (KeyError, AttributeError, TypeError) as error:
        raise FolderError(f"{path / CONFIG_FILE} does not describe a run ({error})") from error


def _upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Returns the content of schema 1 in that of schema 2: the parts left `config`, and a number got another name."""
    config = dict(content["config"])
    parts = {name: config.pop(name) for name in ("env", "engine", "sampler", "weight_kernel", "metric")}
    hparams = {RENAMED.get(name, name): value for name, value in content["hparams"].items()}
    return {**content, "schema": SCHEMA, **parts, "physics": content["engine"], "config": config, "hparams": hparams}


def read_spec(path: Path) -> RunSpec:
    """Returns the description of the run in `path`.

    Raises:
      FolderError: no run folder, or one of another schema; the message says which.
    """
    return to_spec(path, read_content(path))


def to_spec(path: Path, content: dict[str, Any]) -> RunSpec:
    """Returns the description that `read_content` gave of the run in `path`.

    Raises:
      FolderError: something is missing in it, or of another kind.
    """
    try:
        fields = {f.name for f in dataclasses.fields(RunSpec)} - {"config", "hparams"}
        config = {**content["config"], "hidden_sizes": tuple(content["config"]["hidden_sizes"])}
        return RunSpec(
            config=Config(**config),
            hparams=HParams(**content["hparams"]),
            **{name: content[name] for name in fields if name in content},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FolderError(f"{path / CONFIG_FILE} does not describe a run ({error})") from error
