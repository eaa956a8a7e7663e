"""Reads what a run left. Needs NumPy alone, unless the run had a learner or networks of one's own."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.policy import Policy, bundled, from_arrays
from mjx_dher.runs.folder.run_folder import POLICY_FILE, read_spec
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import FolderError


def load_policy(run_dir: str | Path) -> Policy:
    """Returns a policy of the package by its name, or that of a run folder. Imports NumPy only: no JAX, no MuJoCo.

    The policy of a learner or networks of one's own is a `learners.stored.StoredPolicy`, which is called alike and needs JAX,
    and the run folder.

    Args:
      run_dir: a run folder, a policy.npz, wherever it lies and whatever its name is, or a name among `bundled.names()`, such
        as "push". A run folder or file in the current folder by that name comes first.

    Raises:
      FolderError: there is no run folder of this program, or its policy is missing, damaged, or of a learner or networks of
        one's own that cannot be imported or do not fit it.
    """
    run_dir = bundled.find(run_dir)
    spec, path = (None, run_dir) if run_dir.is_file() else (read_spec(run_dir), run_dir / POLICY_FILE)
    if not path.is_file():
        raise FolderError(f"{path} is missing: the run was stopped before its first epoch ended")
    arrays = _read(path)
    if "sizes" not in arrays:
        try:
            return from_arrays(arrays)
        except ValueError as error:
            raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error
    if spec is None:
        raise FolderError(f"{path} is of a learner or networks of the user's own: name its run folder, which says which")
    from mjx_dher.policy.learner_policy import from_arrays as from_state

    try:
        return from_state(arrays, spec)  # type: ignore[return-value]
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"{path} cannot be played: {error}") from error


def _read(path: Path) -> dict[str, Any]:
    """Returns the arrays in a policy.npz; nothing is unpickled."""
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("it is one array")
        with file:
            arrays = {name: file[name] for name in file.files}  # all of them, so that damage anywhere is seen
        arrays.pop("settings", None)
        return arrays
    except (OSError, ValueError, KeyError, TypeError, EOFError, MemoryError, NotImplementedError, zlib.error) as error:
        raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error
    except (zipfile.BadZipFile, OverflowError, RuntimeError) as error:  # RuntimeError: it asks for a password
        raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error


def check_fits(policy: Policy, env: Any) -> None:
    """Refuses a policy for an environment whose observations, goals or actions are of other sizes.

    Raises:
      ValueError: names both sizes.
    """
    from mjx_dher.trainer import env_sizes

    theirs, own = tuple(env_sizes(env)), tuple(policy.sizes)
    if theirs != own:
        raise ValueError(
            f"the policy takes observations of {own[0]} and goals of {own[1]} numbers and gives actions of {own[2]}; the"
            f" environment has {theirs[0]}, {theirs[1]} and {theirs[2]}"
        )


def check_plain(policy: Policy, spec: RunSpec, use: str) -> None:
    """Refuses a policy that needs its learner to be played, for a `use` that has NumPy alone.

    Raises:
      ValueError: names the learner and the networks.
    """
    if not isinstance(policy, Policy):
        raise ValueError(
            f"{use} takes a policy of NumPy arrays, which learner {spec.learner!r} with networks {spec.networks!r} has not"
        )
