"""Does the physics survive extreme actions? Whole episodes of random actions, each coordinate -1 or 1.

    python bench/bang_bang.py [--tasks TASK ...] [--engine native] [--actions 1000000] [--num-envs 200]

The table has one row per task: episodes whose physics blew up (and was reset), the object's greatest speed after any step, the
share of episodes that end with two geoms more than 5 mm inside each other, and the deepest penetration. The exit status is 1
if an episode ended with a value that is not finite, an object faster than 10 m/s, or a penetration beyond 5 cm.

The contacts are as soft as the original's. In six tries of slamming from above, the original's cube sinks up to 50 mm into the
table (47 mm here), and its puck up to 45 mm. Slide on native exits with 1: in 20,000 episodes its puck once sinks 63 mm
(bench/slams.md).
"""

from __future__ import annotations

import argparse
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from timing import print_table

from mjx_dher import envs

TASKS = ["reach", "push", "pick_and_place", "slide", "hand_reach", "block_rotate_xyz", "egg_rotate", "pen_rotate"]
MAX_SPEED = 10.0  # m/s
MAX_PENETRATION = 0.05  # m
DEEP = 0.005  # m


def play(env, num_envs):
    """key -> (qpos [N, nq] at the end, failed [N], greatest object speed [N] after any step, m/s)"""

    def step(state, action):
        state = jax.vmap(env.step)(state, action)
        speed = jnp.zeros(num_envs)
        if env.has_object:
            begin = env._object.qvel
            speed = jnp.linalg.norm(state.physics.qvel[:, begin : begin + 3], axis=-1)
        return state, speed

    @jax.jit
    def episodes(key):
        reset_key, action_key = jax.random.split(key)
        state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
        signs = jax.random.rademacher(action_key, (env.episode_length, num_envs, env.action_size), jnp.float32)
        state, speed = jax.lax.scan(step, state, signs)
        return state.physics.qpos, state.failed, speed.max(axis=0)

    return episodes


def penetration(model, qpos):
    """Depth [N] in m of the deepest contact in each state, computed by MuJoCo C for every engine."""
    data, depths = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        depths.append((-data.contact.dist).max(initial=0.0))
    return np.array(depths)


def survive(task, engine, actions, num_envs, seed=0):
    """The table's row of a task, and whether it is within the bounds."""
    env = envs.make(task, engine=engine)
    episodes, key = play(env, num_envs), jax.random.key(seed)
    rounds = -(-actions // (num_envs * env.episode_length))
    played = [jax.device_get(episodes(jax.random.fold_in(key, index))) for index in range(rounds)]
    qpos, blew_up, speed = (np.concatenate(part) for part in zip(*played))
    depth = penetration(env.model, qpos)
    row = (
        task,
        env.engine.name,
        f"{len(qpos) * env.episode_length:,}",
        int(blew_up.sum()),
        f"{speed.max():.2f}",
        f"{np.mean(depth > DEEP):.2%}",
        f"{1e3 * depth.max():.1f}",
    )
    return row, bool(np.isfinite(qpos).all()) and speed.max() <= MAX_SPEED and depth.max() <= MAX_PENETRATION


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--engine", default="native")
    parser.add_argument("--actions", type=int, default=1_000_000)
    parser.add_argument("--num-envs", type=int, default=200)
    args = parser.parse_args()
    results = [survive(task, args.engine, args.actions, args.num_envs) for task in args.tasks]
    head = ("task", "engine", "actions", "blew up", "object's speed, at most, m/s", "end deeper than 5 mm", "deepest, mm")
    print_table(head, [row for row, _ in results])
    return 0 if all(good for _, good in results) else 1


if __name__ == "__main__":
    sys.exit(main())
