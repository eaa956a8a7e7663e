"""Fields of MuJoCo's MjData: the ones that a simulation can return, and the functions that fill them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
from mujoco.batch import DATA_FIELDS

from mjx_dher.lookup import check_name

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
