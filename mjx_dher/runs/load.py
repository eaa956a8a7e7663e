"""Reads what a run left. Needs NumPy alone, unless the run had a learner or networks of one's own."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.host.files import FolderError
from mjx_dher.policy import Policy, from_arrays
from mjx_dher.runs.run_folder import POLICY_FILE, read_spec
from mjx_dher.spec import RunSpec


def load_policy(run_dir: str | Path) -> Policy:
    """Returns the policy of a run folder. Imports NumPy only: no JAX, no MuJoCo, no environment.

    The policy of a learner or networks of one's own is a `learners.stored.StoredPolicy`, which is called alike and needs JAX.

    Raises:
      FolderError: `run_dir` is no run folder of this program, or its policy is missing, damaged, or of a learner or networks
        of one's own that cannot be imported or do not fit it.
    """
    run_dir = Path(run_dir)
    spec = read_spec(run_dir)
    path = run_dir / POLICY_FILE
    if not path.is_file():
        raise FolderError(f"{path} is missing: the run was stopped before its first epoch ended")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = {name: file[name] for name in file.files}
        policy = None if "sizes" in arrays else from_arrays(arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error
    if policy is not None:
        return policy
    from mjx_dher.learners.stored import from_arrays as from_state

    try:
        return from_state(arrays, spec)  # type: ignore[return-value]
    except ValueError as error:
        raise FolderError(f"{path} cannot be played: {error}") from error


def check_plain(policy: Policy, spec: RunSpec, use: str) -> None:
    """Refuses a policy that needs its learner to be played, for a `use` that has NumPy alone.

    Raises:
      ValueError: names the learner and the networks.
    """
    if not isinstance(policy, Policy):
        raise ValueError(
            f"{use} takes a policy of NumPy arrays, which learner {spec.learner!r} with networks {spec.networks!r} has not"
        )
