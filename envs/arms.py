"""The arm tasks of JaxGCRL: reach, push, grasp and pick with a Franka Panda whose actions are joint angles.

Numbers are from JaxGCRL 0.2.8 (https://github.com/MichalBortkiewicz/JaxGCRL, jaxgcrl/envs/manipulation), as Brax 0.14.2
compiles its models. Brax joins bodies without a joint to their parents. The arm thereby loses its defaults: its joints have
neither damping nor armature, and the hand has no mass. JaxGCRL simulates a free body that shows the goal; here it is drawn.

JaxGCRL runs in MJX with implicit integration. There, a servo damps its joint implicitly even while its force is at its limit;
in MuJoCo C it does not, and the arm is then several times as fast. Here an armature of timestep * damping does the same on all
engines, with Euler's integration. Without contacts, both compute the same numbers.
"""

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.context import euclidean
from mjx_dher.envs.base import State
from mjx_dher.envs.controls import Actuators, Control
from mjx_dher.envs.engines import Controls, Physics, variation_of
from mjx_dher.envs.goals import Goal, Mark, Position
from mjx_dher.envs.kinematics import Place
from mjx_dher.envs.starts import Start
from mjx_dher.envs.task import MujocoTask
from mjx_dher.types import Array, PRNGKey

# Links: place in the one before, m, and turn about x, quarter turns; mass, kg; centre of mass, m; inertia there, kg m^2 (xx yy
# zz xy xz yz). The joint turns about z.
_LINKS = (
    ("0 0 0.333", 0, 4.970684, "0.003875 0.002081 -0.04762", "0.70337 0.70661 0.009117 -0.000139 0.006772 0.019169"),
    ("0 0 0", -1, 0.646926, "-0.003141 -0.02872 0.003495", "0.007962 0.02811 0.025995 -0.003925 0.010254 0.000704"),
    ("0 -0.316 0", 1, 3.228604, "0.027518 0.039252 -0.066502", "0.037242 0.036155 0.01083 -0.004761 -0.011396 -0.012805"),
    ("0.0825 0 0", 1, 3.587895, "-0.05317 0.104419 0.027454", "0.025853 0.019552 0.028323 0.007796 -0.001332 0.008641"),
    (
        "-0.0825 0.384 0",
        -1,
        1.225946,
        "-0.011953 0.041065 -0.038437",
        "0.035549 0.029474 0.008627 -0.002117 -0.004037 0.000229",
    ),
    ("0 0 0", 1, 1.666555, "0.060149 -0.014117 -0.010517", "0.001964 0.004354 0.005433 0.000109 -0.001158 0.000341"),
    ("0.088 0 0", 1, 0.735522, "0.010517 -0.004252 0.061597", "0.012516 0.010027 0.004815 -0.000428 -0.001196 -0.000741"),
)
_RANGES = {2: "-1.7628 1.7628", 4: "-3.0718 -0.0698", 6: "-0.0175 3.7525"}  # of joints, rad; the others have none
# Servos: largest torque, N m, gain and stiffness; torque = gain * target - stiffness * (angle + 0.1 s * speed).
_SERVOS = ((87, 4500, 4500),) * 2 + ((87, 2000, 3500),) * 2 + ((12, 1000, 2000),) * 3
_FINGER = (500, 0.09804, 500)  # the same for a finger, N
_TIMESTEP = 0.002  # s
_HOME = (1.571, 0.742, 0.0, -1.571, 0.0, 3.054, 1.449)  # rad, at the start
_DRIVEN = (0, 1, 3, 5)  # joints that the action moves
_LOW, _HIGH = np.array([[0.3491, 0.0, -3.0718, 2.3562], [2.7925, 1.48353, -0.0698, 3.7525]], np.float32)  # their targets, rad
_WRIST = 1.4487  # rad, target of the last joint; the third and the fifth have 0
_OPEN = 255.0  # input of the fingers' servos
_HALF = 0.03  # m, half a side of the cube; also the height of its goals
_WALLS = ((0.0, -0.14, 0.145, 0.005), (0.0, 0.14, 0.145, 0.005), (0.14, 0.0, 0.005, 0.135), (-0.14, 0.0, 0.005, 0.135))  # m
_COLOURS = {"blue": "0 .2 .8 1", "red": ".8 0 0 1"}


def _armature(stiffness: float) -> float:
    """Armature that stands for the implicit damping of a servo."""
    return round(_TIMESTEP * 0.1 * stiffness, 9)


def _arm(hand: str, link: int = 0) -> str:
    """The links from `link` on, each in the one before; the last one holds `hand`."""
    if link == len(_LINKS):
        return hand
    pos, turn, mass, centre, inertia = _LINKS[link]
    limits = f'armature="{_armature(_SERVOS[link][2])}"' + (f' range="{_RANGES[link + 1]}"' if link + 1 in _RANGES else "")
    end = _LINKS[link + 1][0] if link + 1 < len(_LINKS) else "0 0 0.1"
    look = 'type="sphere" size="0.06"' if end == "0 0 0" else f'type="capsule" size="0.05" fromto="0 0 0 {end}"'
    return (
        f'<body name="link{link + 1}" pos="{pos}" quat="1 {turn} 0 0"><joint name="joint{link + 1}" {limits}/>'
        f'<inertial mass="{mass}" pos="{centre}" fullinertia="{inertia}"/><geom class="look" rgba=".9 .92 .95 1" {look}/>'
        f"{_arm(hand, link + 1)}</body>"
    )


def _finger(side: str, turn: str) -> str:
    return (
        f'<body name="{side}_finger" pos="0 0 0.1654" quat="{turn}"><inertial mass="0.015" pos="0 0 0"'
        f' diaginertia="2.375e-6 2.375e-6 7.5e-7"/><joint name="{side}_finger" type="slide" axis="0 1 0" range="0 0.05"'
        f' armature="{0.1 + _armature(_FINGER[2])}" damping="5"/>'
        f'<geom name="{side}_finger" type="box" size="0.015 0.005 0.04" pos="0 0.0055 0.035"'
        f' rgba=".25 .25 .25 1"/><site name="{side}_tip" pos="0 0.005 0.07"/></body>'
    )


def _geom(name: str, x: float, y: float, size: Sequence[float], rgba: str) -> str:
    """A box of half sides `size` on the table, for contacts if it has a name."""
    kind = f'name="{name}"' if name else 'class="look"'
    return f'<geom {kind} type="box" pos="{x} {y} {size[2]}" size="{size[0]} {size[1]} {size[2]}" rgba="{rgba}"/>'


def _servo(joint: str, limits: str, force: float, gain: float, stiffness: float) -> str:
    return (
        f'<general joint="{joint}" ctrlrange="{limits}" forcerange="-{force} {force}" gainprm="{gain}" biastype="affine"'
        f' biasprm="0 -{stiffness} -{0.1 * stiffness}"/>'
    )


def mjcf(areas: dict[str, tuple[float, float, float]], cube: tuple[float, float] | None, bins: bool = False) -> str:
    """MJCF of a task.

    `areas` has x and y of the centre and half a side in m, by colour. `cube` is the cube's initial position in m, or None for
    an arm without gripper and cube. With `bins`, the areas have walls, which do not scale with their size.
    """
    hand = '<geom name="hand" type="capsule" size="0.04 0.06" pos="0 0 0.142" quat="{0} {0} -{1} -{1}"/>'
    hand = hand.format(0.653281535, 0.270597922)
    servos = [_servo(f"joint{i}", _RANGES.get(i, "-2.8973 2.8973"), *row) for i, row in enumerate(_SERVOS, 1)]
    qpos, movers, pairs, others = list(_HOME), ["hand"], [("table", "hand")], ""
    if cube is not None:
        hand += _finger("left", "0.923879607 0 0 -0.382683252") + _finger("right", "0.382683252 0 0 0.923879607")
        servos += [_servo(f"{side}_finger", "0 255", *_FINGER) for side in ("left", "right")]
        qpos = [*cube, 0.07, 1.0, 0.0, 0.0, 0.0, *qpos, 0.04, 0.04]  # the cube falls onto the table
        movers = ["cube", "hand", "left_finger", "right_finger"]
        pairs = [*(("table", each) for each in movers), *(("cube", each) for each in movers[1:])]
        pairs.append(("left_finger", "right_finger"))
        box = _geom("cube", 0, 0, (_HALF,) * 3, "0 .4 0 1").replace(f"0 0 {_HALF}", "0 0 0", 1)
        others = f'<body name="cube" pos="{cube[0]} {cube[1]} .07"><freejoint/>{box}</body>'
        joints = 'joint1="left_finger" joint2="right_finger"'
    for colour, (x, y, half) in areas.items():
        if not bins:
            others += _geom("", x, y, (half, half, 0.0005), _COLOURS[colour])
            continue
        for number, (dx, dy, *size) in enumerate(_WALLS, 1):
            others += _geom(f"{colour}{number}", x + dx, y + dy, (*size, 0.033), _COLOURS[colour])
            pairs += [(f"{colour}{number}", each) for each in movers]
    joined = "" if cube is None else f'<equality><joint {joints} solimp=".95 .99 .001" solref=".005 1"/></equality>'
    return f"""<mujoco><compiler angle="radian"/>
<option timestep="{_TIMESTEP}" impratio="{10 if bins else 1}"/>
<default><geom contype="0" conaffinity="0"/><default class="look"><geom group="2"/></default></default>
<worldbody><light pos="0 0 2"/><camera name="front" pos="0 1.9 1.1" xyaxes="-1 0 0 0 -.55 .83"/>
<geom name="table" type="plane" pos="0 .2 0" size="2.8 2.4 .1" rgba=".85 .85 .85 1"/>{others}{_arm(hand)}</worldbody>
<contact>{"".join(f'<pair geom1="{a}" geom2="{b}"/>' for a, b in pairs)}</contact>{joined}
<actuator>{"".join(servos)}</actuator>
<keyframe><key name="home" qpos="{" ".join(map(str, qpos))}"/></keyframe></mujoco>"""


class ArmTargets(Actuators):
    """Targets of four joints, in the ranges of JaxGCRL; the other joints' targets are fixed."""

    size = 4

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = copy.copy(self)
        bound.moved, bound.indices = [f"joint{joint + 1}" for joint in _DRIVEN], list(_DRIVEN)
        bound.low, bound.high = _LOW, _HIGH
        return bound

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        fixed = controls.ctrl.at[:7].set(jnp.zeros(7, jnp.float32)).at[6].set(_WRIST)
        return super().apply(physics, action, dataclasses.replace(controls, ctrl=fixed))


class OpenOrClosed(Control):
    """The gripper: closed if the number is positive, else open."""

    size = 1

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = copy.copy(self)
        bound.moved = ["left_finger", "right_finger"]
        return bound

    def apply(self, physics: Physics, action: Array, controls: Controls) -> Controls:
        return dataclasses.replace(controls, ctrl=controls.ctrl.at[7:].set(jnp.where(action > 0.0, 0.0, _OPEN)))

    def rest(self, ctrl: Array) -> Array:
        return jnp.full(1, -1.0)


class Gripped(Goal):
    """Fingertips on both sides of the cube, relative to its centre, and their distance: [7] in m.

    It is reached if the midpoint of the fingertips is near the cube and their distance is right. The distance of goals is the
    larger of both errors, in units of the `allowed` ones.
    """

    size = 7
    threshold = 1.0
    unit = ""
    wanted = np.array([0.0375, 0.0, 0.0, -0.0375, 0.0, 0.0, 0.075], np.float32)
    allowed = (0.05, 0.02)  # m

    def bind(self, model: mujoco.MjModel) -> Self:
        bound = super().bind(model)
        bound.places = [Place(model, name) for name in ("body:cube", "site:left_tip", "site:right_tip")]
        return bound

    def achieved(self, physics: Physics) -> Array:
        cube, left, right = (place.position(physics.qpos) for place in self.places)
        return jnp.concatenate([left - cube, right - cube, euclidean(left, right)[None]])

    def sample(self, key: PRNGKey) -> Array:
        return jnp.asarray(self.wanted)

    def distance(self, achieved: Array, desired: Array) -> Array:
        apart = 0.5 * (achieved[..., :6] - desired[..., :6])
        near = euclidean(apart[..., :3], -apart[..., 3:]) / self.allowed[0]
        return jnp.maximum(near, jnp.abs(achieved[..., 6] - desired[..., 6]) / self.allowed[1])

    def marks(self, model: mujoco.MjModel, qpos: np.ndarray, goal: np.ndarray) -> list[Mark]:
        cube = np.asarray(self.places[0].position(jnp.asarray(qpos, jnp.float32)))
        return [(-1, cube + np.asarray(goal[at : at + 3]), np.array([1.0, 0.0, 0.0, 0.0])) for at in (0, 3)]

    places: list[Place]


class ArmReach(MujocoTask):
    """Moves the end of the arm to a point in the air."""

    name = "arm_reach"
    model: Any = mjcf({"blue": (0.0, 0.5, 0.2)}, None)
    control: Any = ArmTargets()
    start = Start("home")
    goal: Goal = Position("body:link7", (-0.2, 0.3, 0.1), (0.2, 0.7, 0.5), threshold=0.1)
    observations: Any = ("qpos:joint*", "body:link7", "vel:link7")
    hz = 20.0
    episode_length = 100


class ArmPushEasy(ArmReach):
    """Pushes the cube from the blue square to a point on the red one."""

    name = "arm_push_easy"
    model: Any = mjcf({"blue": (-0.1, 0.6, 0.1), "red": (0.1, 0.6, 0.1)}, (-0.1, 0.6))
    control = (ArmTargets(), OpenOrClosed())
    start = Start("home", ranges={"cube": ((-0.2, 0.5, 0.07), (0.0, 0.7, 0.07))})
    goal: Goal = Position("body:cube", (0.0, 0.5, _HALF), (0.2, 0.7, _HALF), threshold=0.1)
    observations = ("body:cube", *ArmReach.observations)
    episode_length = 150
    tips = "body:left_finger", "body:right_finger"  # whose distance is observed
    forces: slice = slice(0, 7)  # servos whose forces are observed, by their sum
    scale = 0.1 / 19.0  # of the sum: there it is a mean over 19 degrees of freedom, 12 of them without a servo

    def bind(self) -> None:
        self._tips = [Place(self.model, name) for name in self.tips]
        super().bind()
        for name in ("finger distance", "force"):
            self.layout[name] = slice(self.observation_size, self.observation_size + 1)
            self.observation_size += 1
        self._rest = jax.device_get(self._with_force(self._rest, jnp.zeros(self.model.nu, jnp.float32)))

    def first_state(self, physics: Physics, desired_goal: Array) -> State:
        return super().first_state(self._with_force(physics, jnp.zeros(self.model.nu, jnp.float32)), desired_goal)

    def advance(self, physics: Physics, action: Array) -> Physics:
        return self._with_force(super().advance(physics, action), self.controls(physics, action).ctrl)

    describe = MujocoTask.describe  # `layout` has what `observe` adds

    def observe(self, physics: Physics) -> Array:
        left, right = (place.position(physics.qpos) for place in self._tips)
        assert physics.sensors is not None
        return jnp.concatenate([super().observe(physics), euclidean(left, right)[None], physics.sensors])

    def _with_force(self, physics: Physics, ctrl: Array) -> Physics:
        """The physics with the scaled sum of the servos' forces under the inputs `ctrl`, as a sensor."""
        model, joints = self.model, self.model.actuator_trnid[:, 0]
        qpos, qvel = physics.qpos[model.jnt_qposadr[joints]], physics.qvel[model.jnt_dofadr[joints]]
        own = {} if physics.factors is None else variation_of(model, tuple(self._ranges)).values(physics.factors, jnp)
        rows = (own.get(name, getattr(model, name).astype(np.float32)) for name in ("actuator_gainprm", "actuator_biasprm"))
        gain, bias = (row.T for row in rows)
        low, high = model.actuator_forcerange.T.astype(np.float32)
        force = jnp.clip(gain[0] * ctrl + bias[1] * qpos + bias[2] * qvel, low, high)
        return dataclasses.replace(physics, sensors=self.scale * jnp.sum(force[self.forces], keepdims=True))


class ArmPushHard(ArmPushEasy):
    """Pushes the cube from a larger blue square to a point on a larger red one."""

    name = "arm_push_hard"
    model: Any = mjcf({"blue": (-0.25, 0.65, 0.25), "red": (0.25, 0.65, 0.25)}, (-0.25, 0.65))
    start = Start("home", ranges={"cube": ((-0.5, 0.4, 0.07), (0.0, 0.9, 0.07))})
    goal = Position("body:cube", (0.0, 0.4, _HALF), (0.5, 0.9, _HALF), threshold=0.1)


class ArmBinpickEasy(ArmPushEasy):
    """Moves the cube from the blue bin to the middle of the red one."""

    name = "arm_binpick_easy"
    model: Any = mjcf({"blue": (-0.17, 0.6, 0.14), "red": (0.17, 0.6, 0.14)}, (-0.15, 0.6), bins=True)
    start = Start("home", ranges={"cube": ((-0.22, 0.53, 0.07), (-0.08, 0.67, 0.07))})
    goal = Position("body:cube", (0.165, 0.595, _HALF), (0.175, 0.605, _HALF), threshold=0.1)


class ArmGrasp(ArmPushEasy):
    """Closes the fingers around the cube.

    In JaxGCRL the goal is the fingertips' positions and follows the cube. Here it is relative to the cube, and constant.
    """

    name = "arm_grasp"
    model: Any = mjcf({"blue": (0.0, 0.6, 0.3)}, (0.0, 0.6))
    start = Start("home", ranges={"cube": ((-0.3, 0.3, 0.07), (0.3, 0.9, 0.07))})
    goal = Gripped()
    observations = (*ArmPushEasy.observations, "site:left_tip", "site:right_tip")
    episode_length = 100
    tips = "site:left_tip", "site:right_tip"
    forces = slice(7, 9)
    scale = 0.05
