"""Simulations on a device with MuJoCo Warp's kernels, for models that the fused kernel does not support.

All substeps of an environment step are one CUDA graph on fixed memory, so starting some hundred kernels per substep costs
little. Only the state is copied in and out.
"""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjx_dher.envs.engines import pairs
from mjx_dher.envs.engines.features import beyond_defaults, narrow_limits
from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp

# Fields of MjModel that MuJoCo Warp ignores without an error (mujoco-mjx 3.17).
IGNORED = ("actuator_armature", "opt.disableactuator")
_PROBE = 2000  # timesteps
_FEW_CONTACTS, _FEW_ROWS = 48, 160  # always allocated, if they can occur

if TYPE_CHECKING:
    Rows = Any
else:
    Rows = wp.array2d(dtype=float)  # argument of a kernel, a row per environment


def unsupported(model: mujoco.MjModel) -> list[str]:
    """Features of the model that MuJoCo Warp does not support, with names of their elements."""
    left_out = [*beyond_defaults(model, IGNORED.__contains__), *narrow_limits(model)]
    try:
        with wp.ScopedDevice("cpu"):
            private_api.mujoco_warp().put_model(model)
    except NotImplementedError as error:
        left_out.append(str(error).rstrip("."))
    return left_out + pairs.too_slippery(model, "warp graph")


def memory_for(model: mujoco.MjModel) -> tuple[int, int]:
    """Numbers of contacts and constraint rows per environment to allocate memory for.

    All that can occur if these are few, else 1.5 times as many as random controls cause.
    """
    contacts, rows = pairs.most(model)
    if contacts > _FEW_CONTACTS or rows > _FEW_ROWS:
        seen_contacts, seen_rows, _ = probe(model)
        contacts = min(contacts, max(1.5 * seen_contacts, _FEW_CONTACTS))
        rows = min(rows, max(1.5 * seen_rows, _FEW_ROWS))
    return max(1, round(contacts)), max(1, round(rows))


def probe(model: mujoco.MjModel) -> tuple[int, int, int]:
    """Most contacts, rows, and rows of contacts under random controls, from the default and from keyframes."""
    data, rng, most = mujoco.MjData(model), np.random.default_rng(0), (0, 0, 0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    for warning in data.warning:
        warning.number = 1  # otherwise MuJoCo writes a log
    starts = range(-1, min(model.nkey, 4))
    for key in starts:
        mujoco.mj_resetDataKeyframe(model, data, key) if key >= 0 else mujoco.mj_resetData(model, data)
        for step in range(_PROBE // len(starts)):
            if step % 20 == 0:
                data.ctrl[:] = rng.uniform(low, high)
            mujoco.mj_step(model, data)
            of_contacts = int(np.count_nonzero(data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)))
            most = tuple(map(max, most, (data.ncon, data.nefc, of_contacts)))
    return most


@wp.kernel(enable_backward=False, module="mjx_dher_graph")
def _begin(
    qpos: Rows,
    qvel: Rows,
    rest: Rows,
    inputs: Rows,
    qpos_out: Rows,
    qvel_out: Rows,
    warmstart_out: Rows,
    act_out: Rows,
    mocap_pos: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
    mocap_quat: wp.array2d(dtype=wp.quat),  # type: ignore[valid-type]
    ctrl: Rows,
    time: wp.array(dtype=float),  # type: ignore[valid-type]
):
    """Copies state and controls into MuJoCo Warp's memory."""
    env = wp.tid()
    for i in range(qpos.shape[1]):
        qpos_out[env, i] = qpos[env, i]
    nv = qvel.shape[1]
    for i in range(nv):
        qvel_out[env, i] = qvel[env, i]
        warmstart_out[env, i] = rest[env, i]
    for i in range(rest.shape[1] - nv):
        act_out[env, i] = rest[env, nv + i]
    bodies = mocap_pos.shape[1]
    for i in range(bodies):
        at = 7 * i
        mocap_pos[env, i] = wp.vec3(inputs[env, at], inputs[env, at + 1], inputs[env, at + 2])
        mocap_quat[env, i] = wp.quat(inputs[env, at + 3], inputs[env, at + 4], inputs[env, at + 5], inputs[env, at + 6])
    for i in range(ctrl.shape[1]):
        ctrl[env, i] = inputs[env, 7 * bodies + i]
    time[env] = 0.0


@wp.kernel(enable_backward=False, module="mjx_dher_graph")
def _vary(inputs: Rows, begin: int, field: Rows):
    """Copies the numbers of a field of the model that differ between environments."""
    env, i = wp.tid()  # type: ignore[misc]
    field[env, i] = inputs[env, begin + i]


@wp.kernel(enable_backward=False, module="mjx_dher_graph")
def _end(qpos: Rows, qvel: Rows, warmstart: Rows, act: Rows, qpos_out: Rows, qvel_out: Rows, rest_out: Rows):
    """Copies the state out of MuJoCo Warp's memory."""
    env = wp.tid()
    for i in range(qpos_out.shape[1]):
        qpos_out[env, i] = qpos[env, i]
    nv = qvel_out.shape[1]
    for i in range(nv):
        qvel_out[env, i] = qvel[env, i]
        rest_out[env, i] = warmstart[env, i]
    for i in range(act.shape[1]):
        rest_out[env, nv + i] = act[env, i]


@wp.kernel(enable_backward=False, module="mjx_dher_graph")
def _end_sensors(sensordata: Rows, rest_out: Rows):
    """Copies the sensors out of MuJoCo Warp's memory, to the end of the rows."""
    env = wp.tid()
    first = rest_out.shape[1] - sensordata.shape[1]
    for i in range(sensordata.shape[1]):
        rest_out[env, first + i] = sensordata[env, i]


class Simulation:
    """Environments that MuJoCo Warp advances, on Warp's current device.

    Args:
      model: a model for which `unsupported` is empty.
      substeps: timesteps per environment step.
      contacts: memory for contacts, per environment on average.
      rows: memory for constraint rows, per environment.
      sensors: whether `advance` also reads the sensors of its final state.
      varied: fields of the model that differ between environments. `inputs` ends with their numbers.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        substeps: int,
        contacts: int,
        rows: int,
        sensors: bool = False,
        varied: Sequence[str] = (),
    ):
        warp = private_api.mujoco_warp()
        model = copy.copy(model)
        if not sensors:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._step, self._model = warp.step, warp.put_model(model)
        self._last = warp.forward if sensors else None
        # MuJoCo Warp takes the velocity term of equality constraints from the previous timestep, unless it is computed before.
        self._before = (warp.kinematics, warp.com_pos, warp.com_vel) if model.neq else ()
        self._model.opt.warn_overflow = 0  # printing kernels wait for the host
        self._varied = [self._own(name, np.asarray(getattr(model, name)), num_envs) for name in varied]
        self._data = warp.make_data(model, nworld=num_envs, nconmax=contacts, njmax=rows)
        self._substeps, self._num_envs, self._graph = substeps, num_envs, None

    def _own(self, name: str, nominal: np.ndarray, num_envs: int) -> Any:
        """Gives each environment its own numbers of a field. Returns them as [num_envs, n]."""
        dtype = getattr(self._model, name).dtype
        field: Any = wp.array(np.tile(nominal, (num_envs, *[1] * nominal.ndim)).astype(np.float32), dtype=dtype)
        setattr(self._model, name, field)
        return wp.array(ptr=field.ptr, shape=(num_envs, nominal.size), dtype=float, device=field.device)

    def load(self) -> None:
        """Compiles the kernels, or loads them from Warp's cache."""
        (self._last or self._step)(self._model, self._data)
        wp.synchronize_device()

    def advance(self, state: tuple[Any, Any, Any], inputs: Any, result: tuple[Any, Any, Any]) -> None:
        """Advances coordinates, velocities, and rows of warm start and activations by an environment step."""
        data = self._data
        if self._graph is None and not wp.get_device().is_cpu:
            self.load()  # not allowed during a capture
            with wp.ScopedCapture() as capture:
                self._run()
            self._graph = capture.graph
        held = [data.qpos, data.qvel, data.qacc_warmstart, data.act]
        outputs = [*held, data.mocap_pos, data.mocap_quat, data.ctrl, data.time]
        wp.launch(_begin, dim=self._num_envs, inputs=[*state, inputs], outputs=outputs)
        begin = 7 * data.mocap_pos.shape[1] + data.ctrl.shape[1]
        for field in self._varied:
            wp.launch(_vary, dim=field.shape, inputs=[inputs, begin], outputs=[field])
            begin += field.shape[1]
        if self._graph is None:
            self._run()
        else:
            wp.capture_launch(self._graph)
        wp.launch(_end, dim=self._num_envs, inputs=held, outputs=list(result))
        if self._last:
            wp.launch(_end_sensors, dim=self._num_envs, inputs=[data.sensordata], outputs=[result[2]])

    def overflow(self) -> int:
        """Number of environments since the last call in which contacts or rows did not fit into memory."""
        lost = int(np.count_nonzero(self._data.overflow.numpy() & private_api.overflow_of_memory()))
        if lost:
            self._data.overflow.zero_()
        return lost

    def _run(self) -> None:
        for _ in range(self._substeps):
            for compute in self._before:
                compute(self._model, self._data)
            self._step(self._model, self._data)
        if self._last:
            self._last(self._model, self._data)
