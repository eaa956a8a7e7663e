"""Cheap checks of a model before training: stability, and reachable goals."""

import copy
import warnings
from collections.abc import Sequence

import mujoco
import numpy as np

from mjx_dher.envs.goals import Goal
from mjx_dher.envs.kinematics import HINGE, SLIDE, Place, names_of
from mjx_dher.envs.simulated import Range

_SECONDS = 1.0  # most seconds to simulate
_OVERLAP = 0.02  # m
_ATTEMPTS, _ITERATIONS = 5, 40
_BAD = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")


def check_stable(model: mujoco.MjModel, qpos: np.ndarray, ctrl: np.ndarray, seconds: float) -> None:
    """Simulates the start for up to `seconds`, first held by the inputs `ctrl` [nu] and then under random inputs. Raises
    ValueError if the simulation diverges. The message names the joint.
    """
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # which would set the numbers of warnings to 0
    rng = np.random.default_rng(0)
    finite = np.isfinite(model.actuator_ctrlrange) & model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(finite, model.actuator_ctrlrange, 0.0).T
    inputs = {"held at the start": ctrl, "under random inputs": rng.uniform(low, high)}
    for what, held in inputs.items():
        data = _fresh(model, qpos)
        data.ctrl[:] = held
        for _ in range(int(min(seconds, _SECONDS) / model.opt.timestep)):
            mujoco.mj_step(model, data)
            for name in _BAD:
                if data.warning[getattr(mujoco.mjtWarning, name)].number > 1:
                    dof = int(data.warning[getattr(mujoco.mjtWarning, name)].lastinfo)
                    joint = names_of(model, "joint")[model.dof_jntid[min(dof, model.nv - 1)]]
                    raise ValueError(
                        f"unstable model: joint {joint!r} diverges, {what}; a smaller timestep, more damping or armature, or"
                        " a start without overlapping geoms can help"
                    )


def check_overlaps(model: mujoco.MjModel, qpos: np.ndarray, drawn: Sequence[Range]) -> None:
    """Warns if geoms overlap by more than 2 cm at the start `qpos` [nq], or in some of 32 that are `drawn`."""
    rng, data = np.random.default_rng(0), _fresh(model, qpos)
    deepest, number = None, 0
    for _ in range(32 if drawn else 1):
        for at, _, low, high in drawn:
            data.qpos[at : at + len(low)] = rng.uniform(low, high)
        mujoco.mj_fwdPosition(model, data)
        over = [(contact.dist, tuple(contact.geom)) for contact in data.contact if contact.dist < -_OVERLAP]
        number += bool(over)
        deepest = min(filter(None, (deepest, min(over, default=None))), default=None)
    if deepest:
        dist, geoms = deepest
        names = [model.geom(geom).name or names_of(model, "body")[model.geom_bodyid[geom]] for geom in geoms]
        share = f", and geoms do in {number / 32:.0%} of the starts" if drawn else ""
        warnings.warn(f"{names[0]!r} and {names[1]!r} overlap by {-dist:.2g} m at the start{share}", stacklevel=2)


def _fresh(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """Data whose numbers of warnings are 1: MuJoCo prints and logs the first one."""
    data = mujoco.MjData(model)
    for warning in data.warning:
        warning.number = 1
    data.qpos[:] = qpos
    return data


def check_reachable(model: mujoco.MjModel, start: np.ndarray, goal: Goal) -> None:
    """Searches for poses that reach some goals, from the configuration `start` [nq], and warns if many are missed.

    Goals of bodies that a free or ball joint moves are not tested. Raises ValueError if no goal is reached, or no joint moves
    the site or body.
    """
    place = goal.place
    if place is not None and not place.joints:
        raise ValueError(f"goal: no joint moves {place.name!r}")
    if place is None or goal.low is None or not all(joint.kind in (HINGE, SLIDE) for joint in place.joints):
        return
    goals = np.random.default_rng(0).uniform(goal.low, goal.high, (8, 3))
    missed = np.array([_distance(model, start, place, each) for each in goals])
    if (missed > goal.threshold).all():
        raise ValueError(
            f"goal: no pose brings {place.name!r} to the goals from {goal.low} to {goal.high}; the nearest miss them by"
            f" {missed.min():.3g} m, and the threshold is {goal.threshold:g} m"
        )
    if (missed > goal.threshold).mean() > 0.2:
        warnings.warn(f"no pose brings {place.name!r} to {(missed > goal.threshold).mean():.0%} of the goals", stacklevel=2)


def _distance(model: mujoco.MjModel, start: np.ndarray, place: Place, goal: np.ndarray) -> float:
    """Distance in m at which inverse kinematics from a few configurations ends."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    dofs = [joint.qvel for joint in place.joints]  # hinges and slides have one each
    joints = model.dof_jntid[dofs]
    limited, slides = model.jnt_limited[joints].astype(bool), model.jnt_type[joints] == SLIDE
    low, high = np.where(limited, model.jnt_range[joints].T, [[-np.pi], [np.pi]])
    ends = np.where(slides & ~limited, [[-np.inf], [np.inf]], [low, high])
    most = np.where(slides, np.inf, 0.3)  # of a step; turns are linear over less
    at, jacobian, best = model.jnt_qposadr[joints], np.zeros((3, model.nv)), np.inf
    for attempt in range(_ATTEMPTS):
        data.qpos[:] = start
        if attempt:
            data.qpos[at] = rng.uniform(low, high)
        for _ in range(_ITERATIONS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            point = data.xpos[place.body] + data.xmat[place.body].reshape(3, 3) @ place.offset[0]
            error = goal - point
            best = min(best, float(np.linalg.norm(error)))
            mujoco.mj_jac(model, data, jacobian, None, point, place.body)
            part = jacobian[:, dofs]
            step = part.T @ np.linalg.solve(part @ part.T + 1e-4 * np.eye(3), error)
            data.qpos[at] = np.clip(data.qpos[at] + np.clip(step, -most, most), *ends)
        if best < 1e-3:
            break
    return best
