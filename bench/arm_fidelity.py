"""Compares the arm tasks with JaxGCRL's: the compiled models, and episodes of random actions in both.

Run it in the environment of `bench/peer_envs.py`: python bench/arm_fidelity.py [TASK ...] [--steps 100] [--episodes 8]
"""

import argparse
import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import peer_envs

from mjx_dher import envs
from mjx_dher.envs import arms

TASKS = ("arm_reach", "arm_push_easy", "arm_push_hard", "arm_grasp", "arm_binpick_easy")
NAMES = {"left_finger": "finger_joint1", "right_finger": "finger_joint2"}  # of their joints
BODY = ("pos", "quat", "mass", "ipos")
JOINT = ("type", "axis", "pos", "limited", "damping", "stiffness", "frictionloss")  # not armature: see envs/arms.py
WHOLE = (
    *("gainprm", "biasprm", "ctrlrange", "forcerange", "gear", "ctrllimited", "forcelimited", "biastype", "dyntype"),
    *("eq_data", "eq_solref", "eq_solimp"),
    *("pair_dim", "pair_friction", "pair_solref", "pair_solimp", "pair_margin", "pair_gap"),
)


def model_differences(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> list[str]:
    """Fields that differ by more than 1e-7; bodies and joints by name."""
    different = []

    def compare(what: str, a, b) -> None:
        a, b = (np.asarray(x, float) for x in (a, b))
        if a.shape != b.shape or np.abs(a - b).max(initial=0.0) > 1e-7:
            different.append(what)

    for i in range(1, ours.nbody):
        body, other = ours.body(i), theirs.body(ours.body(i).name)
        for field in BODY:
            compare(f"{body.name} {field}", getattr(body, field), getattr(other, field))
        compare(f"{body.name} inertia", _inertia(ours, i), _inertia(theirs, other.id))
    for i in range(ours.njnt):
        if name := ours.joint(i).name:
            joint, other = ours.joint(i), theirs.joint(NAMES.get(name, name))
            for field in JOINT:
                compare(f"{name} {field}", getattr(joint, field), getattr(other, field))
            if joint.limited[0]:
                compare(f"{name} range", joint.range, other.range)
    for field in WHOLE:
        name = field if "_" in field else f"actuator_{field}"
        compare(name, getattr(ours, name), getattr(theirs, name))
    for field in ("cone", "impratio", "gravity"):
        compare(field, getattr(ours.opt, field), getattr(theirs.opt, field))
    if _pairs(ours) != _pairs(theirs):
        different.append("pairs")
    return different


def _inertia(model: mujoco.MjModel, body: int) -> np.ndarray:
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[body])
    mat = flat.reshape(3, 3)
    return mat @ np.diag(model.body_inertia[body]) @ mat.T


def _pairs(model: mujoco.MjModel) -> list[list[tuple]]:
    """Pairs of geoms, by their bodies, sizes and places."""

    def geom(i: int) -> tuple:
        place = tuple(np.round([*model.geom_size[i], *model.geom_pos[i], *model.geom_quat[i]], 6))
        return (model.body(model.geom_bodyid[i]).name, *place)

    return sorted(sorted([geom(i), geom(j)]) for i, j in zip(model.pair_geom1, model.pair_geom2))


def play(name: str, theirs, steps: int, episodes: int, engine: str) -> np.ndarray:
    """Root mean square differences [steps + 1, D] of observations under the same actions, from their starts."""
    ours: Any = envs.make(name, engine=engine)  # Any: a GoalEnv need not have a first_state
    marker = slice(0, 7) if name == "arm_reach" else slice(7, 14)
    actions = jax.random.uniform(jax.random.key(1), (steps, episodes, ours.action_size), minval=-1.0, maxval=1.0)
    actions = jnp.repeat(actions[::5], 5, axis=0)[:steps]  # held for five steps, so that the arm gets somewhere
    their_state = jax.jit(jax.vmap(theirs.reset))(jax.random.split(jax.random.key(0), episodes))
    qpos = np.delete(np.asarray(their_state.inner.pipeline_state.q), np.arange(200)[marker], axis=1)
    if name == "arm_grasp":
        qpos = np.delete(qpos, [15, 17], axis=1)  # joints of the fingertips
    state = jax.jit(jax.vmap(ours.reset))(jax.random.split(jax.random.key(0), episodes))
    physics = dataclasses.replace(state.physics, qpos=jnp.asarray(qpos, jnp.float32))
    state = jax.jit(jax.vmap(ours.first_state))(physics, state.obs["desired_goal"])

    def episode(env, state):
        def step(state, action):
            following = jax.vmap(env.step)(state, action)
            return following, following.obs["observation"]

        later = jax.jit(lambda state: jax.lax.scan(step, state, actions)[1])(state)
        return np.concatenate([state.obs["observation"][None], later])

    a, b = episode(theirs, their_state), episode(ours, state)
    return np.sqrt(np.mean(np.square(a - b), axis=1))


def main() -> None:
    """Prints a line for each task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--engine", default="native")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    for name in args.tasks:
        theirs = peer_envs.jaxgcrl_arm(name)
        kind = getattr(arms, type(theirs.env).__name__)
        print(name, "models differ in:", ", ".join(model_differences(kind(engine="native").model, theirs.model)) or "nothing")
        ours = kind(engine="native")
        apart = play(name, theirs, args.steps, args.episodes, args.engine)
        for step in (0, 1, 5, 20, 50, args.steps):
            parts = {text: float(np.sqrt(np.mean(np.square(apart[step, at])))) for text, at in ours.layout.items()}
            print(f"  after {step} steps:", ", ".join(f"{text} {value:.2g}" for text, value in parts.items()), flush=True)


if __name__ == "__main__":
    main()
