"""Trust in names that a file gives, of code to import or data to read. They are used only if the user has used them before.

Training records the names that the user typed or passed, with their files, in the user's state folder. A name from a file
needs such a record, or `--trust` (`trust=True` in Python).
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from mjx_dher import lookup


class FromFile(str):
    """A name that a file gives, equal to its text."""

    file: Path
    arguments: tuple[str, ...]  # of an environment, from the same file

    @classmethod
    def of(cls, name: str, file: Path, arguments: Sequence[str] = ()) -> Self:
        """Marks a name as coming from a file."""
        marked = cls(name)
        marked.file, marked.arguments = file, tuple(arguments)
        return marked


def check(field: str, name: str, place: Path | None) -> None:
    """Checks that a name may be used. Only a `FromFile` is checked. `place` is the file of its module or data. Raises
    ValueError if the name comes from a file, and the user has neither trained with it nor passed `--trust`.
    """
    if lookup.trusts_files or not isinstance(name, FromFile):
        return
    try:
        if _record(field, name, place, name.arguments).exists():
            return
        reason = "you have not trained with it here"
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        reason = f"names that you trained with cannot be looked up ({error})"
    arguments = f" with the arguments {' '.join(name.arguments)}" if name.arguments else ""
    raise ValueError(
        f"{field} {str(name)!r}{arguments} is named by {name.file}, and {reason}. If you trust that file and"
        f" {place or 'the module'}, give --trust (trust=True in Python), or type the name yourself"
    )


def record(field: str, name: str, place: Path | None, arguments: Sequence[str] = ()) -> None:
    """Records a name that the user typed or passed, with the file of its module or data, unless there is no state folder.

    A `FromFile` is recorded with other `arguments`, which the user typed, if the user has trained with those of its file.
    """
    with contextlib.suppress(OSError, RuntimeError):
        if isinstance(name, FromFile) and not _record(field, name, place, name.arguments).exists():
            return
        _folder(make=True)
        _record(field, name, place, arguments).touch()


def _record(field: str, name: str, place: Path | None, arguments: Sequence[str]) -> Path:
    content = json.dumps([field, name, None if place is None else str(place.resolve()), list(arguments)])
    return _folder() / hashlib.sha256(content.encode("utf-8", "surrogateescape")).hexdigest()


def _folder(make: bool = False) -> Path:
    """Folder of the records. Raises OSError if others can write to it, or its path is relative."""
    folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "mjx-dher" / "trusted"
    if not folder.is_absolute():
        raise OSError(f"{folder} is not an absolute path")
    if make:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.exists() and ((status := folder.stat()).st_uid != os.getuid() or status.st_mode & 0o022):
        raise OSError(f"others can write to {folder}")
    return folder
