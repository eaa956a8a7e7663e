"""Third-party models on each engine, compared with a loop over `mj_step`.

    python bench/third_party.py ant=ant.xml ur5e=ur5e.xml [--engines native warp jax] [--actions 2 50] [--allow-cpu]

Prints the largest distance of any coordinate from `mj_step` after each of these numbers of random controls, which are held for
10 timesteps each, of 4 environments. A model that an engine does not support has the reason instead. --allow-cpu runs warp
without a GPU.
"""

import argparse
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from timing import machine

from mjx_dher.envs.engines import Controls, Physics, make_engine

ENVS, SUBSTEPS = 4, 10


def inputs(model: mujoco.MjModel, actions: int) -> tuple[mujoco.MjData, np.ndarray]:
    """The start, and controls [ENVS, actions, nu] within their ranges.

    The start is the first keyframe, or else the default, with joints that are out of range in the middle of their range.
    """
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    for joint in np.flatnonzero(model.jnt_limited & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))):
        at, (lowest, highest) = model.jnt_qposadr[joint], model.jnt_range[joint]
        if not lowest <= data.qpos[at] <= highest:
            data.qpos[at] = 0.5 * (lowest + highest)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    return data, np.random.default_rng(0).uniform(low, high, (ENVS, actions, model.nu)).astype(np.float32)


def looped(model: mujoco.MjModel, actions: int) -> np.ndarray:
    """Coordinates [actions, ENVS, nq] of a loop over `mj_step`."""
    qpos = np.zeros((actions, ENVS, model.nq))
    for env in range(ENVS):
        data, ctrl = inputs(model, actions)
        for action in range(actions):
            data.ctrl[:] = ctrl[env, action]
            mujoco.mj_step(model, data, SUBSTEPS)
            qpos[action, env] = data.qpos
    return qpos


def played(model: mujoco.MjModel, engine: str, actions: int, **options: Any) -> tuple[str, np.ndarray]:
    """The engine, or the path of warp, and its coordinates [actions, ENVS, nq]."""
    made = make_engine(engine, model, SUBSTEPS, **options)
    data, ctrl = inputs(model, actions)
    arrays = (jnp.asarray(x, jnp.float32) for x in (data.qpos, data.qvel, np.zeros(model.nv), data.act))
    mocap = jnp.asarray(np.concatenate([data.mocap_pos, data.mocap_quat], axis=1), jnp.float32)
    physics = jax.tree.map(lambda x: jnp.broadcast_to(x, (ENVS, *x.shape)), Physics(*arrays))
    advance = jax.jit(jax.vmap(lambda state, u: made.advance(state, Controls(u, mocap))))
    qpos = []
    for action in range(actions):
        physics = advance(physics, jnp.asarray(ctrl[:, action]))
        qpos.append(np.asarray(physics.qpos))
    made.check()
    return getattr(made, "path", engine), np.stack(qpos)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="NAME=MJCF")
    parser.add_argument("--engines", nargs="+", default=["native", "warp", "jax"])
    parser.add_argument("--actions", nargs="+", type=int, default=[2])
    parser.add_argument("--allow-cpu", action="store_true")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"\n{machine()}\n\n| model | nv | {' | '.join(args.engines)} |\n|{'---|' * (2 + len(args.engines))}", flush=True)
    for text in args.models:
        name, _, path = text.partition("=")
        model = mujoco.MjModel.from_xml_path(path)
        expected, cells = looped(model, max(args.actions)), []
        for engine in args.engines:
            try:
                options = {"allow_cpu": True} if engine == "warp" and args.allow_cpu else {}
                seen, qpos = played(model, engine, max(args.actions), **options)
                apart = np.abs(qpos - expected).max(axis=(1, 2))
                cells.append(", ".join([*(f"{apart[n - 1]:.0e}" for n in args.actions), *([seen] if engine == "warp" else [])]))
            except ValueError as error:
                cells.append(f"no: {error}")
        print(f"| {name} | {model.nv} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
