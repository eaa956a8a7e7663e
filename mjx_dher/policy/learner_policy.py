"""Policies of custom learners and networks: the learner's state in a file. They need JAX and the learner."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import learners
from mjx_dher.config import HParams
from mjx_dher.learners import Learner
from mjx_dher.policy import interface_array, read_interface
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import atomic_write
from mjx_dher.types import Array, EnvSpec, PyTree, with_key, without_key


@dataclasses.dataclass(frozen=True)
class LearnerPolicy:
    """A deterministic `TrainedPolicy` that needs its learner. It cannot be exported to other formats."""

    learner: Learner
    state: PyTree  # the learner's
    hparams: HParams
    spec: EnvSpec
    interface: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # as a `Policy` has it

    @property
    def sizes(self) -> tuple[Any, int, int]:
        """Sizes of observations, goals and actions, as in `EnvSpec.sizes`."""
        return self.spec.sizes

    def __call__(self, obs: Mapping[str, Any]) -> np.ndarray:
        """Actions [..., A] for observations of one state or a batch. Tuples may stand for lists, as in gymnasium. Raises
        ValueError for a missing key, another structure or shape, or a number that is not finite.
        """
        if "observation" in obs:
            obs = {**obs, "observation": _with_lists(obs["observation"], self.spec.observation)}
        goal = jax.ShapeDtypeStruct((self.spec.goal_size,), jnp.float32)
        leading = {
            key: _leading(key, obs, like) for key, like in (("observation", self.spec.observation), ("desired_goal", goal))
        }
        if len(set().union(*leading.values())) > 1:
            raise ValueError(f"batch shapes differ: {leading}")
        return np.asarray(self.forward(jax.tree.map(jnp.asarray, obs["observation"]), jnp.asarray(obs["desired_goal"])))

    def forward(self, observation: Any, goal: Any, xp: Any = jnp) -> Array:
        """Actions for observations [..., D] and goals [..., G]. Ignores `xp`."""
        obs: Any = {"observation": observation, "desired_goal": goal}
        return self.learner.act(self.state, obs, self.hparams)

    def save(self, path: str | Path, **extra: Any) -> None:
        """Writes the policy to `path`. An existing file is replaced only when the new one is complete."""
        arrays: dict[str, Any] = {f"state{i:04d}": _to_plain(leaf) for i, leaf in enumerate(jax.tree.leaves(self.state))}
        arrays |= {"env_spec": np.array(to_json(self.spec)), **interface_array(self.interface), **extra}
        with atomic_write(Path(path)) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)


def _to_plain(leaf: Any) -> np.ndarray:
    """Array of NumPy's own numbers: the data of random keys, and the bits of types that NumPy lacks, such as bfloat16."""
    array = np.asarray(without_key(leaf))
    return array.view(f"u{array.itemsize}") if array.dtype.kind == "V" else array


def _from_plain(array: np.ndarray, like: Any) -> Array:
    """Inverse of `_to_plain` for a leaf with the shape and dtype of `like`. Raises ValueError if they do not fit."""
    numbers = jax.eval_shape(without_key, like)
    dtype = np.dtype(numbers.dtype)
    if array.shape != numbers.shape or array.dtype != (f"u{dtype.itemsize}" if dtype.kind == "V" else dtype):
        raise ValueError(f"got {array.dtype}{list(array.shape)} for {like.dtype}{list(like.shape)}")
    return with_key(jnp.asarray(array.view(dtype)), like)


def _with_lists(tree: Any, like: PyTree) -> Any:
    """The tree with lists and tuples where `like` has them."""
    if isinstance(tree, Mapping) and isinstance(like, Mapping):
        return {name: _with_lists(child, like.get(name)) for name, child in tree.items()}
    if type(tree) in (tuple, list) and type(like) in (tuple, list) and len(tree) == len(like):
        return type(like)(map(_with_lists, tree, like))
    return tree


def _leading(key: str, obs: Mapping[str, Any], like: PyTree) -> set[tuple[int, ...]]:
    """Batch shapes of the arrays of an entry of `obs`. Raises ValueError if they do not fit `like`, or are not finite."""
    if key not in obs:
        raise ValueError(f"the policy needs {key!r}; got {sorted(obs)}")
    given, expected = (str(jax.tree.structure(tree)) for tree in (obs[key], like))
    if given != expected:
        raise ValueError(f"{key} must have the structure {expected}; got {given}")
    shapes = set()
    for leaf, one in zip(map(np.asarray, jax.tree.leaves(obs[key])), jax.tree.leaves(like)):
        split = leaf.ndim - len(one.shape)
        if split < 0 or leaf.shape[split:] != one.shape:
            raise ValueError(f"the last axes of {key} must be {list(one.shape)}; got shape {leaf.shape}")
        if not np.isfinite(leaf).all():
            raise ValueError(f"{key} must be finite")
        shapes.add(leaf.shape[:split])
    return shapes


def from_arrays(arrays: Mapping[str, np.ndarray], spec: RunSpec) -> LearnerPolicy:
    """Policy of the run `spec` from the arrays of `LearnerPolicy.save`. Raises ValueError if they do not fit its learner."""
    if "env_spec" in arrays:
        env_spec = from_json(str(arrays["env_spec"]))
    else:  # older files have only the sizes D, G and A
        size, goal_size, action_size = map(int, arrays["sizes"])
        env_spec = EnvSpec(jax.ShapeDtypeStruct((size,), jnp.float32), goal_size, action_size, episode_length=1)
    learner = learners.make(spec.learner, spec.config, env_spec, spec.networks)
    template = jax.eval_shape(learner.init, jax.random.key(0))
    leaves, treedef = jax.tree.flatten(template)
    stored = [arrays[f"state{i:04d}"] for i in range(sum(name.startswith("state") for name in arrays))]
    try:
        state = jax.tree.unflatten(treedef, [_from_plain(x, like) for x, like in zip(stored, leaves, strict=True)])
    except ValueError as error:
        raise ValueError(f"its arrays do not fit learner {spec.learner!r} with networks {spec.networks!r} ({error})") from error
    policy = LearnerPolicy(learner, state, spec.hparams, env_spec, read_interface(arrays))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), env_spec.observation)
    if not np.all(np.isfinite(policy({"observation": zeros, "desired_goal": np.zeros(env_spec.goal_size, np.float32)}))):
        raise ValueError("its action for an observation of zeros is not finite")
    return policy


def to_json(spec: EnvSpec) -> str:
    """Writes a spec as JSON. Raises ValueError if its observation is not made of dicts, lists and tuples."""

    def of(tree: Any) -> Any:
        if isinstance(tree, jax.ShapeDtypeStruct):
            return {"shape": tree.shape, "dtype": tree.dtype.name}
        if type(tree) is dict:
            return {"dict": {name: of(child) for name, child in tree.items()}}
        if type(tree) in (list, tuple):
            return {type(tree).__name__: [of(child) for child in tree]}
        raise ValueError(f"observation must consist of dicts, lists, tuples and arrays to be saved; it has a {type(tree)}")

    fields = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    return json.dumps({**fields, "observation": of(spec.observation)})


def from_json(text: str) -> EnvSpec:
    """Reads a spec written by `to_json`."""

    def of(tree: dict[str, Any]) -> Any:
        if "shape" in tree:
            return jax.ShapeDtypeStruct(tuple(tree["shape"]), jnp.dtype(tree["dtype"]))
        ((kind, children),) = tree.items()
        if kind == "dict":
            return {name: of(child) for name, child in children.items()}
        return {"list": list, "tuple": tuple}[kind](map(of, children))

    fields = json.loads(text)
    fields |= {"observation": of(fields["observation"]), "reward_range": tuple(fields["reward_range"])}
    return EnvSpec(**fields)
