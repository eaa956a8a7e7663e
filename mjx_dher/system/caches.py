"""The user's cache folder, and JAX's compiled programs in it."""

import os
import sys
from pathlib import Path
from typing import Any

from mjx_dher.system import limits, memory


def user_cache() -> Path:
    """Folder of this library in the user's cache. All of its files can be recreated. Raises OSError if the user has no home
    folder (for example in a container, without a line in /etc/passwd).
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"
    except RuntimeError as error:
        raise OSError("the user has no home folder; set HOME or XDG_CACHE_HOME") from error


def keep_compiled_programs() -> None:
    """Makes JAX cache compiled programs in the user's cache folder, unless the user has chosen another one.

    JAX cannot cache programs that call back to Python, such as those on a GPU with native physics.
    """
    import jax

    check_platform()
    config: Any = jax.config  # not all versions of JAX have types for its fields
    if config.jax_compilation_cache_dir is None:
        try:
            config.update("jax_compilation_cache_dir", str(user_cache() / "xla"))
        except OSError as error:
            print(f"compiled programs are not cached: {error}", file=sys.stderr)


def check_platform() -> None:
    """Starts JAX's devices, on at most the usable cores. Raises ValueError if JAX_PLATFORMS names one that is missing."""
    import jax

    limits.limit_threads()
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # AssertionError: the package of a platform is missing
        reason = (str(error).splitlines() or ["it is not installed"])[0]
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(f"JAX_PLATFORMS={asked!r}: JAX cannot start this platform ({reason}); unset it, or use cpu") from error


def prepare() -> None:
    """Prepares a process for training: it caches compiled programs, and returns freed memory. Raises ValueError if the user has
    disabled compilation.
    """
    import jax

    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        raise ValueError("JAX_DISABLE_JIT is set, but training needs compiled programs; unset it")
    memory.keep_heap_small()  # before JAX starts threads
    keep_compiled_programs()
