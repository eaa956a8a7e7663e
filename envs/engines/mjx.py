"""MuJoCo MJX, the JAX implementation, which runs on any device that JAX supports."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import io
import re
import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.arm_kinematics import quat_multiply
from mjx_dher.envs.engines import pairs
from mjx_dher.envs.engines.base import Controls, Physics, check_shapes
from mjx_dher.envs.engines.features import beyond_defaults, with_names
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.system import private_api
from mjx_dher.types import Array
from mjx_dher.validation import check_count

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a line if warp-lang is not installed
    from mujoco import mjx


# Fields of MjModel that MJX 3.17 ignores without an error.
_IGNORED = (
    *("opt.noslip_iterations", "opt.disableactuator", "actuator_armature", "actuator_damping", "actuator_dampingpoly"),
    *("actuator_actearly", "dof_dampingpoly", "jnt_stiffnesspoly", "tendon_dampingpoly", "tendon_stiffnesspoly"),
    *("geom_surfacevel", "geom_adhesion", "geom_fluid", "geom_gap", "pair_gap", "pair_adhesion"),
)


def with_stand_ins(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy of the model in which a geom called NAME_stand_in replaces one geom of each cylinder-box contact pair.

    It replaces the box NAME if the box has a stand-in, else the cylinder NAME. Some engines have no cylinder-box contacts, or
    inaccurate ones.

    Raises:
      ValueError: neither geom of a pair has a stand-in.
    """
    model = copy.copy(model)
    cylinder, box = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("CYLINDER", "BOX"))
    names = [model.geom(i).name for i in range(model.ngeom)]
    for ends, others in ((model.pair_geom1, model.pair_geom2), (model.pair_geom2, model.pair_geom1)):
        for pair in np.flatnonzero((model.geom_type[ends] == cylinder) & (model.geom_type[others] == box)):
            for side in (others, ends):
                stand_in = f"{names[side[pair]]}_stand_in"
                if stand_in in names:
                    side[pair] = names.index(stand_in)
                    break
            else:
                both = f"{names[ends[pair]]!r}, a cylinder, and {names[others[pair]]!r}, a box,"
                raise ValueError(f"geoms {both} meet; one of them needs another to stand in for it, called NAME_stand_in")
    return model


class _Weld:
    """The velocity term of a weld's acceleration, which MJX omits and MuJoCo C and Warp include.

    With the weld's residual r, MuJoCo solves for r'' = aref, where r'' = J qacc + J' qvel. MJX 3.17 drops J' qvel: an arm that
    moves at 1 m/s then pulls its gripper aside by 1 mm in half a second. Only welds between a mocap body (which counts as at
    rest) and a moving body with coinciding frames are corrected.
    """

    def __init__(self, model: mujoco.MjModel, index: int):
        self._target, self._body = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        self._root = int(model.body_rootid[self._body])
        body = self._body
        while not model.body_dofnum[body]:
            body = int(model.body_parentid[body])
        dofs = [int(model.body_dofadr[body] + model.body_dofnum[body] - 1)]
        while model.dof_parentid[dofs[-1]] >= 0:
            dofs.append(int(model.dof_parentid[dofs[-1]]))
        self._dofs = np.array(dofs)

    def bias(self, data: mjx.Data) -> Array:
        """J' qvel [6]: three rows of position in m/s^2, three of orientation in 1/s^2."""
        # Spatial vectors (angular, linear) at the centre of mass of the whole arm.
        acceleration = data.qvel[self._dofs] @ data.cdof_dot[self._dofs]
        velocity, arm = data.cvel[self._body], data.xpos[self._body] - data.subtree_com[self._root]
        omega, alpha = velocity[:3], acceleration[:3]
        at_body = velocity[3:] + jnp.cross(omega, arm)
        position = acceleration[3:] + jnp.cross(alpha, arm) + jnp.cross(omega, at_body)
        # The residual is the vector part of q^-1 p (q the body's orientation, p the target's), and q' = omega q / 2.
        inverse = data.xquat[self._body] * jnp.array([1.0, -1.0, -1.0, -1.0])
        turn = jnp.concatenate([0.25 * jnp.dot(omega, omega)[None], 0.5 * alpha])
        orientation = quat_multiply(quat_multiply(inverse, turn), data.xquat[self._target])[1:]
        return -jnp.concatenate([position, orientation])


def _welds(model: mujoco.MjModel) -> list[int | _Weld]:
    """First rows of a model's constraints in order: welds to correct, and numbers of other rows."""
    disabled = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    connect, weld = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
    if model.opt.disableflags & disabled or model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        return []

    def to_correct(index: int) -> bool:
        bodies = model.eq_objtype[index] == int(mujoco.mjtObj.mjOBJ_BODY) and model.eq_active0[index]
        plain = np.allclose(model.eq_data[index, :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1])
        if not bodies or not plain or model.body_mocapid[model.eq_obj1id[index]] < 0:
            return False
        return bool(model.body_weldid[model.eq_obj2id[index]])  # otherwise it is fixed to the world

    rows: list[int | _Weld] = [3 * int(np.count_nonzero(model.eq_type == connect))]
    rows += [_Weld(model, index) if to_correct(index) else 6 for index in np.flatnonzero(model.eq_type == weld).tolist()]
    return rows if any(isinstance(row, _Weld) for row in rows) else []


def _grow_for_margins(model: mujoco.MjModel) -> None:
    """Enlarges geoms by the margin of their contact pairs, and sets the margin to 0, if MJX would ignore it.

    A contact with a margin acts from that distance on. MJX 3.17 finds box-box and sphere-box contacts only if the geoms
    overlap. Their distance would jump by the whole margin, and a slightly tilted face would touch with fewer points. A geom
    enlarged by the margin gives the same distances and normals, except at a box's edges, which stay sharp. The geom must have
    the same margin in all its contacts. If neither geom of a pair has, a warning names the pair.
    """
    sphere, box = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_BOX)
    ends = np.stack([model.pair_geom1, model.pair_geom2], axis=1)
    types = model.geom_type[ends]
    affected = (types == box).any(axis=1) & np.isin(types, (sphere, box)).all(axis=1)
    # Spheres first: a larger sphere has the same shape.
    for geom in sorted(set(ends[affected].ravel().tolist()), key=lambda geom: int(model.geom_type[geom])):
        pairs = np.flatnonzero((ends == geom).any(axis=1))
        margin = float(model.pair_margin[pairs[0]])
        alone = not (model.geom_contype[geom] or model.geom_conaffinity[geom])  # no contacts except the pairs
        if alone and margin > 0 and affected[pairs].all() and (model.pair_margin[pairs] == margin).all():
            model.geom_size[geom] += margin
            model.pair_margin[pairs] = 0
    if (ignored := affected & (model.pair_margin > 0)).any():
        names = ", ".join(" and ".join(model.geom(geom).name for geom in pair) for pair in ends[ignored])
        warnings.warn(f"engine jax ignores the margin of contacts of boxes: {names}", stacklevel=2)


def _geoms_in(model: mujoco.MjModel, message: str) -> list[int]:
    """Geoms of the first pair whose two types an MJX error names."""
    for ends in [*pairs.meeting(model), *zip(model.pair_geom1, model.pair_geom2)]:
        if all(re.search(rf"\bmjGEOM_{pairs.type_of(model, geom)}\b", message) for geom in ends):
            return [int(geom) for geom in ends]
    return []


def _loaded(data: mjx.Data, physics: Physics, controls: Controls) -> mjx.Data:
    """`data` with the state and the inputs."""
    return data.replace(
        qpos=physics.qpos,
        qvel=physics.qvel,
        qacc_warmstart=physics.warmstart,
        act=physics.act,
        mocap_pos=controls.mocap[:, :3],
        mocap_quat=controls.mocap[:, 3:],
        ctrl=controls.ctrl,
    )


class MjxEngine:
    """MJX with impl="jax".

    Under `vmap`, the constraint solver runs until the slowest environment has converged, so its iterations are limited. With 4
    iterations, pushed objects deviate two to three times as far from recorded episodes as with 8. 100 iterations gain little
    more (docs/fidelity.md).
    """

    name = "jax"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        iterations: int = 8,
        ls_iterations: int = 5,
        sensors: bool = False,
        varied: Sequence[str] = (),
    ):
        check_count("iterations", iterations)
        check_count("ls_iterations", ls_iterations)
        if ignored := beyond_defaults(model, _IGNORED.__contains__):
            raise ValueError(f"engine jax: MJX ignores features of the model: {', '.join(ignored)}; use engine native")
        self._variation = Variation(model, varied)
        model = with_stand_ins(model)
        _grow_for_margins(model)
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        if not sensors:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._mujoco_model, self._substeps, self._welds = model, substeps, _welds(model)
        try:
            self._model = mjx.put_model(model, impl="jax")
            # NumPy leaves become constants of the program that traces them, on any device.
            self._data = jax.tree.map(np.asarray, mjx.make_data(model, impl="jax"))
        except NotImplementedError as error:
            what = with_names(str(error).rstrip("."), model, "geom", _geoms_in(model, str(error)))
            cure = "use engine native"
            if "mjGEOM_CYLINDER" in str(error) and "mjGEOM_BOX" in str(error):
                cure = f"list the two geoms as a <pair> and add a geom called NAME_stand_in for one of them, or {cure}"
            raise ValueError(f"engine jax: MJX does not support this model: {what}; {cure}") from error

    def advance(self, physics: Physics, controls: Controls) -> Physics:
        check_shapes(self._mujoco_model, physics, controls, self._variation.size)

        # MJX indexes empty arrays, such as positions of no sites, which JAX allows and NumPy does not.
        start = jax.tree.map(lambda x: x if x.size else jnp.asarray(x), self._data)

        def substep(_, p: Physics) -> Physics:
            data = _loaded(start, p, controls)
            with private_api.bodies_computed_once() if jax.default_backend() == "cpu" else contextlib.nullcontext():
                data = self._step(model, data) if self._welds else mjx.step(model, data)
            # MJX's precision depends on jax_enable_x64; between substeps it is float32, as between steps.
            qpos, qvel, warmstart, act = (x.astype(jnp.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.act))
            return Physics(qpos, qvel, warmstart, act, factors=p.factors)

        with jax.default_matmul_precision("highest"):  # TF32 breaks contacts
            model = self._varied(physics)
            return jax.lax.fori_loop(0, self._substeps, substep, dataclasses.replace(physics, sensors=None))

    def _varied(self, physics: Physics) -> mjx.Model:
        """The model with the numbers of a state."""
        if not self._variation.size:
            return self._model
        return self._model.replace(**self._variation.values(self._variation.factors(physics.factors, jnp), jnp))

    def read_sensors(self, physics: Physics, controls: Controls) -> Array:
        """Values [nsensordata] of the model's sensors. The engine must be made with `sensors`."""
        check_shapes(self._mujoco_model, physics, controls, self._variation.size)
        data = _loaded(jax.tree.map(jnp.asarray, self._data), physics, controls)
        with jax.default_matmul_precision("highest"):
            return mjx.forward(self._varied(physics), data).sensordata.astype(jnp.float32)

    def check(self) -> None:
        pass  # there is memory for all contacts

    def _step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Computes `mjx.step` with the welds corrected, and without sensors."""
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
        shifts = [-weld.bias(data) if isinstance(weld, _Weld) else jnp.zeros(weld) for weld in self._welds]
        data = private_api.shift_reference_acceleration(data, jnp.concatenate(shifts))
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        euler = int(mujoco.mjtIntegrator.mjINT_EULER)
        integrate = mjx.euler if self._mujoco_model.opt.integrator == euler else mjx.implicit
        return integrate(model, mjx.solve(model, data))
