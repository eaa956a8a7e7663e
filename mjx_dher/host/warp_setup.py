"""Warp, imported quietly and set up for this library's kernels."""

import contextlib
import functools
import io

with contextlib.redirect_stdout(io.StringIO()):
    import warp as wp

wp.config.log_level = wp.LOG_WARNING  # otherwise Warp prints a line for each of a hundred kernels


@functools.cache
def prepare() -> None:
    """Sets how kernels are compiled. Call it before they are.

    They may use the instructions that only Hopper GPUs have (see `hopper`), and are kept as machine code: what Warp keeps by
    default, the driver would compile once more.
    """
    devices = wp.get_cuda_devices()
    if devices and all(device.is_cubin_supported for device in devices):
        wp.config.cuda_output = "cubin"
    if devices and all(device.arch == 90 for device in devices):
        wp.config.cuda_arch_suffix = "a"
