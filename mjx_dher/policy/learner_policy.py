"""Policies of custom learners and networks: the learner's state as a file, played by the learner, with JAX."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher import learners
from mjx_dher.config import HParams
from mjx_dher.learners import Learner
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import atomic_write
from mjx_dher.types import Array, PyTree, Sizes


@dataclasses.dataclass(frozen=True)
class LearnerPolicy:
    """A deterministic `TrainedPolicy` that needs its learner. It cannot be exported to other formats."""

    learner: Learner
    state: PyTree  # the learner's
    hparams: HParams
    sizes: Sizes

    def __call__(self, obs: Mapping[str, Any]) -> np.ndarray:
        """Computes the actions [..., A] for observations of one state or a batch."""
        return np.asarray(self.forward(jnp.asarray(obs["observation"]), jnp.asarray(obs["desired_goal"])))

    def forward(self, observation: Any, goal: Any, xp: Any = jnp) -> Array:
        """Computes actions for observations [..., D] and goals [..., G]; `xp` is ignored."""
        del xp
        obs: Any = {"observation": observation, "desired_goal": goal}
        return self.learner.act(self.state, obs, self.hparams)

    def save(self, path: Path, **extra: Any) -> None:
        """Writes the policy to `path`; an existing file is replaced only when the new one is complete."""
        arrays: dict[str, Any] = {f"state{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(self.state))}
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(file, sizes=np.array(self.sizes), **arrays, **extra)


def from_arrays(arrays: Mapping[str, np.ndarray], spec: RunSpec) -> LearnerPolicy:
    """Makes the policy of what `LearnerPolicy.save` wrote; `spec` describes its run.

    Raises:
      ValueError: the arrays are not those of this learner.
    """
    sizes = Sizes(*map(int, arrays["sizes"]))
    learner = learners.make(spec.learner, spec.config, sizes, spec.networks)
    template = jax.eval_shape(learner.init, jax.random.key(0))
    leaves, treedef = jax.tree.flatten(template)
    stored = [arrays[f"state{i:04d}"] for i in range(sum(name.startswith("state") for name in arrays))]
    if [(x.shape, x.dtype) for x in stored] != [(x.shape, x.dtype) for x in leaves]:
        raise ValueError(f"it does not hold what learner {spec.learner!r} with networks {spec.networks!r} needs")
    return LearnerPolicy(learner, jax.tree.unflatten(treedef, [jnp.asarray(x) for x in stored]), spec.hparams, sizes)
