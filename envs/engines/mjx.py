"""MuJoCo MJX, the JAX implementation, which runs on any device that JAX supports."""

import contextlib
import copy
import dataclasses
import io
import re
import warnings
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.engines import Controls, Physics, check_shapes, pairs
from mjx_dher.envs.engines.features import beyond_defaults, narrow_limits, stand_alone, with_names
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.system import private_api
from mjx_dher.types import Array
from mjx_dher.validation import check_count

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints a line if warp-lang is not installed
    from mujoco import mjx

    from mjx_dher.envs.engines.corrections import Equality, equalities_of, implicit, in_common

# Fields of MjModel that MJX 3.17 ignores without an error.
_IGNORED = (
    *("opt.noslip_iterations", "opt.disableactuator", "actuator_armature", "actuator_damping", "actuator_dampingpoly"),
    *("actuator_actearly", "dof_dampingpoly", "jnt_stiffnesspoly", "tendon_dampingpoly", "tendon_stiffnesspoly"),
    *("geom_surfacevel", "geom_adhesion", "geom_fluid", "geom_gap", "pair_gap", "pair_adhesion"),
)
_INTEGRATORS = [int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("EULER", "IMPLICITFAST", "RK4")]


def _ignored(model: mujoco.MjModel, sensors: bool) -> Iterator[str]:
    """Features of a model, and of its sensors if they are read, that MJX 3.17 ignores or gets wrong without a clear error."""
    yield from beyond_defaults(model, _IGNORED.__contains__)
    yield from narrow_limits(model)
    if model.opt.integrator not in _INTEGRATORS:
        yield "an integrator other than Euler, implicitfast and RK4"
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER):
        yield "flags that disable springs or dampers"
    if apart := [i for i in np.flatnonzero(model.tendon_armature).tolist() if not _has_common_inertia(model, i)]:
        yield with_names("armature of tendons beyond one chain of joints", model, "tendon", apart)
    unseen = np.isin(model.geom_type, (int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_HFIELD)))
    rays = (model.sensor_type == int(mujoco.mjtSensor.mjSENS_RANGEFINDER)).any()
    if sensors and rays and (unseen.any() or not model.nmat):
        yield "rangefinders in a model with cylinders or height fields, or without a material"
    muscles = np.flatnonzero(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE))
    if len(muscles) and model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        yield with_names("damping of muscles with the integrator implicitfast", model, "actuator", muscles)
    yield from pairs.too_slippery(model, "jax")


def _has_common_inertia(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon is fixed and all its joints have common inertia. MuJoCo C leaves out inertia between others."""
    wraps = model.tendon_adr[tendon] + np.arange(model.tendon_num[tendon])
    if (model.wrap_type[wraps] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return False
    dofs = model.jnt_dofadr[model.wrap_objid[wraps]]
    return bool(in_common(model)[np.ix_(dofs, dofs)].all())


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
        if all(re.search(rf"\bmjGEOM_{name}\b", message) for name in pairs.types_of(model, *ends)):
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
    more (docs/fidelity.md). Other solvers than Newton's need the model's own numbers of iterations.
    """

    name = "jax"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        iterations: int | None = None,
        ls_iterations: int | None = None,
        sensors: bool = False,
        varied: Sequence[str] = (),
    ):
        is_newton = model.opt.solver == int(mujoco.mjtSolver.mjSOL_NEWTON)
        usual = (8, 5) if is_newton else (model.opt.iterations, model.opt.ls_iterations)
        iterations, ls_iterations = (own if given is None else given for given, own in zip((iterations, ls_iterations), usual))
        check_count("iterations", iterations)
        check_count("ls_iterations", ls_iterations)
        if ignored := [*_ignored(model, sensors)]:
            wrong = ", ".join(ignored)
            raise ValueError(f"engine jax: MJX ignores features of the model, or gets them wrong: {wrong}; use engine native")
        self._variation = Variation(model, varied)
        model = with_stand_ins(model)
        _grow_for_margins(model)
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        model.numeric_data[:] = -1  # MJX would leave out contacts by max_contact_points and max_geom_pairs
        if not sensors:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._mujoco_model, self._substeps, self._equalities = model, substeps, equalities_of(model)
        self._alone = np.flatnonzero(stand_alone(model))
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
                data = self._step(model, data)
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
            return self._forward(self._varied(physics), data).sensordata.astype(jnp.float32)

    def check(self) -> None:
        pass  # there is memory for all contacts

    def _step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Computes `mjx.step` with equalities and implicitfast corrected."""
        integrator = mujoco.mjtIntegrator(self._mujoco_model.opt.integrator)
        if integrator == mujoco.mjtIntegrator.mjINT_RK4:
            return mjx.step(model, data)
        data = self._forward(model, data)
        return (
            mjx.euler(model, data)
            if integrator == mujoco.mjtIntegrator.mjINT_EULER
            else implicit(self._mujoco_model, self._alone, model, data)
        )

    def _forward(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Computes `mjx.forward` with equalities corrected."""
        if not self._equalities:
            return mjx.forward(model, data)
        data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
        data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
        shifts = [-row.bias(data) if isinstance(row, Equality) else jnp.zeros(row) for row in self._equalities]
        data = private_api.shift_reference_acceleration(data, jnp.concatenate(shifts))
        data = mjx.solve(model, mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data)))
        return mjx.sensor_acc(model, data)
