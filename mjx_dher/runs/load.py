"""Reads what a run left. Needs NumPy alone: neither JAX nor MuJoCo."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from mjx_dher.host.files import FolderError
from mjx_dher.policy import Policy, from_arrays
from mjx_dher.runs.run_folder import POLICY_FILE, read_config


def load_policy(run_dir: str | Path) -> Policy:
    """The policy of a run folder. Imports NumPy only: no JAX, no MuJoCo, no environment.

    Raises:
      FolderError: `run_dir` is no run folder of this program, or its policy is missing or damaged.
    """
    run_dir = Path(run_dir)
    read_config(run_dir)
    path = run_dir / POLICY_FILE
    if not path.is_file():
        raise FolderError(f"{path} is missing: the run was stopped before its first epoch ended")
    try:
        with np.load(path, allow_pickle=False) as file:
            return from_arrays({name: file[name] for name in file.files})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FolderError(f"{path} is damaged or not a policy of this program ({error})") from error
