"""Fields of MuJoCo's MjData: the state `Data`, the ones that a simulation can return, and the functions that fill them."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import DATA_FIELDS

from mjx_dher.envs.engines import check_shape
from mjx_dher.lookup import check_name
from mjx_dher.types import Array

# Fields that mj_step and mj_forward do not fill, and the functions that do.
LATE: dict[str, Callable[[mujoco.MjModel, mujoco.MjData], Any]] = {
    **dict.fromkeys(("cacc", "cfrc_int", "cfrc_ext"), mujoco.mj_rnePostConstraint),
    **dict.fromkeys(("subtree_linvel", "subtree_angmom"), mujoco.mj_subtreeVel),
}
_WORKING_MEMORY = (
    *("qDeriv", "qLU", "qH", "qHDiagInv", "flexedge_hessian", "flex_hessian_valid", "flexvert_hessian", "flexvert_lambda"),
    *("flexvert_length", "flexvert_conage", "wrap_obj", "wrap_xpos", "solver_niter", "solver_nnz", "bvh_active"),
)
REJECTED = {
    **dict.fromkeys(("qfrc_inverse", "solver_fwdinv"), "only mj_inverse computes it"),
    **dict.fromkeys(("plugin", "plugin_data"), "it has addresses of memory"),
    **dict.fromkeys(_WORKING_MEMORY, "it is MuJoCo's working memory, which not every timestep fills"),
}


def derived_fields(names: Sequence[str], state: Sequence[str]) -> tuple[str, ...]:
    """`names` without repetitions. Raises ValueError if a name is not a field of MjData, belongs to the `state`, or has no
    value that every timestep computes.
    """
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise ValueError(f"derived must be a list of names; got {names!r}")
    for name in names:
        if name in REJECTED:
            raise ValueError(f"derived: {name!r} cannot be returned: {REJECTED[name]}")
        check_name("derived", name, sorted(set(DATA_FIELDS) - set(state) - set(REJECTED)))
    return tuple(dict.fromkeys(names))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Names and shapes of the fields of a `Data`, in the order in which its row has them."""

    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    derived: tuple[str, ...]

    @functools.cached_property
    def places(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        """Places in the row and shapes, for each name."""
        ends = np.cumsum([0, *(math.prod(shape) for _, shape in self.shapes)]).tolist()
        return {name: (slice(*between), shape) for (name, shape), *between in zip(self.shapes, ends, ends[1:])}

    @functools.cached_property
    def size(self) -> int:
        return sum(math.prod(shape) for _, shape in self.shapes)


@jax.tree_util.register_pytree_node_class
class Data:
    """Complete state of one simulation, in MuJoCo's layout and with MuJoCo's names, float32.

    It is a whole `mjSTATE_INTEGRATION`, so nothing else influences a step. Fields that a model does not use are empty. Use
    `data.replace(ctrl=...)` to set a field. A batch has further axes in front. As a pytree, it is one array of all numbers.
    """

    time: Array  # [] s; `residue` has the digits that float32 omits
    qpos: Array  # [nq]
    qvel: Array  # [nv]
    act: Array  # [na]
    history: Array  # [nhistory] of delayed actuators and sensors
    qacc_warmstart: Array  # [nv]
    ctrl: Array  # [nu]
    qfrc_applied: Array  # [nv]
    xfrc_applied: Array  # [nbody, 6]
    eq_active: Array  # [neq] 1 or 0
    mocap_pos: Array  # [nmocap, 3]
    mocap_quat: Array  # [nmocap, 4]
    userdata: Array  # [nuserdata]
    plugin_state: Array  # [npluginstate]
    residue: Array  # [2, 1 + nhistory] digits of `time` and `history` that float32 omits; 0 if you set those
    factors: Array  # [number of `varied`] by which the model's numbers are multiplied

    def __init__(self, row: Any, layout: Layout):
        self.row, self.layout = row, layout

    @property
    def derived(self) -> dict[str, Array]:
        """The requested fields of MjData, with their shapes."""
        return {name: self._field(name) for name in self.layout.derived}

    def replace(self, **fields: Any) -> Self:
        """The state with other values of some fields.

        Raises:
          ValueError: there is no such field, or a value does not have its shape.
        """
        row, places = self.row, self.layout.places
        xp = np if all(isinstance(value, (np.ndarray, np.generic, float, int)) for value in (row, *fields.values())) else jnp
        row = xp.array(row, np.float32)
        for name, given in fields.items():
            if name not in places or name in self.layout.derived:
                check_name("field", name, [each for each in places if each not in self.layout.derived])
            place, shape = places[name]
            value = xp.asarray(given, np.float32)
            check_shape(name, value, (*row.shape[:-1], *shape))
            flat = value.reshape((*row.shape[:-1], math.prod(shape)))
            if xp is np:
                row[..., place] = flat
            else:
                row = row.at[..., place].set(flat)
        return type(self)(row, self.layout)

    def _field(self, name: str) -> Any:
        place, shape = self.layout.places[name]
        return self.row[..., place].reshape((*self.row.shape[:-1], *shape))

    def __getattr__(self, name: str) -> Any:
        if name in STATE or name in ("residue", "factors"):
            return self._field(name)
        raise AttributeError(f"{type(self).__name__} has no field {name!r}")

    def __repr__(self) -> str:
        return f"Data({', '.join(f'{name}={self._field(name)}' for name in self.layout.places)})"

    def tree_flatten(self) -> tuple[tuple[Any], Layout]:
        return (self.row,), self.layout

    @classmethod
    def tree_unflatten(cls, layout: Layout, children: tuple[Any]) -> Self:
        return cls(*children, layout)


# Fields of MuJoCo's state, in its order.
STATE = tuple(name for name in Data.__annotations__ if name not in ("residue", "factors"))
