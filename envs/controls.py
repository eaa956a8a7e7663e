"""Controls map actions to joint servos, motors or mocap bodies, within the ranges of the model."""

import copy
import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, Self

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.arm_kinematics import quat_multiply, quat_to_matrix
from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.kinematics import HINGE, Numbered, Place, names_of, pick, rounded, to_quat
from mjx_dher.lookup import check_name
from mjx_dher.types import Array
from mjx_dher.validation import check_number

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_AFFINE, _NO_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtBias.mjBIAS_NONE)
_FIXED, _BODY, _WELD = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtEq.mjEQ_WELD)
_NO_DYNAMICS, _INTEGRATOR = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


class Control:
    """Base class: maps `size` numbers of an action, in [-1, 1], to inputs of an engine."""

    size: int
    moved: Sequence[str] = ()  # names of the actuators or the mocap body

    def bind(self, model: mujoco.MjModel) -> Self:
        """Copy for `model`. Raises ValueError for a name that the model lacks."""
        return copy.copy(self)

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        """Updates the engine's inputs for an action.

        Args:
          physics: state before the step.
          action: numbers [size] in [-1, 1].
          controls: the inputs so far.

        Returns:
          The new inputs.
        """
        raise NotImplementedError

    def rest(self, ctrl: Array) -> Array:
        """Action [size] that holds a configuration, whose inputs are `ctrl` [nu]."""
        return jnp.zeros(self.size, jnp.float32)

    def describe(self) -> dict[str, Any]:
        """Kind, names of the moved parts, numbers of the action, scale, gear and limits, as JSON."""
        about: dict[str, Any] = {"kind": type(self).__name__, "moves": list(self.moved), "size": self.size}
        for name in ("scale", "turn", "gear", "offset", "low", "high"):
            if name in vars(self):
                about[name] = rounded(vars(self)[name])
        return about


class Actuators(Control):
    """Actuators of any kind: -1 and 1 are the ends of the actuator's ctrlrange.

    Args:
      names: names of enabled actuators or of their joints, separated by spaces; "*" and "?" match any characters.
      together: whether one number of the action moves all actuators, like the fingers of a gripper.
    """

    def __init__(self, names: str = "*", together: bool = False):
        self.names, self.together = names, together

    def bind(self, model: mujoco.MjModel) -> Self:
        check_number("scale of control", self.scale, "(0, inf)", float)
        bound = copy.copy(self)
        own, joints = [""] * model.nu, [""] * model.nu  # names of actuators of this kind, and of their joints
        for i in filter(lambda i: self._suits(model, i) and _acts(model, i), range(model.nu)):
            joints[i] = names_of(model, "joint")[joint] if (joint := _joint(model, i)) >= 0 else ""
            own[i] = model.actuator(i).name or joints[i] or Numbered(f"actuator_{i}")
        if not any(own):
            raise ValueError(f"control {type(self).__name__}({self.names!r}) has nothing to move: {_others(model)}")
        bound.indices = pick(f"actuator of control {type(self).__name__}", self.names, own, joints)
        bound.moved = [own[i] for i in bound.indices]
        bound.size = 1 if self.together else len(bound.indices)
        bound.low, bound.high = np.array([_range(model, i) for i in bound.indices], np.float32).T
        return bound

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        ctrl = 0.5 * (self.high + self.low) + 0.5 * (self.high - self.low) * action
        return dataclasses.replace(controls, ctrl=controls.ctrl.at[np.array(self.indices)].set(ctrl))

    def rest(self, ctrl: Array) -> Array:
        middle, half = 0.5 * (self.high + self.low), np.maximum(0.5 * (self.high - self.low), 1e-12)
        action = jnp.clip((ctrl[np.array(self.indices)] - middle) / half, -1.0, 1.0)
        return action.mean(keepdims=True) if self.together else action

    def _suits(self, model: mujoco.MjModel, index: int) -> bool:
        return True

    scale = 1.0
    indices: list[int]
    low: np.ndarray  # [number of actuators]
    high: np.ndarray


class JointPosition(Actuators):
    """Position servos: -1 and 1 are the ends of the servo's ctrlrange, or of its joint's range if it has none.

    A servo's gain is fixed, its bias is affine and falls with the position, and its input may be filtered.
    """

    def _suits(self, model: mujoco.MjModel, index: int) -> bool:
        return is_servo(model, index)


class JointDelta(JointPosition):
    """Position servos, moved relative to the current joint positions: 1 moves the target by `scale` (rad, or m for a slide).

    Args:
      names, together: as in `Actuators`.
      scale: distance between target and joint position for an action of 1.
    """

    def __init__(self, names: str = "*", scale: float = 0.1, together: bool = False):
        super().__init__(names, together)
        self.scale = scale

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.qpos = model.jnt_qposadr[[_joint(model, i) for i in bound.indices]]
        slope, offset = np.array([_holding(model, i) for i in bound.indices], np.float32).T
        bound.gear = slope * np.array(model.actuator_gear[bound.indices, 0], np.float32)
        if offset.any():
            bound.offset = offset
        for i, name, gear, width in zip(bound.indices, bound.moved, np.abs(bound.gear), bound.high - bound.low):
            if model.jnt_type[_joint(model, i)] == HINGE and self.scale * gear > 1.001 * width:  # else rounding
                moves = f"control JointDelta moves {name} by {self.scale:g} per action"
                warnings.warn(f"{moves}, and its range is {width / gear:.3g} wide: is the scale in degrees?", stacklevel=2)
        return bound

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        target = self.gear * (physics.qpos[self.qpos] + self.scale * action) + self.offset
        return dataclasses.replace(
            controls, ctrl=controls.ctrl.at[np.array(self.indices)].set(jnp.clip(target, self.low, self.high))
        )

    def rest(self, ctrl: Array) -> Array:
        return Control.rest(self, ctrl)

    def _suits(self, model: mujoco.MjModel, index: int) -> bool:
        return is_servo(model, index) and _joint(model, index) >= 0

    qpos: np.ndarray
    gear: np.ndarray  # input per rad or m of the joint
    offset: np.ndarray | float = 0.0  # input that holds the joint at 0


class Torque(Actuators):
    """Motors: -1 and 1 are the ends of the motor's ctrlrange."""

    def _suits(self, model: mujoco.MjModel, index: int) -> bool:
        return model.actuator_biastype[index] == _NO_BIAS


class Mocap(Control):
    """A mocap body that pulls a body by a weld: 1 moves its target `scale` m away from the body, along x, y or z.

    Args:
      body: name of the mocap body.
      scale: m per action of 1.
      turn: rad per action of 1 about the world's x, y or z. With 0, actions have three numbers instead of six.
    """

    def __init__(self, body: str, scale: float = 0.05, turn: float = 0.0):
        self.body, self.scale, self.turn = body, scale, turn

    def bind(self, model: mujoco.MjModel) -> Self:
        check_number("scale of control", self.scale, "(0, inf)", float)
        check_number("turn of control", self.turn, "[0, 3.15]", float)
        bound = copy.copy(self)
        mocap = {name: i for i, name in enumerate(names_of(model, "body")) if model.body_mocapid[i] >= 0}
        check_name("mocap body", self.body, mocap)
        bound.index = int(model.body_mocapid[mocap[self.body]])
        welds = (model.eq_type == _WELD) & (model.eq_objtype == _BODY) & model.eq_active0.astype(bool)
        own = np.flatnonzero(welds & ((model.eq_obj1id == mocap[self.body]) | (model.eq_obj2id == mocap[self.body])))
        if len(own) != 1:
            raise ValueError(
                f"mocap body {self.body!r} must be welded to one body, by names of bodies; the model has {len(own)} such welds"
            )
        first, second = int(model.eq_obj1id[own[0]]), int(model.eq_obj2id[own[0]])
        bound._is_first = first == mocap[self.body]
        bound.place = Place(model, f"body:{names_of(model, 'body')[second if bound._is_first else first]}")
        # In MuJoCo: pos1 + mat1 * data[3:6] = pos2 + mat2 * data[:3], and quat1 * data[6:10] = quat2.
        data = np.array(model.eq_data[own[0]], np.float32)
        bound._own, bound._others = (data[3:6], data[:3]) if bound._is_first else (data[:3], data[3:6])
        bound._relative = data[6:10] / np.linalg.norm(data[6:10])
        bound.size = 6 if self.turn else 3
        bound.moved = [self.body]
        return bound

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        pos, mat = self.place.pose(physics.qpos)
        mocap, target = controls.mocap, pos + self.scale * action[:3]
        if self.turn:
            half = 0.5 * self.turn * action[3:]
            length = jnp.sqrt(jnp.sum(jnp.square(half)) + 1e-12)
            turn = jnp.concatenate([jnp.cos(length)[None], half * jnp.sin(length) / length])
            turned = quat_multiply(turn, to_quat(mat))
            turned = turned / jnp.sqrt(jnp.sum(jnp.square(turned)))
            mat = quat_to_matrix(turned)
            if self._relative[0] < 1.0:
                sign = np.array([1, -1, -1, -1], np.float32) if self._is_first else 1.0
                turned = quat_multiply(turned, jnp.asarray(sign * self._relative))
            mocap = mocap.at[self.index, 3:].set(turned)
        if self._others.any():
            target = target + jnp.sum(mat * self._others, axis=-1)
        if self._own.any():
            target = target - jnp.sum(quat_to_matrix(mocap[self.index, 3:]) * self._own, axis=-1)
        return dataclasses.replace(controls, mocap=mocap.at[self.index, :3].set(target))

    index: int
    place: Place  # the body that is welded to the mocap body
    _is_first: bool  # whether the mocap body is the weld's first one
    _own: np.ndarray  # [3] the weld's point on the mocap body, m
    _others: np.ndarray  # [3] the weld's point on the other body, m
    _relative: np.ndarray  # quaternion [4] of the weld


def is_servo(model: mujoco.MjModel, index: int) -> bool:
    """Whether an actuator's input is a position, at which it pulls with a fixed gain, at once or through a filter."""
    return _pulls(model, index) and model.actuator_dyntype[index] != _INTEGRATOR


def _acts(model: mujoco.MjModel, index: int) -> bool:
    """Whether no flag and no disabled group switches the actuator off."""
    group, flag = int(model.actuator_group[index]), int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return not (model.opt.disableflags & flag or (group in range(31) and model.opt.disableactuator >> group & 1))


def _pulls(model: mujoco.MjModel, index: int) -> bool:
    """Whether an actuator's force is linear, and decreases with the position."""
    is_linear = model.actuator_gaintype[index] == _FIXED and model.actuator_biastype[index] == _AFFINE
    known = model.actuator_dyntype[index] in (_NO_DYNAMICS, _INTEGRATOR, *_FILTERS)
    return bool(is_linear and known and model.actuator_gainprm[index, 0] != 0 and model.actuator_biasprm[index, 1] < 0)


def _holding(model: mujoco.MjModel, index: int) -> tuple[float, float]:
    """Slope and offset of the input with which a servo pulls to a length: of its tendon, or gear times its joint's position."""
    gain, (bias, stiffness) = model.actuator_gainprm[index, 0], model.actuator_biasprm[index, :2]
    return -stiffness / gain, -bias / gain


class Holding:
    """Inputs and activations that hold a configuration: servos at their present lengths. Other actuators get 0.

    Args:
      data: a configuration of the model, with the actuators' lengths and moments.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        moments = np.zeros((model.nu, model.nv))
        sparse = (getattr(data, name) for name in ("actuator_moment", "moment_rownnz", "moment_rowadr", "moment_colind"))
        mujoco.mju_sparse2dense(moments, *sparse)
        lines = np.zeros((4, model.nu))  # slope, offset, lowest and highest target
        inputs, self._owners, held = np.zeros(model.nu), np.zeros(model.na, int), np.zeros(model.na)
        for i in filter(lambda i: _pulls(model, i), range(model.nu)):
            inputs[i] = is_servo(model, i)
            part = "ctrl" if inputs[i] else "act"  # a velocity servo's activation is its position
            is_limited, ends = (getattr(model, f"actuator_{part}{field}")[i] for field in ("limited", "range"))
            lines[:, i] = *_holding(model, i), *(ends if is_limited else (-np.inf, np.inf))
            if (activation := int(model.actuator_actadr[i])) >= 0:
                self._owners[activation], held[activation] = i, 1.0
        sizes = np.array([3, 0, 1, 1])[model.jnt_type]  # free (its position), ball, slide, hinge
        starts = zip(model.jnt_qposadr, model.jnt_dofadr, sizes)
        places = [(at + n, dof + n) for at, dof, size in starts for n in range(size)]
        self._at, dofs = np.reshape(places, (-1, 2)).astype(int).T
        self.servos = inputs.astype(bool)
        self._arrays = data.qpos[self._at], data.actuator_length.copy(), moments[:, dofs], lines, inputs, held

    def at(self, qpos: Array, xp: Any = jnp) -> tuple[Array, Array]:
        """Inputs and activations that hold `qpos`. Lengths of spatial tendons and sites are to first order, and turns of balls
        and free bodies are left out. `xp` is NumPy or jax.numpy.
        """
        nominal, lengths, moments, lines, inputs, held = (xp.asarray(array, qpos.dtype) for array in self._arrays)
        lengths = lengths + xp.sum(moments * (qpos[self._at] - nominal)[None], axis=1)
        targets = xp.clip(lines[0] * lengths + lines[1], lines[2], lines[3])
        return inputs * targets, held * targets[self._owners]


def _joint(model: mujoco.MjModel, index: int) -> int:
    """Hinge or slide driven by an actuator, or -1."""
    joint = int(model.actuator_trnid[index, 0]) if model.actuator_trntype[index] == _JOINT else -1
    return joint if joint >= 0 and int(model.jnt_type[joint]) in (2, 3) else -1


def _others(model: mujoco.MjModel) -> str:
    """What a model has in place of actuators that a control could move."""
    kinds = {"motor": Torque(), "position servo": JointPosition()}
    names = []
    for i in filter(lambda i: _acts(model, i), range(model.nu)):
        kind = next((kind for kind, control in kinds.items() if control._suits(model, i)), "other")
        names.append(f"{model.actuator(i).name or f'actuator_{i}'} ({kind})")
    if names:
        return f"the model's actuators are {', '.join(names)}. Torque moves motors, JointPosition servos, and Actuators all"
    return "all actuators of the model are disabled" if model.nu else "the model has no actuators"


def _range(model: mujoco.MjModel, index: int) -> Any:
    """Lowest and highest input of an actuator."""
    joint = _joint(model, index)
    ends = np.array([-np.inf, np.inf])
    if of_joint := is_servo(model, index) and joint >= 0 and model.jnt_limited[joint]:
        slope, offset = _holding(model, index)
        ends = np.sort(slope * model.actuator_gear[index, 0] * model.jnt_range[joint] + offset)
    if model.actuator_ctrllimited[index]:
        if of_joint and np.ptp(model.actuator_ctrlrange[index]) > 3 * np.ptp(ends):
            name = model.actuator(index).name or f"actuator_{index}"
            given = f"{model.actuator_ctrlrange[index]}, and its joint's range is {ends}"
            warnings.warn(f"actuator {name!r} has the ctrlrange {given}; are both in the same unit?", stacklevel=2)
        ends = model.actuator_ctrlrange[index]
    if (abs(ends) <= mujoco.mjMAXVAL).all():  # MuJoCo replaces larger inputs by 0
        return ends
    name = model.actuator(index).name or (names_of(model, "joint")[joint] if joint >= 0 else f"actuator_{index}")
    ignored = ', and ctrllimited="true"' if model.actuator_ctrlrange[index].any() else ""
    raise ValueError(f"actuator {name!r} has no range: give it a ctrlrange{ignored} in the MJCF")
