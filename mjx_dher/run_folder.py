"""What is on disk: a run (config.json, metrics.csv, policy.npz, checkpoints, result.json), and where the cache is."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import os
import platform
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from mjx_dher import __version__
from mjx_dher.config import Config, HParams

try:
    import fcntl
except ImportError:  # not on Windows, where two programs on one run are not told apart
    fcntl = None  # type: ignore[assignment]

SCHEMA = 1
CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
POLICY_FILE = "policy.npz"
RESULT_FILE = "result.json"
CHECKPOINTS = "checkpoints"


def user_cache() -> Path:
    """The folder for what can be made again, in the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"


class RunFolderError(ValueError):
    """A folder that is no run of this program, is damaged, or must not be written to."""


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
      RunFolderError: `out` is there already and not an empty folder.
    """
    if out is None:
        now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{in_a_path(config.env)}-{in_a_path(config.sampler)}-s{seed}-{now}"
        paths = (Path("runs") / (name + suffix) for suffix in ("", *(f"-{n}" for n in range(2, 1000))))
        return next(path for path in paths if not path.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunFolderError(f"out: {out} is there already and is never overwritten; name a new or empty folder")
    return out


def in_a_path(name: str) -> str:
    """The name of an environment or a sampler as a part of a file's: "Tasks:Mine" is tasks-mine."""
    return re.sub(r"[^a-z0-9_]+", "-", name.lower())


def check_file(out: Path, endings: Iterable[str], overwrite: bool) -> None:
    """Refuses a file that cannot or must not be written, before anything slow has happened.

    Raises:
      RunFolderError: it ends in none of `endings`, is a folder, is there already (without `overwrite`), or its folder is not.
    """
    endings = tuple(endings)
    if out.suffix.lower() not in endings:
        raise RunFolderError(f"out must end in {', '.join(endings)}; got {str(out)!r}")
    if out.is_dir():
        raise RunFolderError(f"out: {out} is a folder")
    if out.exists() and not overwrite:
        raise RunFolderError(f"out: {out} is there already; name another file or give --overwrite")
    if not out.parent.is_dir():
        raise RunFolderError(f"out: there is no folder {out.parent}")


def engine_name(env: Any) -> str:
    """Of the physics that an environment runs on; none for one without an engine."""
    return getattr(getattr(env, "engine", None), "name", "none")


def create(path: Path, run: RunConfig, extra: dict[str, Any]) -> None:
    """Makes the folder and writes config.json; versions, and `extra`, are added to it for the reader."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"out: cannot create {path} ({error.strerror})") from error
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


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes `content` as JSON, whole or not at all."""
    with whole(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


@contextlib.contextmanager
def lock(path: Path, name: str = CONFIG_FILE, wait: bool = False) -> Iterator[None]:
    """Keeps other programs off the folder `path`. The system lets go of the lock when this one ends, however it ends.

    Args:
      path: the folder, of a run as a rule.
      name: a file in it that no one puts another in the place of; it is made where it is not there.
      wait: until the other one is done.

    Raises:
      RunFolderError: another program is at work there.
    """
    with (path / name).open("a") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except OSError:
                raise RunFolderError(f"{path} is being trained by another program") from None
        yield


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A path to write to that takes the place of `path` when it is complete; until then, what was there stays.

    After an error it stays for good, and nothing is left of the new.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


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
      RunFolderError: there is none.
    """
    if found := checkpoints(path):
        return found
    raise RunFolderError(
        f"{path} has no checkpoint to go on from: it was stopped before it had saved any (see --checkpoint-every)"
    )


def read_versioned(file: Path, schema: int) -> dict[str, Any]:
    """An object of JSON that names its schema.

    Raises:
      FileNotFoundError: there is no such file.
      RunFolderError: it cannot be read, or is of another schema.
    """
    try:
        content = json.loads(file.read_text())
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{file} cannot be read ({error})") from error
    found = content.get("schema") if isinstance(content, dict) else None
    if found != schema:
        raise RunFolderError(f"{file} is not of this program's schema {schema} (found {found!r})")
    return content


def read_content(path: Path) -> dict[str, Any]:
    """All of the config.json of the run in `path`.

    Raises:
      RunFolderError: no run folder, or one of another schema; the message says which.
    """
    if not path.is_dir():
        raise RunFolderError(f"{path} is not a run folder: no such folder")
    try:
        return read_versioned(path / CONFIG_FILE, SCHEMA)
    except FileNotFoundError:
        raise RunFolderError(f"{path} is not a run folder: it has no {CONFIG_FILE}") from None


def read_config(path: Path) -> RunConfig:
    """What the run in `path` was started with.

    Raises:
      RunFolderError: no run folder, or one of another schema; the message says which.
    """
    return to_config(path, read_content(path))


def to_config(path: Path, content: dict[str, Any]) -> RunConfig:
    """What `read_content` gave of the run in `path`, as `read_config` gives it.

    Raises:
      RunFolderError: something is missing in it, or of another kind.
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
        raise RunFolderError(f"{path / CONFIG_FILE} does not describe a run ({error})") from error
