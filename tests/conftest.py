"""Fixtures shared by the tests; run from a checkout, installed or not."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # nothing of a test stays in the user's cache folder
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]


def load_recorded(task):
    """Episodes of the original task; see tests/data/README.md."""
    with np.load(ROOT / "tests" / "data" / f"fetch_{task}.npz") as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="session")
def recorded():
    """Episodes of the original FetchPush."""
    return load_recorded("push")
