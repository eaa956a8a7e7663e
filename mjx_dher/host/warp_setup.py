"""Warp, imported quietly and set up for this library's kernels."""

import contextlib
import functools
import io

with contextlib.redirect_stdout(io.StringIO()):
    import warp as wp

wp.config.log_level = wp.LOG_WARNING  # otherwise Warp prints a line for each of a hundred kernels


@functools.cache
def prepare() -> None:
    """Lets kernels use the instructions that only Hopper GPUs have (see `hopper`). Call it before kernels are compiled."""
    devices = wp.get_cuda_devices()
    if devices and all(device.arch == 90 for device in devices):
        wp.config.cuda_arch_suffix = "a"
