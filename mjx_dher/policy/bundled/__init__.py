"""Policies bundled with the package, each a run folder with a card (README.md) in this folder.

`docs/publish_policy.py` makes them. This module needs only Python.
"""

import json
from pathlib import Path
from typing import Any

from mjx_dher.lookup import check_name
from mjx_dher.system.files import FolderError

FOLDER = Path(__file__).resolve().parent
FACTS, CARD = "card.json", "README.md"  # a policy's measurements, and the card made from them
_CONFIG = "config.json"  # every run folder has one
_OF_A_RUN = (_CONFIG, "policy.npz", "result.json")  # without its config.json, a run is an error and not another policy


def names() -> tuple[str, ...]:
    """Names of the bundled policies."""
    return tuple(sorted(path.parent.name for path in FOLDER.glob(f"*/{_CONFIG}")))


def find(run: str | Path) -> Path:
    """Run folder or file for a path or for the name of a bundled policy.

    A run folder or file of this name in the current folder takes precedence. Raises FolderError if there is neither. The
    message lists the bundled policies and suggests the nearest.
    """
    path = Path(run)
    if path.is_file() or any((path / name).exists() for name in _OF_A_RUN):
        return path
    known = names()
    if str(run) in known:
        return FOLDER / str(run)
    if not path.exists():
        try:
            check_name("a bundled policy", str(run), known)
        except ValueError as error:
            raise FolderError(f"{run} is not a run folder: no such folder; and {error}") from None
    return path


def is_shipped(path: Path) -> bool:
    """Whether a path from `find` is a bundled policy."""
    return path.parent == FOLDER


def facts(folder: Path) -> dict[str, Any]:
    """Measurements of a bundled policy: `here` and `original`, `machine`, `commit` and `date`."""
    return dict(json.loads((folder / FACTS).read_text(encoding="utf-8")))
