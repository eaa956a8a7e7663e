"""Starts of episodes."""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher.envs.controls import Holding
from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.goals import box
from mjx_dher.envs.kinematics import FREE, HINGE, SLIDE, names_of
from mjx_dher.envs.simulated import Range
from mjx_dher.lookup import check_name
from mjx_dher.types import Array, PRNGKey
from mjx_dher.validation import check_number


class Start:
    """Initial configuration, partly drawn at each reset.

    Args:
      keyframe: name of a keyframe of the model, or None for the model's default configuration.
      ranges: low and high, by the name of a free body (positions, [3] m each) or of a hinge or slide (rad or m), to draw from.
      settle: environment steps for which the start is held before the episode begins. They cost as much as other steps.
        Servos hold it, unless the keyframe has inputs or activations. Servos of spatial tendons and sites hold it roughly.
        Mocap targets hold bodies that `ranges` draws. Without `turn` they hold only positions.
    """

    def __init__(self, keyframe: str | None = None, ranges: Mapping[str, tuple[Any, Any]] | None = None, settle: int = 0):
        self.keyframe, self.ranges, self.settle = keyframe, dict(ranges or {}), settle

    def bind(self, model: mujoco.MjModel) -> Self:
        """Copy for `model`. Raises ValueError for a name that the model lacks, invalid bounds, or a start with a joint more
        than 0.001 rad or m outside its range.
        """
        bound = copy.copy(self)
        check_number("settle of start", self.settle, "[0, 1000]")
        data = mujoco.MjData(model)
        if self.keyframe is not None:
            check_name("keyframe", self.keyframe, keys := names_of(model, "key"))
            mujoco.mj_resetDataKeyframe(model, data, keys.index(self.keyframe))
        bound.drawn = []
        every = _places(model)
        places, names = dict(every), [name for name, _ in every]
        for name, ends in self.ranges.items():
            check_name("name in the ranges of start", name, places)
            if names.count(name) > 1:
                raise ValueError(f"start: a free body and a joint are called {name!r}; rename one of them to draw it")
            at, dof, low, high = places[name]
            drawn = Range(at, dof, *box(f"start: {name}", len(low), ends))
            if np.any(drawn.low < low) or np.any(drawn.high > high):
                raise ValueError(f"start: {name!r} reaches {low[0]:g} to {high[0]:g}; its range is {ends}")
            bound.drawn.append(drawn)
            data.qpos[at : at + len(low)] = 0.5 * (drawn.low + drawn.high)
        outside: list[str] = []
        for name, (at, _, low, high) in every:
            # Keyframes have rounded numbers, such as 1.5708, and joints that rest against a stop.
            if len(low) == 1 and not low[0] - 1e-3 <= (value := data.qpos[at]) <= high[0] + 1e-3:
                outside.append(f"{name!r} at {value:g} with the range {low.round(5)[0]:g} to {high.round(5)[0]:g}")
        if outside:  # the limits would throw the joints back at the first step of every episode
            pose = "the model's default configuration" if self.keyframe is None else f"keyframe {self.keyframe!r}"
            raise ValueError(
                f"start: {pose} has joint {', '.join(outside)}; pass the name of a keyframe within the ranges, or positions of"
                " these joints in `ranges`"
            )
        bound._given = bool(data.ctrl.any() or data.act.any())
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
            compute(model, data)  # the actuators' lengths
        bound._holding = Holding(model, data)
        ctrl, act = (data.ctrl, data.act) if bound._given else bound._holding.at(data.qpos, np)
        mocap = np.concatenate([data.mocap_pos, data.mocap_quat], axis=1)
        # NumPy arrays become constants of the programs that use them, on any device.
        arrays: Any = [np.array(x, np.float32) for x in (data.qpos, data.qvel, np.zeros(model.nv), act, ctrl, mocap)]
        bound.physics, bound.hold = Physics(*arrays[:4]), Controls(*arrays[4:])
        return bound

    def draw(self, key: PRNGKey) -> Array:
        """Draws an initial configuration [nq]."""
        qpos = jnp.asarray(self.physics.qpos)
        for number, (at, _, low, high) in enumerate(self.drawn):
            part = jax.random.uniform(jax.random.fold_in(key, number), low.shape, jnp.float32, low, high)
            qpos = qpos.at[at : at + len(low)].set(part)
        return qpos

    def held(self, physics: Physics) -> tuple[Physics, Controls]:
        """A drawn start with activations, and inputs, that hold it: the keyframe's if it has inputs or activations."""
        hold = jax.tree.map(jnp.asarray, self.hold)
        if self._given:
            return physics, hold
        ctrl, act = self._holding.at(physics.qpos)
        return dataclasses.replace(physics, act=act), dataclasses.replace(hold, ctrl=ctrl)

    def inputs_at(self, qpos: Array) -> Array:
        """Inputs [nu] with which servos hold a configuration. Other actuators get their inputs at the start."""
        return jnp.where(self._holding.servos, self._holding.at(qpos)[0], self.hold.ctrl)

    physics: Physics  # the start, with the middle of each range
    hold: Controls  # inputs that hold it
    drawn: list[Range]
    _holding: Holding
    _given: bool  # whether the keyframe has inputs or activations


def _places(model: mujoco.MjModel) -> list[tuple[str, tuple[int, int, np.ndarray, np.ndarray]]]:
    """Name of each free body, hinge and slide, with its first index in qpos and in qvel, and limits (3 numbers, or 1)."""
    places, free = [], mujoco.mjMAXVAL * np.array([[-1.0], [1.0]])  # MuJoCo takes larger positions for a divergence
    unlimited = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_LIMIT
    for i in range(model.njnt):
        kind, at = int(model.jnt_type[i]), (int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i]))
        if kind == FREE:
            places.append((names_of(model, "body")[model.jnt_bodyid[i]], (*at, *np.repeat(free, 3, axis=1))))
        elif kind in (HINGE, SLIDE):
            low, high = model.jnt_range[i, :, None] if model.jnt_limited[i] and not unlimited else free
            places.append((names_of(model, "joint")[i], (*at, low - 1e-6, high + 1e-6)))
    return places
