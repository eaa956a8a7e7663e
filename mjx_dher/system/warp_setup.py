"""Warp, imported quietly and set up for this library's kernels."""

import atexit
import contextlib
import functools
import io
import os
import shutil
import tempfile
import warnings
from typing import Any

from mjx_dher.system.machine import user_cache

with contextlib.redirect_stdout(io.StringIO()):
    import warp as wp

wp.config.log_level = wp.LOG_WARNING  # otherwise Warp prints a line per kernel


@functools.cache
def prepare() -> None:
    """Starts Warp and configures how kernels are compiled. Call it before using Warp.

    Kernels are cached as machine code, because the driver would recompile Warp's default format. If Warp's cache folder is
    unusable, a warning is issued and a temporary folder replaces it.
    """
    try:
        if not (wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")):
            user_cache()  # raises without a home folder, where Warp would make a folder called ~
        wp.init()
        with tempfile.TemporaryFile(dir=wp.config.kernel_cache_dir):
            pass
    except OSError as error:
        folder = tempfile.mkdtemp(prefix="warp-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        warnings.warn(
            f"Warp cannot cache compiled kernels ({error}): each process compiles them again, for a quarter of a minute;"
            " set WARP_CACHE_PATH to another folder",
            stacklevel=2,
        )
        os.environ["WARP_CACHE_PATH"] = folder
        wp.config.kernel_cache_dir = folder
        wp.init()
    devices = wp.get_cuda_devices()
    if devices and all(device.is_cubin_supported for device in devices):
        wp.config.cuda_output = "cubin"


def load(module: Any, block: int | None = None) -> None:
    """Compiles a Warp module for the current device, or loads it from the cache. Recompiles if the cached one is damaged.
    `block` is the number of threads per block to compile for, by default Warp's.
    """
    block = (1 if wp.get_device().is_cpu else module.options["block_dim"]) if block is None else block
    kept = os.path.join(str(wp.config.kernel_cache_dir), module.get_module_identifier(block_dim=block))
    was_there = os.path.isdir(kept)
    try:
        module.load(wp.get_device(), block)
    except Exception as error:  # Warp has no narrower class
        if not was_there:
            raise
        warnings.warn(f"{kept} cannot be used ({error}): its kernels are compiled again", stacklevel=2)
        shutil.rmtree(kept, ignore_errors=True)
        module.load(wp.get_device(), block)
