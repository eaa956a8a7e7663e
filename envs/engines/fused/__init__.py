"""MuJoCo's timestep in one CUDA kernel, for models with supported features only (`support`).

A CUDA kernel takes as long to start as some ten thousand environments take to run in it, and MuJoCo Warp's step is 135 of
them. Here one kernel advances all environments by all timesteps of an environment step. Threads of
one warp share an environment (`threads`), whose numbers stay in shared memory. Each environment's solver stops when it has
converged. Warp reads annotations as types, so modules of kernels cannot have `from __future__ import annotations`.
"""
