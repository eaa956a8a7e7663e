"""Checks the arrays of a policy file, and makes a `Policy` of them. Needs only NumPy."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjx_dher.policy import SCALARS, VECTORS, Policy


def from_arrays(arrays: Mapping[str, Any]) -> Policy:
    """Makes a policy from its `Policy.arrays`. Raises ValueError for an array that is missing or invalid."""
    num_layers = sum(name.endswith("_kernel") for name in arrays)
    needed = [f"layer{i}_{part}" for i in range(max(1, num_layers)) for part in ("kernel", "bias")] + [*VECTORS, *SCALARS]
    if missing := [name for name in needed if name not in arrays]:
        raise ValueError(f"it has no array {missing[0]}")
    for name in needed:
        _check_array(name, arrays[name])
    sizes = [arrays["observation_mean"].shape[0] + arrays["goal_mean"].shape[0]]
    for i in range(num_layers):
        kernel, bias = arrays[f"layer{i}_kernel"], arrays[f"layer{i}_bias"]
        if kernel.shape[0] != sizes[-1] or bias.shape != kernel.shape[1:]:
            raise ValueError(
                f"layer{i}_kernel {list(kernel.shape)} and layer{i}_bias {list(bias.shape)} do not follow {sizes[-1]} numbers"
            )
        sizes.append(kernel.shape[1])
    for name in ("observation", "goal"):
        if arrays[f"{name}_mean"].shape != arrays[f"{name}_std"].shape:
            raise ValueError(f"{name}_mean and {name}_std differ in shape")
    _check_bounds([[np.abs(arrays[f"layer{i}_{part}"]) for part in ("kernel", "bias")] for i in range(num_layers)], arrays)
    return Policy(
        layers=tuple((arrays[f"layer{i}_kernel"], arrays[f"layer{i}_bias"]) for i in range(num_layers)),
        **{field: arrays[field] for field in VECTORS},
        **{field: float(arrays[field]) for field in SCALARS},
        interface=read_interface(arrays),
    )


def read_interface(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """The `interface` among the arrays of a policy file, {} if there is none. Raises ValueError if it is no JSON object."""
    interface = json.loads(arrays["interface"].tobytes()) if "interface" in arrays else {}
    if not isinstance(interface, dict):
        raise ValueError(f"interface must be a JSON object; it is {str(interface)[:100]}")
    return interface


def _check_array(name: str, array: Any) -> None:
    """Raises ValueError for an array of a wrong type or rank, or with invalid values."""
    ndim = 0 if name in SCALARS else 2 if name.endswith("_kernel") else 1
    if array.dtype.kind != "f" or array.ndim != ndim or 0 in array.shape:
        raise ValueError(f"{name} must be floats with {ndim} axes; got {array.dtype}{list(array.shape)}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite")
    if (name in SCALARS or name.endswith("_std")) and not np.all(array > 0):
        raise ValueError(f"{name} must be greater than 0; the least is {array.min():g}")


def _check_bounds(layers: Sequence[Sequence[NDArray]], arrays: Mapping[str, Any]) -> None:
    """Raises ValueError if a hidden unit could overflow, so that an action could be NaN."""
    most = np.full(len(layers[0][0]), float(arrays["norm_clip"]))
    for number, (kernel, bias) in enumerate(layers):
        with np.errstate(over="ignore"):
            most = most @ kernel.astype(np.float64) + bias
        if not np.all(most < np.finfo(np.float32).max):
            raise ValueError(f"layer{number} has weights so large that an action could be NaN")
