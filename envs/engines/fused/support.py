"""What the fused kernel leaves out: every field of a model is read by the kernel, without effect, or at its default."""

import re
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_dher.envs.engines.features import beyond_defaults, with_names
from mjx_dher.envs.engines.fused import setup

# Fields of MjModel that `setup` reads, with restrictions below.
_READ = re.compile(
    "|".join(
        [
            r"actuator_(biasprm|biastype|ctrllimited|ctrlrange|forcelimited|forcerange|gainprm|gear|trnid)",
            r"body_(dofnum|inertia|invweight0|ipos|iquat|jntadr|jntnum|mass|mocapid|parentid|pos|quat|rootid)",
            r"dof_(armature|bodyid|damping|invweight0|jntid)|eq_(data|obj1id|obj2id|solimp|solref)",
            r"geom_(bodyid|pos|quat|rbound|size|type)|nbody|nq|nu|nv|qpos0|qpos_spring",
            r"jnt_(axis|dofadr|limited|margin|pos|qposadr|range|solimp|solref|stiffness|type)",
            r"opt\.(disableflags|gravity|impratio|iterations|ls_iterations|timestep|tolerance)",
            r"pair_(dim|friction|geom1|geom2|margin|solimp|solref)",
        ]
    )
)
# Fields without an effect on the motion of such a model, as regular expressions.
_WITHOUT_EFFECT = re.compile(
    "|".join(
        [
            # What is seen, named or read alone; and sizes, except those of features that are left out.
            r"(cam|light|mat|mesh|tex|text|tuple|numeric|key|skin|hfield|name|bvh|oct|sensor|site|exclude)_.*",
            r".*_(user|group|rgba|matid)|names|names_map|paths|signature|stat|vis",
            r"n(?!tendon$|flex$|plugin$|history$|a$)[a-zA-Z0-9]+(_\w+)?",
            # What follows from other fields, or is empty without tendons, flexes and plugins.
            r"(ten|tendon|wrap|flex\w*|plugin|efm0|efmC|tree)_.*|plugin",
            r"[BDM]_\w+|map\w+|dof_(M0|Madr|length|parentid|simplenum|treeid)|jnt_(bodyid|actuatorid)|pair_signature",
            r"body_(bvh\w+|conaffinity|contype|dofadr|geom\w+|margin|sameframe|simple|subtreemass|treeid|weldid)",
            r"geom_(aabb|sameframe|dataid)|actuator_(acc0|ctrladr|ctrlnum|ctrlspec|outadr|outnum|length0|lengthrange|historyadr)",
            # What belongs to a feature that is left out, or to contacts of geoms that no pair lists.
            r"dof_sol(imp|ref)|jnt_actfrcrange|opt\.(o_\w+|noslip_tolerance|wind)",
            r"geom_(contype|conaffinity|condim|friction|gap|margin|priority|solimp|solmix|solref)",
            r"opt\.(jacobian|ls_tolerance|magnetic|sleep_tolerance|sdf_\w+|ccd_\w+)",
        ]
    )
)
_OLDER_CCD = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # the flag of the older algorithm for convex shapes, which this one has
_KNOWN_FLAGS = _OLDER_CCD | int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # the solver has no islands
_HINGE, _SLIDE, _FREE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("HINGE", "SLIDE", "FREE"))


def unsupported(model: mujoco.MjModel) -> list[str]:
    """Features of the model that the fused kernel does not support, with names of the elements that have them."""
    return list(dict.fromkeys([*beyond_defaults(model, has_default), *_restrictions(model), *_contact_restrictions(model)]))


def is_read(name: str) -> bool:
    """Whether the kernel reads a field."""
    return bool(_READ.fullmatch(name))


def has_default(name: str) -> bool:
    """Whether a field must have its default, because the kernel neither reads it nor may leave it out."""
    return not is_read(name) and not _WITHOUT_EFFECT.fullmatch(name)


def _restrictions(model: mujoco.MjModel) -> Iterator[str]:
    """What the kernel leaves out of fields that it reads."""
    scalar = np.isin(model.jnt_type, (_HINGE, _SLIDE))
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = model.jnt_type[np.where(on_joint, model.actuator_trnid[:, 0], 0)] if model.njnt else on_joint
    biases = [int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)]
    features = {
        ("jnt", "ball joints"): ~scalar & (model.jnt_type != _FREE),
        ("jnt", "springs of free joints"): (model.jnt_stiffness != 0) & ~scalar,
        ("jnt", "limits of free joints"): (model.jnt_limited != 0) & ~scalar,
        ("body", "bodies with several joints"): model.body_jntnum > 1,
        ("actuator", "actuators that are not affine"): ~np.isin(model.actuator_biastype, biases),
        ("actuator", "actuators that pull backwards"): model.actuator_gear[:, 0] <= 0,
        ("actuator", "actuators of free or ball joints"): on_joint & ~np.isin(driven, (_HINGE, _SLIDE)),
    }
    for (kind, what), which in features.items():
        if which.any():
            yield with_names(what, model, kind, np.flatnonzero(which))
    if model.opt.disableflags & ~_KNOWN_FLAGS:
        yield "options disabled"
    if model.nv > 31:
        yield "more than 31 degrees of freedom"
    if not _has_plain_weld(model):
        yield "equality constraints other than exactly one weld of a mocap body"


def _has_plain_weld(model: mujoco.MjModel) -> bool:
    """Whether the only equality constraint welds the only mocap body to another body with the same frame."""
    if model.neq != 1 or model.nmocap != 1:
        return False
    bodies = model.eq_objtype[0] == mujoco.mjtObj.mjOBJ_BODY and model.body_mocapid[model.eq_obj1id[0]] == 0
    return bool(bodies and np.allclose(model.eq_data[0, :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1]))


def _contact_restrictions(model: mujoco.MjModel) -> Iterator[str]:
    if np.any(model.geom_contype) and np.any(model.geom_conaffinity):
        yield with_names("contacts of geoms that no pair lists", model, "geom", np.flatnonzero(model.geom_contype))
    for index, ends in enumerate(zip(model.pair_geom1, model.pair_geom2)):
        kind, what = setup.pair_types(model, *ends), None
        if kind not in setup.CONTACT_KINDS:
            what = f"contacts of {kind[0].lower()} and {kind[1].lower()}"
        elif kind == ("CYLINDER", "BOX") and not model.opt.disableflags & _OLDER_CCD:
            what = "contacts of cylinders and boxes without nativeccd=disable"
        elif model.pair_dim[index] > 4:
            what = "contacts with rolling friction"
        if what:
            yield with_names(what, model, "geom", ends)
