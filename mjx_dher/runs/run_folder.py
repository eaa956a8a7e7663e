"""What is on disk: a run (config.json, metrics.csv, policy.npz, checkpoints, result.json)."""

from __future__ import annotations

import dataclasses
import datetime
import json
import platform
import re
from pathlib import Path
from typing import Any

from mjx_dher import __version__
from mjx_dher.config import Config, HParams
from mjx_dher.host.files import FolderError, write_json

SCHEMA = 1
CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
POLICY_FILE = "policy.npz"
RESULT_FILE = "result.json"
CHECKPOINTS = "checkpoints"


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What a run was started with."""

    config: Config
    hparams: HParams
    seed: int
    engine: str  # the one that ran, where config.engine may say auto


def choose(out: Path | None, config: Config, seed: int) -> Path:
    """The folder a new run will be written to: `out`, else a fresh one under runs/. Nothing is created.

    Raises:
      FolderError: `out` is there already and not an empty folder.
    """
    if out is None:
        now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{in_a_path(config.env)}-{in_a_path(config.sampler)}-s{seed}-{now}"
        paths = (Path("runs") / (name + suffix) for suffix in ("", *(f"-{n}" for n in range(2, 1000))))
        return next(path for path in paths if not path.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FolderError(f"out: {out} is there already and is never overwritten; name a new or empty folder")
    return out


def in_a_path(name: str) -> str:
    """The name of an environment or a sampler as a part of a file's: "Tasks:Mine" is tasks-mine."""
    return re.sub(r"[^a-z0-9_]+", "-", name.lower())


def engine_name(env: Any) -> str:
    """Of the physics that an environment runs on; none for one without an engine."""
    return getattr(getattr(env, "engine", None), "name", "none")


def create(path: Path, run: RunConfig, extra: dict[str, Any]) -> None:
    """Makes the folder and writes config.json; versions, and `extra`, are added to it for the reader."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"out: cannot create {path} ({error.strerror})") from error
    content = {
        "schema": SCHEMA,
        "seed": run.seed,
        "engine": run.engine,
        "config": dataclasses.asdict(run.config),
        "hparams": run.hparams._asdict(),
        **extra,
        "versions": _versions(),
    }
    write_json(path / CONFIG_FILE, content)


def _versions() -> dict[str, str]:
    from importlib import metadata

    names = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {"mjx_dher": __version__, "python": platform.python_version(), **{n: metadata.version(n) for n in names}}


def checkpoints(path: Path) -> list[Path]:
    """The checkpoints of the run in `path`, the newest first."""
    return sorted((path / CHECKPOINTS).glob("epoch-*"), reverse=True)


def checkpoints_to_resume(path: Path) -> list[Path]:
    """As `checkpoints`, where there must be one.

    Raises:
      FolderError: there is none.
    """
    if found := checkpoints(path):
        return found
    raise FolderError(
        f"{path} has no checkpoint to go on from: it was stopped before it had saved any (see --checkpoint-every)"
    )


def read_versioned(file: Path, schema: int) -> dict[str, Any]:
    """An object of JSON that names its schema.

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
    found = content.get("schema") if isinstance(content, dict) else None
    if found != schema:
        raise FolderError(f"{file} is not of this program's schema {schema} (found {found!r})")
    return content


def read_content(path: Path) -> dict[str, Any]:
    """All of the config.json of the run in `path`.

    Raises:
      FolderError: no run folder, or one of another schema; the message says which.
    """
    if not path.is_dir():
        raise FolderError(f"{path} is not a run folder: no such folder")
    try:
        return read_versioned(path / CONFIG_FILE, SCHEMA)
    except FileNotFoundError:
        raise FolderError(f"{path} is not a run folder: it has no {CONFIG_FILE}") from None


def read_config(path: Path) -> RunConfig:
    """What the run in `path` was started with.

    Raises:
      FolderError: no run folder, or one of another schema; the message says which.
    """
    return to_config(path, read_content(path))


def to_config(path: Path, content: dict[str, Any]) -> RunConfig:
    """What `read_content` gave of the run in `path`, as `read_config` gives it.

    Raises:
      FolderError: something is missing in it, or of another kind.
    """
    try:
        config = dict(content["config"])
        config["hidden_sizes"] = tuple(config["hidden_sizes"])
        return RunConfig(
            config=Config(**config),
            hparams=HParams(**content["hparams"]),
            seed=int(content["seed"]),
            engine=str(content["engine"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FolderError(f"{path / CONFIG_FILE} does not describe a run ({error})") from error
