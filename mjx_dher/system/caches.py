"""The user's cache folder, and the compiled programs that JAX keeps in it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from mjx_dher.system import limits, memory


def user_cache() -> Path:
    """Folder of this library in the user's cache. All of its files can be made again.

    Raises:
      OSError: the user has no home folder (a container's user without a line in /etc/passwd, say).
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"
    except RuntimeError as error:
        raise OSError("the user has no home folder; set HOME or XDG_CACHE_HOME") from error


def keep_compiled_programs() -> None:
    """Makes JAX keep compiled programs in the user's cache folder, unless the user has chosen another.

    JAX cannot keep a program that calls back to Python, as one on a GPU with native physics does.
    """
    import jax

    check_platform()
    config: Any = jax.config  # not all versions of JAX have types for its fields
    if config.jax_compilation_cache_dir is None:
        try:
            config.update("jax_compilation_cache_dir", str(user_cache() / "xla"))
        except OSError as error:
            print(f"compiled programs are not kept: {error}", file=sys.stderr)


def check_platform() -> None:
    """Starts JAX's devices, with no more threads of a CPU than this process may use.

    Raises:
      ValueError: the platform that JAX_PLATFORMS asks for does not exist on this machine.
    """
    import jax

    limits.limit_threads()
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # an AssertionError where the package of a platform is missing
        reason = (str(error).splitlines() or ["it is not installed"])[0]
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(
            f"JAX_PLATFORMS={asked!r}: JAX cannot start this platform ({reason}); unset it, or take cpu"
        ) from error


def prepare() -> None:
    """Prepares a process that trains for hours: compiled programs are kept, freed memory is not."""
    memory.keep_heap_small()  # before JAX starts threads
    keep_compiled_programs()
