"""Trained policies: as NumPy functions, as a learner's state, as files, and bundled with the package.

`Policy` needs only NumPy. Import `policy.load`, `policy.learner_policy` and `policy.bundled` explicitly.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mjx_dher.system import files

__all__ = ["Policy", "TrainedPolicy", "from_arrays", "from_mlp", "read_interface"]

VECTORS = ("observation_mean", "observation_std", "goal_mean", "goal_std")
SCALARS = ("norm_clip", "obs_clip")


class TrainedPolicy(Protocol):
    """A deterministic policy from `load_policy`: a `Policy` or a `learner_policy.LearnerPolicy`."""

    @property
    def sizes(self) -> tuple[Any, int, int]: ...  # D, G and A (`EnvSpec.sizes`)

    @property
    def interface(self) -> Mapping[str, Any]: ...  # `contract.robot_interface` of the run's environment; {} if unknown

    def __call__(self, obs: Mapping[str, Any]) -> np.ndarray: ...  # actions [..., A] for one state or a batch

    def forward(self, observation: Any, goal: Any, xp: Any = np) -> Any: ...  # the same without checks, in NumPy or JAX

    def save(self, path: Path, **extra: Any) -> None: ...


@dataclasses.dataclass(frozen=True)
class Policy:
    """A deterministic policy: normalization, linear layers with ReLU between them, tanh.

    Call it with a mapping that has "observation" [..., D] and "desired_goal" [..., G], such as the observation of a Gymnasium
    goal environment. It returns actions [..., A] float32 in [-1, 1].
    """

    layers: tuple[tuple[Any, Any], ...]  # (kernel [in, out], bias [out]) of each linear layer
    observation_mean: Any  # [D]
    observation_std: Any  # [D], at least norm_eps
    goal_mean: Any  # [G]
    goal_std: Any  # [G]
    norm_clip: float
    obs_clip: float
    # Seconds of a step `dt`; of a task from an MJCF also `controls`, observation `layout` and names of its `joints`.
    interface: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Sizes D, G and A of observation, goal and action."""
        return self.observation_mean.shape[0], self.goal_mean.shape[0], self.layers[-1][1].shape[0]

    def __call__(self, obs: Mapping[str, Any]) -> np.ndarray:
        """Actions [..., A] for observations of one state or a batch. Raises ValueError if a key is missing, a last axis has the
        wrong size, or a value is not finite.
        """
        values = []
        for key, mean in (("observation", self.observation_mean), ("desired_goal", self.goal_mean)):
            if key not in obs:
                raise ValueError(f"the policy needs {key!r}; got {sorted(obs)}")
            value = np.asarray(obs[key], np.float32)
            if value.ndim == 0 or value.shape[-1] != mean.shape[0]:
                raise ValueError(f"the last axis of {key} must have size {mean.shape[0]}; got shape {value.shape}")
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{key} must be finite")
            values.append(value)
        if values[0].shape[:-1] != values[1].shape[:-1]:
            raise ValueError(f"batch shapes differ: observation {values[0].shape}, desired_goal {values[1].shape}")
        return self.forward(values[0], values[1], np)

    def forward(self, observation: Any, goal: Any, xp: Any = np) -> Any:
        """Actions for observations [..., D] and goals [..., G], in NumPy or, with xp=jax.numpy, in JAX. Checks nothing."""

        def normalize(value, mean, std):
            value = xp.clip(value, -self.obs_clip, self.obs_clip)
            rank = (1,) * (value.ndim - 1)  # explicit batch axes, because JAX may forbid implicit ones
            return xp.clip((value - mean.reshape(*rank, -1)) / std.reshape(*rank, -1), -self.norm_clip, self.norm_clip)

        x = xp.concatenate(
            [
                normalize(observation, self.observation_mean, self.observation_std),
                normalize(goal, self.goal_mean, self.goal_std),
            ],
            axis=-1,
        )
        for index, (kernel, bias) in enumerate(self.layers):
            x = x @ kernel + bias.reshape(*(1,) * (x.ndim - 1), -1)
            if index < len(self.layers) - 1:
                x = xp.maximum(x, 0)
        return xp.tanh(x)

    def arrays(self) -> dict[str, np.ndarray]:
        """Named arrays of the policy, float32: layerI_kernel [in, out], layerI_bias [out], and the other fields."""
        arrays = {f"layer{i}_{part}": a for i, layer in enumerate(self.layers) for part, a in zip(("kernel", "bias"), layer)}
        arrays |= {field: getattr(self, field) for field in (*VECTORS, *SCALARS)}
        return {name: np.array(array, np.float32, order="C") for name, array in arrays.items()}

    def save(self, path: str | Path, **extra: Any) -> None:
        """Writes the policy to `path`. An existing file is replaced only when the new one is complete."""
        arrays: dict[str, Any] = {**self.arrays(), **interface_array(self.interface), **extra}
        with files.atomic_write(Path(path)) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)


def from_mlp(dense: Any, observation_norm: Any, goal_norm: Any, hparams: Any) -> Policy:
    """Makes a policy from the actor's linear layers, by flax's names, and `NormalizerState`s of observations [D], goals [G]."""
    layers = tuple(
        (np.asarray(dense[f"Dense_{i}"]["kernel"]), np.asarray(dense[f"Dense_{i}"]["bias"])) for i in range(len(dense))
    )

    def std(norm: Any) -> np.ndarray:
        return np.maximum(np.sqrt(np.asarray(norm.var)), np.float32(hparams.norm_eps))

    return Policy(
        layers=layers,
        observation_mean=np.asarray(observation_norm.mean),
        observation_std=std(observation_norm),
        goal_mean=np.asarray(goal_norm.mean),
        goal_std=std(goal_norm),
        norm_clip=float(hparams.norm_clip),
        obs_clip=float(hparams.obs_clip),
    )


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


def interface_array(interface: Mapping[str, Any]) -> dict[str, NDArray]:
    """The `interface` as the array "interface" of a policy file. An empty dict if there is none."""
    return {"interface": np.frombuffer(json.dumps(dict(interface)).encode(), np.uint8)} if interface else {}


def read_interface(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """The `interface` among the arrays of a policy file, {} if there is none. Raises ValueError if it is no JSON object."""
    interface = json.loads(arrays["interface"].tobytes()) if "interface" in arrays else {}
    if not isinstance(interface, dict):
        raise ValueError(f"interface must be a JSON object; it is {str(interface)[:100]}")
    return interface


def _check_array(name: str, array: Any) -> None:
    """Raises ValueError for an array of a wrong type or rank, or with invalid values."""
    ndim = 0 if name in SCALARS else 2 if name.endswith("_kernel") else 1
    if array.dtype != np.float32 or array.ndim != ndim or 0 in array.shape:
        raise ValueError(f"{name} must be float32 with {ndim} axes; got {array.dtype}{list(array.shape)}")
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
