"""The memory of a number of environments on a device, and the launch that advances them."""

from typing import Any

import mujoco
import numpy as np

from mjx_dher.envs.engines.fused import kernel, setup
from mjx_dher.host.warp_setup import wp

LANES = 32  # threads that share an environment
ROWS = 96  # of constraints that an environment has room for
# Most iterations of Newton's method and of its line search: an environment takes three where contacts change, one otherwise.
ITERATIONS, LS_ITERATIONS = 50, 20


class FusedSimulation:
    """Environments that the fused kernel advances.

    Args:
      model: a model that `unsupported` finds nothing in; its options have the most iterations of Newton's method and of its
        line search.
      num_envs: number of environments.
      substeps: timesteps an environment step.
      rows: of constraints that there is room for.
      lanes: threads that share an environment, a power of 2 up to 32; 1 on a CPU.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, lanes: int = LANES, rows: int = ROWS):
        bodies, dofs, contacts = setup.bodies_of(model), setup.dofs_of(model), setup.contacts_of(model)
        world = setup.world_of(model, contacts, rows)
        self.layout = setup.layout_of(model, world, contacts, dofs)
        cpu = wp.get_device().is_cpu
        self.lanes = 1 if cpu else lanes
        self._block = 1 if cpu else 32
        self.memory = wp.zeros((num_envs if cpu else 1, self.layout.size if cpu else 1), dtype=float)
        self._kernel = kernel_of(self.layout.size, self.lanes, model.nv)
        self._kept = (world, bodies, dofs, contacts, self.layout, self.memory)
        self._lost = wp.zeros(1, dtype=int)
        self._substeps, self._num_envs = substeps, num_envs

    def advance(self, state: tuple[Any, Any, Any], inputs: Any, result: tuple[Any, Any, Any]) -> None:
        wp.launch(
            self._kernel,
            dim=(self._num_envs, self.lanes),
            inputs=[*self._kept, self._substeps, self._lost, inputs, *state],
            outputs=list(result),
            block_dim=self._block,
        )

    def overflow(self) -> int:
        """Returns how many contacts were left out since the last call, because there was no room for their rows."""
        lost = int(self._lost.numpy()[0])
        if lost:
            self._lost.zero_()
        return lost


def kernel_of(size: int, lanes: int, nv: int) -> Any:
    """Returns the kernel for environments of `size` floats, as many in a block as share a warp, or one."""
    return kernel.make(0 if wp.get_device().is_cpu else size * max(1, 32 // lanes), lanes, nv)


def capacities(model: mujoco.MjModel) -> tuple[int, int]:
    """Returns the most contacts, and rows of constraints, that an environment can have."""
    contacts = setup.contacts_of(model)
    return contacts.slots, setup.world_of(model, contacts, 10**6).rows


def load(model: mujoco.MjModel, rows: int) -> None:
    """Compiles the kernel for the current device, or takes it from Warp's cache."""
    simulation = FusedSimulation(model, 1, 1, rows=rows)
    simulation._kernel.module.load(wp.get_device(), simulation._block)


# Model features by name -> whether a model has them.
_DISABLED = int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # the flag of the older algorithm for convex shapes, which this one has
_KNOWN_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)


def unsupported(model: mujoco.MjModel) -> list[str]:
    """Returns the names of the features of the model that the fused kernel leaves out."""
    opt, scalar = model.opt, np.isin(model.jnt_type, [int(joint) for joint in _KNOWN_JOINTS[:2]])
    features = {
        "an integrator other than Euler": opt.integrator != mujoco.mjtIntegrator.mjINT_EULER,
        "elliptic friction cones": opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "options disabled or enabled": opt.disableflags & ~_DISABLED or opt.enableflags,
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
        "more than 31 degrees of freedom": model.nv > 31,
        "other constraints than one weld of a mocap body": not _has_plain_weld(model),
        "actuators other than on joints, affine and without a state": not _has_plain_actuators(model),
        **_contact_features(model),
    }
    return [name for name, present in features.items() if present]


def _has_plain_weld(model: mujoco.MjModel) -> bool:
    """Returns whether the one equality constraint is a weld of the one mocap body to another body, their frames together."""
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
        and not model.opt.disableflags & _DISABLED,
        "contacts with rolling friction": np.any(model.pair_dim > 4),
        "contacts with a gap or adhesion": np.any(model.pair_gap) or np.any(model.pair_adhesion),
    }
