"""Where what can be made again is kept, and compiled programs among it."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache() -> Path:
    """The folder for what can be made again, in the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-dher"


def keep_compiled_programs() -> None:
    """Has JAX keep what it compiles in the user's cache folder, unless the user has chosen one.

    A program that calls back to Python, as every one with native physics, cannot be kept.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(user_cache() / "xla"))


def prepare() -> None:
    """What a program that trains for hours needs: compiled programs are kept, and memory is not."""
    from mjx_dher.host import memory

    memory.keep_heap_small()  # before JAX starts threads
    keep_compiled_programs()
