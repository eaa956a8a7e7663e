"""Kernels for NVIDIA's Hopper GPUs (H100, H200), imported only where a run may use them."""
