"""Support of models by the fused kernel: it reads a field, the field has no effect, or it must have its default."""

import re
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_dher.envs.engines.features import beyond_defaults, narrow_limits, stand_alone, with_names
from mjx_dher.envs.engines.fused import setup
from mjx_dher.envs.engines.pairs import all_pairs, too_slippery, types_of

# Fields of MjModel that `setup` reads, with restrictions below.
_READ = re.compile(
    "|".join(
        [
            r"actuator_(biasprm|biastype|ctrllimited|ctrlrange|forcelimited|forcerange|gainprm|gear|trnid|trntype)",
            r"body_(inertia|invweight0|ipos|iquat|jntadr|jntnum|mass|mocapid|parentid|pos|quat|rootid)",
            r"dof_(armature|damping|frictionloss|invweight0|jntid|solimp|solref)|eq_(data|obj1id|obj2id|objtype|solimp|solref|type)",
            r"geom_(bodyid|conaffinity|condim|contype|friction|margin|pos|priority|quat|rbound|size|solimp|solmix|solref|type)",
            r"nbody|neq|nq|ntendon|nu|nv|qpos0|qpos_spring|wrap_(objid|prm|type)",
            r"jnt_(actfrclimited|actfrcrange|axis|dofadr|limited|margin|pos|qposadr|range|solimp|solref|stiffness|type)",
            r"opt\.(cone|disableflags|gravity|impratio|integrator|iterations|ls_iterations|timestep|tolerance)",
            r"pair_(dim|friction|geom1|geom2|margin|solimp|solref|solreffriction)",
            r"tendon_(actfrclimited|actfrcrange|adr|damping|frictionloss|invweight0|lengthspring|limited|margin)",
            r"tendon_(num|range|sol(imp|ref)_(fri|lim)|stiffness)",
        ]
    )
)
# Fields without an effect on the motion of such a model, as regular expressions.
_WITHOUT_EFFECT = re.compile(
    "|".join(
        [
            # Rendering, names and sensors; and sizes, except of unsupported features.
            r"(cam|light|mat|mesh|tex|text|tuple|numeric|key|skin|hfield|name|bvh|oct|sensor|site|exclude)_.*",
            r".*_(user|group|rgba|matid)|names|names_map|paths|signature|stat|vis",
            r"n(?!flex$|plugin$|history$|a$)[a-zA-Z0-9]+(_\w+)?",
            # What follows from other fields, or is empty without flexes and plugins.
            r"(ten|flex\w*|plugin|efm0|efmC|tree)_.*|plugin|tendon_(actuatorid|length0|tree\w+|width)",
            r"[BDM]_\w+|map\w+|dof_(M0|Madr|bodyid|length|parentid|simplenum|treeid)|jnt_(bodyid|actuatorid)|pair_signature",
            r"body_(bvh\w+|conaffinity|contype|dofadr|dofnum|geom\w+|margin|sameframe|simple|subtreemass|treeid|weldid)",
            r"geom_(aabb|sameframe|dataid)|actuator_(acc0|ctrladr|ctrlnum|ctrlspec|outadr|outnum|length0|lengthrange|historyadr)",
            # What belongs to a feature that is left out.
            r"(geom|pair)_gap|opt\.(o_\w+|noslip_tolerance|wind)|actuator_(act\w+|dynprm|history)",
            r"opt\.(jacobian|ls_tolerance|magnetic|sleep_tolerance|sdf_\w+|ccd_\w+)",
        ]
    )
)
_OLDER_CCD = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # the flag of the older algorithm for convex shapes, which this one has
# Flags that are read, or have no effect: the solver has no islands, and there is no middle phase.
_KNOWN_FLAGS = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    for name in ("NATIVECCD", "ISLAND", "MIDPHASE", "FILTERPARENT", "CONTACT", "GRAVITY", "EULERDAMP", "SENSOR")
)
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
    """Unsupported values of fields that the kernel reads."""
    scalar = np.isin(model.jnt_type, (_HINGE, _SLIDE))
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = model.jnt_type[np.where(on_joint, model.actuator_trnid[:, 0], 0)] if model.njnt else on_joint
    known = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_TENDON)]
    biases = [int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)]
    features = {
        ("jnt", "ball joints"): ~scalar & (model.jnt_type != _FREE),
        ("jnt", "springs of free joints"): (model.jnt_stiffness != 0) & ~scalar,
        ("jnt", "limits of free joints"): (model.jnt_limited != 0) & ~scalar,
        ("tendon", "tendons that are not fixed"): _not_fixed(model),
        ("jnt", "free bodies, with implicitfast, that have parts or are not centred on their mass"): _off_centre(model),
        ("actuator", "actuators that are not affine"): ~np.isin(model.actuator_biastype, biases),
        ("actuator", "actuators that are not on joints or tendons"): ~np.isin(model.actuator_trntype, known),
        ("actuator", "actuators of free or ball joints"): on_joint & ~np.isin(driven, (_HINGE, _SLIDE)),
    }
    for (kind, what), which in features.items():
        if which.any():
            yield with_names(what, model, kind, np.flatnonzero(which))
    yield from narrow_limits(model)
    if model.opt.integrator not in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        yield "an integrator other than Euler and implicitfast"
    if model.opt.disableflags & ~_KNOWN_FLAGS:
        unknown = model.opt.disableflags & ~_KNOWN_FLAGS
        bits = {name.removeprefix("mjDSBL_"): int(bit) for name, bit in mujoco.mjtDisableBit.__members__.items() if "_" in name}
        yield f"options disabled ({', '.join(name.lower() for name, bit in bits.items() if unknown & bit)})"
    if not 0 < model.nv <= 31:
        yield "no degrees of freedom, or more than 31"
    others = [eq for eq in range(model.neq) if not _is_known(model, eq)]
    if others:
        yield with_names("equality constraints other than of joints, fixed tendons and bodies", model, "eq", others)


def _not_fixed(model: mujoco.MjModel) -> np.ndarray:
    """Tendons [ntendon] that are not sums of joints."""
    first = model.wrap_type[model.tendon_adr] if model.ntendon else np.zeros(0, int)
    return first != int(mujoco.mjtWrap.mjWRAP_JOINT)


def _off_centre(model: mujoco.MjModel) -> np.ndarray:
    """Free joints [njnt] for which the kernel leaves out what implicitfast does with gyroscopic forces."""
    body = model.jnt_bodyid
    parts = np.array([np.count_nonzero(model.body_rootid == each) > 1 for each in body], bool)
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return stand_alone(model) & implicit & (parts | np.any(model.body_ipos[body] != 0, axis=1))


def _is_known(model: mujoco.MjModel, eq: int) -> bool:
    """Whether an equality constraint is of joints, tendons or connected bodies, or welds a body to a mocap body's frame."""
    kind, of_bodies = int(model.eq_type[eq]), model.eq_objtype[eq] == mujoco.mjtObj.mjOBJ_BODY
    same_frame = np.allclose(model.eq_data[eq, :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1])
    plain_weld = same_frame and model.body_mocapid[model.eq_obj1id[eq]] >= 0
    return kind in (setup.JOINT, setup.TENDON) or bool(
        of_bodies and (kind == setup.CONNECT or (kind == setup.WELD and plain_weld))
    )


def _contact_restrictions(model: mujoco.MjModel) -> Iterator[str]:
    pairs = all_pairs(model)
    geoms: dict[str, dict[int, None]] = {}
    for ends in zip(pairs.geom1, pairs.geom2):
        kind, what = types_of(model, *ends), None
        if kind not in setup.CONTACT_KINDS:
            what = f"contacts of {kind[0].lower()} and {kind[1].lower()}"
        elif kind == ("CYLINDER", "BOX") and not model.opt.disableflags & _OLDER_CCD:
            what = "contacts of cylinders and boxes without nativeccd=disable"
        elif model.opt.disableflags & _OLDER_CCD and kind in setup.BY_GENERAL_SOLVER:
            what = f"contacts of {kind[0].lower()} and {kind[1].lower()} with nativeccd=disable"
        elif kind == ("CYLINDER", "BOX") and (model.pair_gap.any() or model.geom_gap[list(ends)].any()):
            what = "gaps of cylinders and boxes"
        if what:
            geoms.setdefault(what, {}).update(dict.fromkeys(ends))
    for what, these in geoms.items():
        yield with_names(what, model, "geom", these)
    yield from too_slippery(model, "warp")
