"""Where code of the user's own is, module:attribute, which nodes of a cluster need, too."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from mjx_dher.spec import RunSpec, custom_components

INSTALLED = {"site-packages", "dist-packages"}


def folder_of(specs: Sequence[RunSpec]) -> Path | None:
    """Returns the folder from which own code is imported, and that nodes get; None where all of it is installed.

    Raises:
      ValueError: own code is imported from more than one folder.
    """
    roots: dict[Path, str] = {}
    for spec in specs:
        for field in custom_components(spec):
            value = str(getattr(spec, field))
            if (root := _root_of(value)) is not None:
                roots.setdefault(root, f"{field} {value} in {root}")
    if len(roots) > 1:
        raise ValueError(
            f"with --ray, own code must lie in one folder, or be installed on every node; got {'; '.join(roots.values())}"
        )
    return next(iter(roots), None)


def with_own_parts(specs: Sequence[RunSpec]) -> list[RunSpec]:
    """Returns a run for each set of own parts among `specs`: what nodes are asked about."""
    by_parts = {tuple((field, getattr(spec, field)) for field in custom_components(spec)): spec for spec in specs}
    return [spec for parts, spec in by_parts.items() if parts]


def _root_of(import_path: str) -> Path | None:
    """Returns the folder from which the top module of "module:attribute" is imported; None where it is installed."""
    spec = importlib.util.find_spec(import_path.partition(":")[0].partition(".")[0])
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())
    place = Path(folders[0]) if folders else Path(spec.origin or "")
    return None if INSTALLED & set(place.parts) else place.absolute().parent
