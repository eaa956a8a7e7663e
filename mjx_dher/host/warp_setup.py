"""Warp, as this library uses it."""

import contextlib
import functools
import io

with contextlib.redirect_stdout(io.StringIO()):
    import warp as wp

wp.config.log_level = wp.LOG_WARNING  # not a line for each of a hundred kernels


@functools.cache
def prepare() -> None:
    """To be called before kernels are compiled. On Hopper GPUs they may use what only these have: see `hopper`."""
    devices = wp.get_cuda_devices()
    if devices and all(device.arch == 90 for device in devices):
        wp.config.cuda_arch_suffix = "a"
