"""The user's cache folder, and the compiled programs that JAX keeps in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any


def user_cache() -> Path:
    """Returns this library's folder in the user's cache, whose files can all be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"


def keep_compiled_programs() -> None:
    """Makes JAX keep compiled programs in the user's cache folder, unless the user has chosen another.

    JAX cannot keep a program that calls back to Python, as one on a GPU with native physics does.
    """
    import jax

    check_platform()
    config: Any = jax.config  # not all versions of JAX have types for its fields
    if config.jax_compilation_cache_dir is None:
        config.update("jax_compilation_cache_dir", str(user_cache() / "xla"))


def check_platform() -> None:
    """Starts JAX's devices.

    Raises:
      ValueError: the platform that JAX_PLATFORMS asks for does not exist on this machine.
    """
    import jax

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
    from mjx_dher.system import memory

    memory.keep_heap_small()  # before JAX starts threads
    keep_compiled_programs()
