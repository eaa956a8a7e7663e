"""Converts a MuJoCo model to the structs of the fused substep."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_dher.envs.engines.fused import model as kinds
from mjx_dher.envs.engines.fused.model import Bodies, Contacts, Dofs, Softness, Tendons, World
from mjx_dher.envs.engines.pairs import all_pairs, edges_of, frictions, types_of
from mjx_dher.system.warp_setup import wp

_MOST = {"PLANE_BOX": 4, "PLANE_CYLINDER": 4, "BOX_BOX": 8, "CYLINDER_BOX": 5, "PLANE_CAPSULE": 2}
_MOST |= {"CAPSULE_CAPSULE": 2, "CAPSULE_BOX": 2, "CAPSULE_CYLINDER": 2}
_MOST |= dict.fromkeys(("PLANE_SPHERE", "SPHERE_SPHERE", "SPHERE_CAPSULE", "SPHERE_BOX", "SPHERE_CYLINDER"), 1)
_MOST |= dict.fromkeys(("PLANE_ELLIPSOID", "SPHERE_ELLIPSOID", "CAPSULE_ELLIPSOID", "ELLIPSOID_BOX"), 1)
# Types of two geoms -> (kind, most contacts).
CONTACT_KINDS = {(*name.split("_"),): (int(getattr(kinds, name)), most) for name, most in _MOST.items()}
# Pairs for which MuJoCo C runs its general convex solver, unless it is the older one of `nativeccd="disable"`.
BY_GENERAL_SOLVER = [("SPHERE", "ELLIPSOID"), ("CAPSULE", "ELLIPSOID"), ("ELLIPSOID", "BOX"), ("CAPSULE", "CYLINDER")]
FEW = 64  # contacts of all pairs, up to which there is memory for all of them
_NEAR, _NEAR_SLOTS = 64, 192  # pairs that may be near at once in other models, and slots for their contacts
CONNECT, WELD, JOINT, TENDON = (int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in ("CONNECT", "WELD", "JOINT", "TENDON"))
_JOINTS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): kinds.HINGE,
    int(mujoco.mjtJoint.mjJNT_SLIDE): kinds.SLIDE,
    int(mujoco.mjtJoint.mjJNT_FREE): kinds.FREE,
}


def fill(struct: Any, **values: Any) -> Any:
    """Makes a struct: array fields are converted to Warp arrays."""
    made = struct()
    for name, value in values.items():
        field = struct.vars[name].type
        setattr(made, name, _array(value, field.dtype) if isinstance(field, wp.array) else value)
    return made


def _array(value: Any, dtype: Any) -> Any:
    rows = np.asarray(value, np.int32 if dtype in (int, wp.int32) else np.float32)
    if dtype not in (int, float, wp.int32, wp.float32):
        rows = rows.reshape(-1, *dtype._shape_)
    return wp.array(rows, dtype=dtype)


def _matrices(quats: np.ndarray) -> np.ndarray:
    """Returns rotation matrices [n, 3, 3] of quaternions [n, 4]."""
    matrices = np.zeros((len(quats), 9))
    for row, quat in zip(matrices, quats):
        mujoco.mju_quat2Mat(row, quat)
    return matrices.reshape(-1, 3, 3)


def softness(model: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> Any:
    """Returns k, b and the impedance's five numbers, from a constraint's solref and solimp."""
    least, most, width, middle, power = solimp
    least, most, middle = (float(np.clip(x, 1e-4, 0.9999)) for x in (least, most, middle))
    k, b = -solref[0] / most**2, -solref[1] / most
    if solref[0] > 0:
        time = max(solref[0], 2 * model.opt.timestep)
        k, b = 1 / (most * time * solref[1]) ** 2, 2 / (most * time)
    return Softness(k, b, least, most, width, middle, max(power, 1.0))


class _Links(NamedTuple):
    """Bodies of the kernel, which have one joint at most: a body with several joints has massless ones before it."""

    body: np.ndarray  # [n] the model's body
    joint: np.ndarray  # [n] its joint, or -1
    first: np.ndarray  # [nbody] the first link of each body
    last: np.ndarray  # [nbody] the last one, which has the mass and the geoms


def links_of(model: mujoco.MjModel) -> _Links:
    """Returns the links of a model."""
    number = np.maximum(model.body_jntnum, 1)
    last = np.cumsum(number) - 1
    body = np.repeat(np.arange(model.nbody), number)
    first = last - number + 1
    joint = np.where(model.body_jntnum[body] > 0, model.body_jntadr[body] + np.arange(len(body)) - first[body], -1)
    return _Links(body, joint, first, last)


def _joints_of(model: mujoco.MjModel, links: _Links, parent: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of `Bodies` that describe joints."""
    number = len(links.body)
    kind, qpos, dof, moved_by = (np.zeros(number, np.int32) for _ in range(4))
    axis, anchor, rest = np.zeros((number, 3)), np.zeros((number, 3)), np.zeros(number)
    for link, (body, joint) in enumerate(zip(links.body, links.joint)):
        moved_by[link] = moved_by[parent[link]]
        if model.body_mocapid[body] >= 0:
            kind[link], dof[link] = kinds.MOCAP, model.body_mocapid[body]
        if joint >= 0:
            kind[link] = _JOINTS[int(model.jnt_type[joint])]
            qpos[link], dof[link] = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            axis[link], anchor[link], rest[link] = model.jnt_axis[joint], model.jnt_pos[joint], model.qpos0[qpos[link]]
            for i in range(dof[link], dof[link] + (6 if kind[link] == kinds.FREE else 1)):
                moved_by[link] |= 1 << i
    return {"kind": kind, "qpos": qpos, "dof": dof, "moved_by": moved_by, "axis": axis, "anchor": anchor, "rest": rest}


def _last_below(parent: np.ndarray) -> np.ndarray:
    """Last descendant [n] int32 of each link: MuJoCo numbers depth first, so b's subtree is b to last_below[b]."""
    last = np.arange(len(parent), dtype=np.int32)
    for link in range(len(parent) - 1, 0, -1):
        last[parent[link]] = max(last[parent[link]], last[link])
    return last


def bodies_of(model: mujoco.MjModel) -> Any:
    """Returns `Bodies` of a model."""
    links = links_of(model)
    body, number = links.body, np.arange(len(links.body))
    begins, ends = links.first[body] == number, links.last[body] == number
    parent = np.where(begins, links.last[model.body_parentid[body]], number - 1)
    parent[0] = 0
    return fill(
        Bodies,
        number=len(body),
        parent=parent,
        root=links.first[model.body_rootid[body]],
        last=_last_below(parent),
        pos=model.body_pos[body] * begins[:, None],
        quat=np.where(begins[:, None], model.body_quat[body], [1.0, 0.0, 0.0, 0.0]),
        com=model.body_ipos[body],
        principal=_matrices(model.body_iquat[body]),
        mass=model.body_mass[body] * ends,
        inertia=model.body_inertia[body] * ends[:, None],
        **_joints_of(model, links, parent),
    )


def is_sparse(model: mujoco.MjModel) -> bool:
    """Whether the model has rows of `Sparse`. Limits of joints are then among them."""
    return bool(np.any(model.dof_frictionloss > 0) or model.ntendon or np.any(model.eq_type >= JOINT))


def _tendons_of(model: mujoco.MjModel) -> Any:
    """Returns `Tendons` of a model: those with a spring, a damper or an actuator."""
    on_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    driven = model.actuator_trnid[on_tendon, 0]
    pulls = (model.tendon_stiffness != 0) | (model.tendon_damping != 0) | np.isin(np.arange(model.ntendon), driven)
    which = np.flatnonzero(pulls)
    terms = [term for each in which for term in range(model.tendon_adr[each], model.tendon_adr[each] + model.tendon_num[each])]
    joint, tendon = model.wrap_objid[terms], np.repeat(np.arange(len(which)), model.tendon_num[which])
    actuator = np.full(model.nu, -1)
    actuator[on_tendon] = np.searchsorted(which, driven)
    return fill(
        Tendons,
        number=len(which),
        terms=len(terms),
        tendon=tendon,
        begin=np.searchsorted(tendon, np.arange(len(which) + 1)),
        dof=model.jnt_dofadr[joint],
        qpos=model.jnt_qposadr[joint],
        coef=model.wrap_prm[terms],
        stiffness=model.tendon_stiffness[which],
        damping=model.tendon_damping[which],
        spring=model.tendon_lengthspring[which],
        drive=np.where(model.tendon_actfrclimited[which, None], model.tendon_actfrcrange[which], [-np.inf, np.inf]),
        actuator_tendon=actuator,
    )


def actuator_force(model: mujoco.MjModel, gain: Any, bias: Any, xp: Any) -> Any:
    """`Dofs.actuator_force` of actuators with these gains and biases, by `xp`: NumPy or jax.numpy."""
    gear = model.actuator_gear[:, 0]
    return xp.stack([gear * bias[:, 0], gear**2 * bias[:, 1], gear**2 * bias[:, 2], gear * gain[:, 0]], axis=1)


def damps_implicitly(model: mujoco.MjModel) -> bool:
    """Whether the integrator is implicit in damping."""
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return bool(implicit or not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP))


def dofs_of(model: mujoco.MjModel) -> Any:
    """Returns `Dofs` of a model."""
    joints = model.dof_jntid
    scalar = np.isin(model.jnt_type[joints], [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
    qpos = np.where(scalar, model.jnt_qposadr[joints], 0)
    limited = np.flatnonzero(model.jnt_limited if not is_sparse(model) else [])
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = np.where(on_joint, model.actuator_trnid[:, 0], 0)
    gear = model.actuator_gear[:, 0]
    everything = np.array([-np.inf, np.inf])
    links = links_of(model)
    link_of_joint = np.flatnonzero(links.joint >= 0)  # in the order of joints
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    drive = np.where(model.jnt_actfrclimited[joints, None], model.jnt_actfrcrange[joints], everything)
    return fill(
        Dofs,
        number=model.nv,
        body=link_of_joint[joints],
        armature=model.dof_armature,
        damping=model.dof_damping,
        implicit_damping=model.dof_damping * damps_implicitly(model),
        implicit=int(implicit),
        drive=drive,
        first_control=7 * model.nmocap,
        stiffness=np.where(scalar, model.jnt_stiffness[joints], 0),
        qpos=qpos,
        rest=model.qpos_spring[qpos],
        limits=len(limited),
        limit_dof=model.jnt_dofadr[limited],
        limit_range=model.jnt_range[limited],
        limit_margin=model.jnt_margin[limited],
        limit_soft=[softness(model, *soft) for soft in zip(model.jnt_solref[limited], model.jnt_solimp[limited])],
        limit_weight=model.dof_invweight0[model.jnt_dofadr[limited]],
        actuators=model.nu,
        actuator_dof=np.where(on_joint, model.jnt_dofadr[driven], -1),
        actuator_qpos=model.jnt_qposadr[driven],
        tendons=_tendons_of(model),
        actuator_force=actuator_force(model, model.actuator_gainprm, model.actuator_biasprm, np),
        actuator_clip=np.concatenate(
            [
                np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, everything),
                np.where(
                    model.actuator_forcelimited[:, None], np.sort(model.actuator_forcerange * gear[:, None], axis=1), everything
                ),
            ],
            axis=1,
        ),
    )


def contacts_of(model: mujoco.MjModel, rows: int = 10**6) -> Any:
    """Returns `Contacts` of a model: the pairs that it lists, and those that meet by contype and conaffinity.

    Args:
      rows: constraint rows that fit into memory. If not all do, there is memory for a third as many contacts as rows,
        unless the model has `FEW`.
    """
    pairs = all_pairs(model)
    geom1, geom2 = pairs.geom1.copy(), pairs.geom2.copy()
    swap = model.geom_type[geom1] > model.geom_type[geom2]
    geom1[swap], geom2[swap] = geom2[swap], geom1[swap]
    kinds_most = [CONTACT_KINDS[types_of(model, *pair)] for pair in zip(geom1, geom2)]
    kind, most = np.array(kinds_most, np.int32).reshape(-1, 2).T
    slots = int(most.sum())
    elliptic, edges = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC, edges_of(model, pairs.dim)
    few, all_fit = slots <= FEW, rows >= int((most * edges).sum())
    slips = np.where(pairs.solreffriction.any(axis=1, keepdims=True), pairs.solreffriction, pairs.solref)
    return fill(
        Contacts,
        geom_body=links_of(model).last[model.geom_bodyid],
        geom_pos=model.geom_pos,
        geom_mat=_matrices(model.geom_quat),
        geom_size=model.geom_size,
        geom_reach=model.geom_rbound,
        geom_half=_halves(model),
        pairs=len(kind),
        geom1=geom1,
        geom2=geom2,
        kind=kind,
        first=np.cumsum(most) - most,
        most=most,
        margin=pairs.margin,
        dim=pairs.dim,
        edges=edges,
        **frictions(model, pairs, pairs.friction, np),
        soft=[softness(model, *soft) for soft in zip(pairs.solref, pairs.solimp)],
        slots=slots if few or all_fit else min(slots, max(1, rows // 3)),
        slip=[softness(model, *soft)[1] for soft in zip(slips, pairs.solimp)],
        elliptic=int(elliptic),
        pair=np.repeat(np.arange(len(kind)), most),
        rounds=2,
        near=0 if few else len(kind) if all_fit else min(len(kind), _NEAR),
        near_slots=0 if few else slots if all_fit else min(slots, _NEAR_SLOTS),
    )


def _halves(model: mujoco.MjModel) -> np.ndarray:
    """Half lengths [ngeom, 3] of boxes around geoms. The values of planes are not used."""
    radius, half, _ = model.geom_size.T
    along = {"SPHERE": radius, "CAPSULE": radius + half, "CYLINDER": half}
    halves = model.geom_size.copy()
    for name, length in along.items():
        which = model.geom_type == int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
        halves[which] = np.stack([radius, radius, length], axis=1)[which]
    return halves


def other_rows(model: mujoco.MjModel) -> int:
    """The most rows of `Memory.jacobian` that are not of contacts."""
    equal = 6 * np.count_nonzero(model.eq_type == WELD) + 3 * np.count_nonzero(model.eq_type == CONNECT)
    return int(equal) + (0 if is_sparse(model) else int(np.count_nonzero(model.jnt_limited)))


def _equalities_of(model: mujoco.MjModel, links: _Links) -> dict[str, Any]:
    """The fields of `World` that describe welds and connected bodies."""
    welds, connects = np.flatnonzero(model.eq_type == WELD), np.flatnonzero(model.eq_type == CONNECT)
    first, second = model.eq_obj1id, model.eq_obj2id
    inverse = [model.body_invweight0[first[each]] + model.body_invweight0[second[each]] for each in (welds, connects)]
    return {
        "equalities": 6 * len(welds) + 3 * len(connects),
        "welds": len(welds),
        "weld_body": links.last[second[welds]],
        "weld_target": links.last[first[welds]],
        "weld_soft": [softness(model, model.eq_solref[eq], model.eq_solimp[eq]) for eq in welds],
        "weld_weight": inverse[0],
        "connects": len(connects),
        "connect_body1": links.last[first[connects]],
        "connect_body2": links.last[second[connects]],
        "connect_anchor1": model.eq_data[connects, :3],
        "connect_anchor2": model.eq_data[connects, 3:6],
        "connect_soft": [softness(model, model.eq_solref[eq], model.eq_solimp[eq]) for eq in connects],
        "connect_weight": inverse[1][:, 0],
    }


def world_of(model: mujoco.MjModel, contacts: Any, most_rows: int) -> Any:
    """Returns `World` of a model, with room for up to `most_rows` rows of constraints."""
    links = links_of(model)
    edges = contacts.edges.numpy()[contacts.pair.numpy()]
    contact_rows = int(np.sort(edges)[len(edges) - contacts.slots :].sum())
    falls = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return fill(
        World,
        timestep=model.opt.timestep,
        gravity=wp.vec3(*(model.opt.gravity * falls)),
        **_equalities_of(model, links),
        rows=min(most_rows, other_rows(model) + contact_rows),
        tolerance=model.opt.tolerance,
        iterations=model.opt.iterations,
        ls_iterations=model.opt.ls_iterations,
        scale=1 / (model.stat.meaninertia * model.nv),
    )
