"""A run on disk: config.json, metrics.csv, policy.npz, checkpoints, result.json. `reading` and `results` read them."""

import contextlib
import dataclasses
import datetime
import json
import math
import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher import __version__, lookup
from mjx_dher import spec as spec_lib
from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.folder.fingerprint import in_a_path
from mjx_dher.spec import RunSpec
from mjx_dher.system import files
from mjx_dher.system.files import BusyError, FolderError

SCHEMA = 2
CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
POLICY_FILE = "policy.npz"
RESULT_FILE = "result.json"
CHECKPOINTS = "checkpoints"
MANIFEST = "manifest.json"  # of a checkpoint
INFINITE = "inf"  # JSON has no infinite numbers
FINISHED, FAILED = "finished", "failed"  # statuses in result.json

Run = tuple[RunSpec, Path]  # and its folder


@contextlib.contextmanager
def claim_new(out: Path | None, spec: RunSpec) -> Iterator[Path]:
    """Makes and locks the folder of a new run: `out`, or a new one under runs/. Removes it if it stays empty. Raises
    FolderError if `out` is not an empty folder, or another process has locked it.
    """
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


def check_place(out: Path) -> None:
    """Raises FolderError if `out` is a file, or lies in the checkpoints of a run, which deletes them at its end."""
    if os.path.lexists(out) and not out.is_dir():
        raise FolderError(f"out: {out} exists and is not a folder")
    real = Path(os.path.realpath(out))
    for folder in (real, *real.parents):
        if folder.name == CHECKPOINTS and (folder.parent / CONFIG_FILE).exists():
            raise FolderError(f"out: {out} lies in the checkpoints of the run {folder.parent}, which deletes them at its end")


def _fresh(spec: RunSpec) -> Path:
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{in_a_path(spec.env)}-{in_a_path(spec.sampler)}-s{spec.seed}-{now}"
    paths = (Path("runs") / (name + suffix) for suffix in ("", *(f"-{n}" for n in range(2, 1000))))
    return next(path for path in paths if not path.exists())


def engine_name(env: Any) -> str:
    """Name of the engine of an environment: its `engine`, or another attribute that is an engine, or "none".

    Wrappers have the inner environment in their attribute `env`.
    """
    own = getattr(env, "__dict__", {})
    if getattr(env, "engine", None) is None and "env" in own:
        return engine_name(own["env"])
    values = [getattr(env, "engine", None), *own.values()]
    return next((value.name for value in values if hasattr(value, "advance") and hasattr(value, "name")), "none")


def write_config(
    path: Path, spec: RunSpec, engine: str, extra: Mapping[str, Any], earlier: Sequence[str] = (), resumes: bool = False
) -> None:
    """Makes the folder and writes config.json.

    Args:
      engine: engine that runs (`spec.engine` may be auto).
      extra: additional entries, for the reader and for `resume`.
      earlier: digests that the run had before it resumed with other settings, in order.
      resumes: whether to keep a file that differs only in versions.
    """
    hparams = {name: INFINITE if value == math.inf else float(value) for name, value in spec.hparams._asdict().items()}
    description = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    description |= {"config": dataclasses.asdict(spec.config), "hparams": hparams}
    own, flags = fingerprint.sources(spec), fingerprint.jax_flags()
    now = fingerprint.digest(fingerprint.identity(spec, engine, own, flags))
    run = {"physics": engine, "sources": own, "digest": now, "earlier": list(earlier)}
    run |= {"jax_flags": flags} if flags else {}
    content = json.loads(json.dumps({"schema": SCHEMA, **description, **run, **extra}))
    files.make_folder(path)
    if resumes:
        from mjx_dher.runs.folder.reading import read_config
    if not resumes or {**read_config(path), "versions": None} != {**content, "versions": None}:
        files.write_json(path / CONFIG_FILE, {**content, "versions": versions()})
    record_names(spec)


def record_names(spec: RunSpec) -> None:
    """Records the custom components and demonstrations of a run that the user trains (`trust`)."""
    custom = spec_lib.custom_components(spec)
    if not custom and spec.demonstrations is None:
        return
    from mjx_dher import trust
    from mjx_dher.import_paths import module_file

    for field, name in custom.items():
        trust.record(field, name, module_file(name), spec.env_kwargs if field == "env" else ())
    if spec.demonstrations is not None:
        trust.record("demonstrations", spec.demonstrations, spec_lib.find_demonstrations(spec.demonstrations))


def versions() -> dict[str, str]:
    """Versions of this program and its dependencies."""
    from importlib import metadata

    names = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {"mjx_dher": __version__, "python": platform.python_version(), **{n: metadata.version(n) for n in names}}


def checkpoints(path: Path) -> list[Path]:
    """Checkpoints of the run in `path`, newest first."""
    paths = (path / CHECKPOINTS).glob("epoch-*")
    return sorted((path for path in paths if path.name[6:].isdecimal()), key=epoch_of, reverse=True)


def epoch_of(checkpoint: Path) -> int:
    """Ended epochs of a checkpoint, from its name."""
    return int(checkpoint.name[6:])


def save_policy(path: Path, policy: Any, run: Mapping[str, Any]) -> None:
    """Writes policy.npz of the run in `path`, with the run's `identity`."""
    policy.save(path / POLICY_FILE, settings=np.frombuffer(json.dumps(run).encode(), np.uint8))


def success_rates(path: Path, ended: int) -> list[float]:
    """Success rates of the epochs that ended before the run in `path` resumed."""
    if not ended:
        return []
    from mjx_dher.runs.folder import results

    return [row["success_rate"] for row in results.read_metrics(path)]


def check_in_place(path: Path, config: bytes) -> None:
    """Raises FolderError if `path` has no metrics.csv, or not the `config` of the run that trains in it."""
    try:
        same = (path / CONFIG_FILE).read_bytes() == config
        changed = None if same and (path / METRICS_FILE).exists() else "lost a file or got another config.json"
    except (FileNotFoundError, NotADirectoryError):
        changed = "was moved or deleted"
    if changed:
        raise FolderError(f"{path} {changed} during training, so nothing more can be saved")


@contextlib.contextmanager
def kept_unless_opened(folders: Sequence[Path]) -> Iterator[None]:
    """Removes results, because what they describe will change. If an exception ends the block, the folders are as before."""
    names = (RESULT_FILE, CONFIG_FILE, METRICS_FILE)
    before = {path: path.read_bytes() if path.exists() else None for folder in folders for path in map(folder.joinpath, names)}
    try:
        for folder in folders:
            (folder / RESULT_FILE).unlink(missing_ok=True)
            files.flush(folder)
        yield
    except Exception:
        for path, content in before.items():
            path.unlink(missing_ok=True) if content is None else files.write(path, content)
        raise


@dataclasses.dataclass(frozen=True)
class Claims:
    """One process's claims on runs."""

    sweep: bool  # skip runs that have ended or that another process trains, instead of raising
    report: Callable[[str], None]
    groups: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of folders' names: `lane_checkpoints.groups`

    def is_free(self, spec: RunSpec, folder: Path) -> bool:
        """Whether to train a run, as far as known before compilation. Raises FolderError if not, except in a sweep."""
        if not folder.exists():
            return True
        try:
            with named(folder), files.lock(folder):
                return self._is_due(spec, folder)
        except BusyError:
            if not self.sweep:
                raise
            return False

    def claim(self, stack: contextlib.ExitStack, waiting: Sequence[Run], lanes: int) -> tuple[list[Run], list[Run]]:
        """Makes and locks the folders of the first `lanes` runs of a group, of those that have not ended and that no other
        process trains.

        Returns the claimed runs and the waiting ones, with other processes' runs last. Ended runs are in neither. Raises
        FolderError if a folder is not writable or, except in a sweep, if a run has ended or another process trains it.
        """
        claimed: list[Run] = []
        later: list[Run] = []
        busy: list[Run] = []
        for spec, folder in waiting:
            if claimed and (len(claimed) == lanes or self.groups.get(folder.name) != self.groups.get(claimed[0][1].name)):
                later.append((spec, folder))
                continue
            try:
                with named(folder), contextlib.ExitStack() as attempt:
                    attempt.enter_context(files.made(folder))
                    attempt.enter_context(files.lock(folder))
                    if self._is_due(spec, folder):
                        claimed.append((spec, folder))
                        stack.enter_context(attempt.pop_all())
            except BusyError:
                if not self.sweep:
                    raise
                busy.append((spec, folder))
        return claimed, [*later, *busy]

    def largest(self, waiting: Sequence[Run]) -> int:
        """Runs of the largest group, at least 1."""
        known = [self.groups[folder.name] for _, folder in waiting if folder.name in self.groups]
        return max(map(known.count, known), default=1)

    def _is_due(self, spec: RunSpec, folder: Path) -> bool:
        """Whether to train a locked run. Raises FolderError if not, except in a sweep."""
        if not self.sweep and (folder / CONFIG_FILE).exists():
            from mjx_dher.runs.folder import reading

            reading.check_same(folder, spec)
        if not (folder / RESULT_FILE).exists():
            return True
        from mjx_dher.runs.folder import results

        problem = results.trial_problem(folder, spec) if self.sweep else results.result_problem(folder, with_policy=False)
        if self.sweep and problem is not None:
            self.report(f"{problem}; training it again")
        if self.sweep:
            return problem is not None
        if problem is None and results.can_go_on(folder, spec.config.total_steps):
            return True
        raise FolderError(problem or f"{folder} has ended; there is nothing to resume")


@contextlib.contextmanager
def named(folder: Path, place: object = None) -> Iterator[None]:
    """Converts an OSError to a FolderError that names `place`, by default the folder, and the folder's last checkpoint."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise FolderError(f"{place or folder} cannot be written to ({reason}); {last_checkpoint(folder)}") from error


def last_checkpoint(folder: Path) -> str:
    """Part of an error message about the run's newest checkpoint."""
    paths = checkpoints(folder)
    return f"`{lookup.command_name()} resume {folder}` resumes from {paths[0]}" if paths else "there is no checkpoint"
