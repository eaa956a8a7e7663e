"""Kernels for NVIDIA's Hopper GPUs (H100, H200). Loaded only where a run may use them."""
