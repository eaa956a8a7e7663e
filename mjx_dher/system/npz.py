"""Reads untrusted .npz files: headers first, and arrays only if they match their headers."""

import math
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, KeyError, TypeError, MemoryError, NotImplementedError, OverflowError),
    *(RuntimeError, SyntaxError),  # RuntimeError: it needs a password
)
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class Header(NamedTuple):
    """Shape and dtype of an array that has not been read."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def ndim(self) -> int:
        return len(self.shape)


def read(
    path: Path,
    names: Sequence[str] | None = None,
    ratio: float = math.inf,
    check: Callable[[Mapping[str, Header]], None] = lambda headers: None,
) -> dict[str, np.ndarray]:
    """Reads the arrays of an .npz file without unpickling.

    Args:
      names: arrays to read. Default: all.
      ratio: largest ratio of the arrays' bytes to the file's. Weights hardly compress, but gigabytes of zeros do.
      check: called with all headers before any array is read. Raises ValueError for an unwanted array.

    Raises:
      OSError: it cannot be read.
      ValueError: it is damaged, or not an .npz file.
    """
    if path.exists() and not path.is_file():
        raise ValueError("it is not a file")  # reading a FIFO would block
    try:
        with zipfile.ZipFile(path) as archive:
            headers = {info.filename.removesuffix(".npy"): _header(archive, info) for info in archive.infolist()}
            if len(headers) != len(archive.infolist()):
                raise ValueError("an array occurs twice")
            if sum(info.file_size for info in archive.infolist()) > ratio * path.stat().st_size:
                raise ValueError(f"its {path.stat().st_size} bytes would expand by more than {ratio:g} times")
            check(headers)
            arrays = {}
            for name in headers if names is None else [name for name in names if name in headers]:
                with archive.open(f"{name}.npy") as member:
                    arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
                    if member.read(1):  # also compares the checksum
                        raise ValueError(f"{name} is longer than its header says")
            return arrays
    except _DAMAGED as error:
        raise ValueError(str(error)) from error


def _header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Header:
    """Header of an array. Raises ValueError unless the array consists of plain numbers and fills its part of the file."""
    if not info.filename.endswith(".npy") or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{info.filename} is not an array")
    with archive.open(info) as member:
        shape, _, dtype = _HEADERS[np.lib.format.read_magic(member)](member)
        size = member.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject or dtype.kind not in "biufcU":
        raise ValueError(f"{info.filename} must consist of numbers; got {dtype}")
    if size != info.file_size or min(shape, default=0) < 0:
        raise ValueError(f"{info.filename} has {info.file_size} bytes, but its shape {list(shape)} needs {size}")
    return Header(shape, dtype)
