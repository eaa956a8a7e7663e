"""Trained policies from run folders. Needs only NumPy, unless the run had a custom learner or custom networks."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.policy import Policy, TrainedPolicy, bundled, from_arrays
from mjx_dher.runs.folder.run_folder import POLICY_FILE, read_spec
from mjx_dher.system.files import FolderError


def load_policy(run_dir: str | Path, trust: bool = False) -> TrainedPolicy:
    """Loads a bundled policy, or that of a run folder. Imports only NumPy: no JAX, no MuJoCo.

    Custom learners and networks are an exception: their policy is a `learner_policy.LearnerPolicy`, which needs JAX and the
    run folder.

    Args:
      run_dir: a run folder, a policy.npz under any name, or the name of a bundled policy, such as "push". A run folder or file
        of that name in the current folder comes first.
      trust: whether to import a custom learner or networks that the folder names and that you have not trained with here.

    Raises:
      FolderError: no run folder, or a policy that is missing, damaged, or of a custom learner that cannot be imported, is not
        trusted or does not fit.
    """
    return _load(run_dir, trust, "")


def load_plain(run_dir: str | Path, use: str) -> Policy:
    """Loads a policy of NumPy arrays, as `use` needs, and imports no custom code. Raises ValueError for another policy."""
    policy = _load(run_dir, False, use)
    assert isinstance(policy, Policy)
    return policy


def _load(run_dir: str | Path, trust: bool, use: str) -> TrainedPolicy:
    run_dir = bundled.find(run_dir)
    spec, path = (None, run_dir) if run_dir.is_file() else (read_spec(run_dir, trust), run_dir / POLICY_FILE)
    if not path.is_file():
        raise FolderError(f"{path} is missing: the run was stopped before its first epoch ended")
    arrays = _read(path)
    if not {"env_spec", "sizes"} & arrays.keys():
        try:
            return from_arrays(arrays)
        except ValueError as error:
            raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error
    if use:
        raise ValueError(f"{use} needs a policy of NumPy arrays; {path} is of a custom learner or custom networks")
    if spec is None:
        raise FolderError(f"{path} is the policy of a custom learner or custom networks: give its run folder instead")
    from mjx_dher.policy.learner_policy import from_arrays as from_state

    try:
        return from_state(arrays, spec)
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"{path} cannot be played: {error}") from error


def _read(path: Path) -> dict[str, Any]:
    """Reads the arrays in a policy.npz; nothing is unpickled."""
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


def check_fits(policy: TrainedPolicy, env: Any) -> None:
    """Raises ValueError if the sizes of observations, goals or actions of a policy and an environment differ."""
    from mjx_dher.contract import env_spec

    theirs, own = env_spec(env).sizes, policy.sizes
    if theirs != own:
        raise ValueError(
            f"the policy takes observations of {own[0]} and goals of {own[1]} numbers and gives actions of {own[2]}; the"
            f" environment has {theirs[0]}, {theirs[1]} and {theirs[2]}"
        )
