"""Environments on a device: their memory, and the launch that advances them."""

from typing import Any

import mujoco
import numpy as np

from mjx_dher.envs.engines.fused import kernel, setup
from mjx_dher.system.warp_setup import load, wp

# Threads that share an environment, and the most warps of 32 threads that a block has. Measured on an H100 (docs/design.md).
THREADS, WARPS = 16, 8
# Most iterations of Newton's method and of its line search: an environment takes three where contacts change, one otherwise.
ITERATIONS, LS_ITERATIONS = 50, 20


class Simulation:
    """Environments that the fused kernel advances, on Warp's current device.

    Args:
      model: a model for which `unsupported` is empty; its options limit the iterations of Newton's method and its line search.
      num_envs: number of environments.
      substeps: timesteps an environment step.
      rows: constraint rows that fit into memory; more than can occur are not allocated.

    Raises:
      ValueError: the device's shared memory does not suffice.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, rows: int = 10**6):
        bodies, dofs, contacts = setup.bodies_of(model), setup.dofs_of(model), setup.contacts_of(model)
        world = setup.world_of(model, contacts, rows)
        layout = setup.layout_of(model, world, contacts, dofs)
        device = wp.get_device()
        self._threads = 1 if device.is_cpu else THREADS
        warps = 0 if device.is_cpu else most_warps(layout.size, device.max_shared_memory_per_block)
        self._block = max(1, 32 * warps)
        kinds = tuple(sorted({*map(int, contacts.kind.numpy())}))
        self._kernel = kernel.make(layout.size, self._threads, warps, model.nv, kinds)
        memory = wp.zeros((num_envs, layout.size) if device.is_cpu else (1, 1), dtype=float)
        self._kept = (world, bodies, dofs, contacts, layout, memory)
        self._lost = wp.zeros(1, dtype=int)
        self._substeps, self._num_envs = substeps, num_envs

    def load(self) -> None:
        """Compiles the kernel, or takes it from Warp's cache."""
        load(self._kernel.module, self._block)

    def advance(self, state: tuple[Any, Any, Any], inputs: Any, result: tuple[Any, Any, Any]) -> None:
        """Advances coordinates, velocities and the solver's first guess by one environment step."""
        wp.launch(
            self._kernel,
            dim=(self._num_envs, self._threads),
            inputs=[*self._kept, self._substeps, self._lost, inputs, *state],
            outputs=list(result),
            block_dim=self._block,
        )

    def overflow(self) -> int:
        """Number of contacts since the last call that were left out because their rows did not fit."""
        lost = int(self._lost.numpy()[0])
        if lost:
            self._lost.zero_()
        return lost


def most_warps(size: int, shared: int) -> int:
    """Number of warps of a block, if an environment takes `size` floats and a block has `shared` bytes.

    Raises:
      ValueError: not even one warp fits.
    """
    a_warp = 4 * size * (32 // THREADS)
    if a_warp > shared:
        raise ValueError(
            f"the warp engine needs {a_warp:,} bytes of a GPU's shared memory and has {shared:,}; fewer constraints take less"
        )
    return min(WARPS, shared // a_warp)


def most_rows(model: mujoco.MjModel) -> int:
    """The most constraint rows that an environment can have."""
    return int(setup.world_of(model, setup.contacts_of(model), 10**6).rows)


# Model features by name -> whether a model has them.
_OLDER_CCD = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # the flag of the older algorithm for convex shapes, which this one has
_KNOWN_FLAGS = _OLDER_CCD | int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # the solver has no islands
_KNOWN_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)


def unsupported(model: mujoco.MjModel) -> list[str]:
    """Names of the model's features that the fused kernel does not support."""
    opt, scalar = model.opt, np.isin(model.jnt_type, [int(joint) for joint in _KNOWN_JOINTS[:2]])
    features = {
        "an integrator other than Euler": opt.integrator != mujoco.mjtIntegrator.mjINT_EULER,
        "elliptic friction cones": opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "options disabled or enabled": opt.disableflags & ~_KNOWN_FLAGS or opt.enableflags,
        "tendons": model.ntendon,
        "flexes": model.nflex,
        "sensors": model.nsensor,
        "plugins": model.nplugin,
        "a medium": opt.density or opt.viscosity or np.any(opt.wind),
        "gravity compensation": np.any(model.body_gravcomp),
        "ball joints": not np.all(np.isin(model.jnt_type, [int(joint) for joint in _KNOWN_JOINTS])),
        "bodies with several joints": np.any(model.body_jntnum > 1),
        "springs of free joints": np.any(model.jnt_stiffness[~scalar]),
        "springs or damping that are not linear": np.any(model.jnt_stiffnesspoly) or np.any(model.dof_dampingpoly),
        "friction in joints": np.any(model.dof_frictionloss),
        "limits of free joints": np.any(model.jnt_limited[~scalar]),
        "limits of joint torques": np.any(model.jnt_actfrclimited),
        "delays": model.nhistory,
        "noslip iterations": opt.noslip_iterations,
        "more than 31 degrees of freedom": model.nv > 31,
        "equality constraints other than exactly one weld of a mocap body": not _has_plain_weld(model),
        "actuators other than on joints, affine and without a state": not _has_plain_actuators(model),
        **_contact_features(model),
    }
    return [name for name, present in features.items() if present]


def _has_plain_weld(model: mujoco.MjModel) -> bool:
    """Whether the only equality constraint welds the only mocap body to another body with the same frame."""
    if model.neq != 1 or model.nmocap != 1 or model.eq_type[0] != mujoco.mjtEq.mjEQ_WELD or not model.eq_active0[0]:
        return False
    bodies = model.eq_objtype[0] == mujoco.mjtObj.mjOBJ_BODY and model.body_mocapid[model.eq_obj1id[0]] == 0
    return bool(bodies and np.allclose(model.eq_data[0, :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1]))


def _has_plain_actuators(model: mujoco.MjModel) -> bool:
    joints = model.actuator_trnid[:, 0]
    return bool(
        np.all(model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
        and np.all(np.isin(model.jnt_type[joints], [int(joint) for joint in _KNOWN_JOINTS[:2]]))
        and np.all(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
        and np.all(np.isin(model.actuator_biastype, [int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)]))
        and np.all(model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE))
        and np.all(model.actuator_gear[:, 0] > 0)
    )


def _contact_features(model: mujoco.MjModel) -> dict[str, Any]:
    kinds = [setup.pair_types(model, *pair) for pair in zip(model.pair_geom1, model.pair_geom2)]
    return {
        "contacts of geoms that no pair lists": np.any(model.geom_contype) and np.any(model.geom_conaffinity),
        "contacts other than of boxes and cylinders with boxes and planes": set(kinds) - set(setup.CONTACT_KINDS),
        "contacts of cylinders and boxes without nativeccd=disable": ("CYLINDER", "BOX") in kinds
        and not model.opt.disableflags & _OLDER_CCD,
        "contacts with rolling friction": np.any(model.pair_dim > 4),
        "contacts with a gap or adhesion": np.any(model.pair_gap) or np.any(model.pair_adhesion),
    }
