"""Files that commands write."""

from collections.abc import Iterable
from pathlib import Path

from mjx_dher.system.files import FolderError


def check_file(out: Path, endings: Iterable[str], overwrite: bool) -> None:
    """Checks early that the file `out` can be written. Raises FolderError if `out` ends in none of `endings`, is a folder,
    exists (without `overwrite`), or its folder does not exist.
    """
    endings = tuple(endings)
    if out.suffix.lower() not in endings:
        raise FolderError(f"out must end in {', '.join(endings)}; got {str(out)!r}")
    if out.is_dir():
        raise FolderError(f"out: {out} is a folder")
    if out.exists() and not overwrite:
        raise FolderError(f"out: {out} exists; pass another file or --overwrite")
    if not out.parent.is_dir():
        raise FolderError(f"out: there is no folder {out.parent}")
