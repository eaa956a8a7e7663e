"""The trained policies that are part of the package: a run folder each, beside this file, with a card (README.md).

`docs/publish_policy.py` makes them. Finding one needs nothing but Python.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mjx_dher.lookup import check_name
from mjx_dher.system.files import FolderError

FOLDER = Path(__file__).resolve().parent
FACTS, CARD = "card.json", "README.md"  # what was measured of a policy, and the card that is made of it
_CONFIG = "config.json"  # every run folder has one


def names() -> tuple[str, ...]:
    """Returns the names of the policies that are part of the package."""
    return tuple(sorted(path.parent.name for path in FOLDER.glob(f"*/{_CONFIG}")))


def find(run: str | Path) -> Path:
    """Returns the run folder, or the file, that `run` names: a path, or else the name of a policy of the package.

    A run folder or a file by this name in the current folder comes first. A folder that is no run's does not.

    Raises:
      FolderError: there is neither; the message has the policies' names, and suggests the nearest.
    """
    path = Path(run)
    if path.is_file() or (path / _CONFIG).exists():
        return path
    known = names()
    if str(run) in known:
        return FOLDER / str(run)
    if not path.exists():
        try:
            check_name("a policy of the package", str(run), known)
        except ValueError as error:
            raise FolderError(f"{run} is not a run folder: no such folder; and {error}") from None
    return path


def is_shipped(path: Path) -> bool:
    """Returns whether a path, as `find` gave it, is of a policy of the package."""
    return path.parent == FOLDER


def facts(folder: Path) -> dict[str, Any]:
    """Returns what was measured of a policy of the package: `here` and `original`, `machine`, `commit` and `date`."""
    return dict(json.loads((folder / FACTS).read_text(encoding="utf-8")))
