"""Fixtures shared by the tests; run from a checkout, installed or not."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"
# What one test has compiled the next one need not, in whichever of the processes that run side by side (see pyproject.toml);
# but nothing of a test stays in the user's cache folder.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache = tempfile.mkdtemp()
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)
# Compiling takes most of the tests' time, and a fifth less of it without what makes programs fast.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true")
sys.path[:0] = [str(ROOT), str(Path(__file__).parent), str(EXAMPLES)]


def load_recorded(task):
    """Episodes of the original task; see tests/data/README.md."""
    with np.load(ROOT / "tests" / "data" / f"fetch_{task}.npz") as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="session")
def recorded():
    """Episodes of the original FetchPush."""
    return load_recorded("push")
