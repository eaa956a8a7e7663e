"""Does the physics survive extreme actions? Whole episodes of random actions, each coordinate -1 or 1.

    python bench/bang_bang.py [--tasks TASK ...] [--engine native] [--actions 1000000] [--num-envs 200] [--each-action]

The table has one row per task: episodes whose physics blew up (and was reset), the greatest speeds of the object and of a joint
after any action, the share of states with two geoms more than 5 mm inside each other, and the deepest penetration. States are
those at the end of episodes, or with --each-action those after each action. The exit status is 1 for a value that is not
finite, an object faster than 10 m/s, or a penetration beyond 5 cm.

The contacts are as soft as the original's. In six tries of slamming from above, the original's cube sinks up to 50 mm into the
table (47 mm here), and its puck up to 45 mm. Slide on native exits with 1: in 20,000 episodes its puck once sinks 63 mm
(bench/slams.md).
"""

import argparse
import itertools
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


def play(env, num_envs, sparse=True):
    """key -> (qpos [S, N, nq], failed [N], greatest speeds [N] of the object, m/s, and of a joint, m/s or rad/s)

    S is the number of actions, or 1, the last, if `sparse`.
    """
    begin = env._object.qvel if env.has_object else env.model.nv

    def step(state, action):
        state = jax.vmap(env.step)(state, action)
        qvel = state.physics.qvel
        joints = jnp.abs(jnp.delete(qvel, np.arange(begin, env.model.nv)[:6], axis=1)).max(axis=1)
        return state, (jnp.linalg.norm(qvel[:, begin : begin + 3], axis=-1), joints, () if sparse else state.physics.qpos)

    @jax.jit
    def episodes(key):
        reset_key, action_key = jax.random.split(key)
        state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
        signs = jax.random.rademacher(action_key, (env.episode_length, num_envs, env.action_size), jnp.float32)
        state, (speed, joints, qpos) = jax.lax.scan(step, state, signs)
        return state.physics.qpos[None] if sparse else qpos, state.failed, speed.max(axis=0), joints.max(axis=0)

    return episodes


def penetration(model, qpos):
    """Depth [...] in m of the deepest contact in each state [..., nq], computed by MuJoCo C for every engine."""
    data, depths = mujoco.MjData(model), []
    for row in qpos.reshape(-1, model.nq):
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        depths.append((-data.contact.dist).max(initial=0.0))
    return np.array(depths).reshape(qpos.shape[:-1])


def rounds(env, num_envs, sparse, seed=0):
    """Yields, of `num_envs` episodes each: whether they are finite and failed [N], greatest speeds [N], depths [S, N] in m."""
    episodes, key = play(env, num_envs, sparse), jax.random.key(seed)
    for index in itertools.count():
        qpos, failed, speed, joints = jax.device_get(episodes(jax.random.fold_in(key, index)))
        yield np.isfinite(qpos).all(axis=(0, 2)), failed, speed, joints, penetration(env.model, qpos)


def row(env, parts):
    """The table's row of a task with these rounds, and whether it is within the bounds."""
    finite, blew_up, speed, joints, depth = (np.concatenate(part, axis=-1) for part in zip(*parts))
    cells = (
        env.name,
        env.engine.name,
        f"{depth.shape[1] * env.episode_length:,}",
        int(blew_up.sum()),
        f"{speed.max():.2f}",
        f"{joints.max():.1f}",
        f"{np.mean(depth > DEEP):.2%}",
        f"{1e3 * depth.max():.1f}",
    )
    return cells, bool(finite.all()) and speed.max() <= MAX_SPEED and depth.max() <= MAX_PENETRATION


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--engine", default="native")
    parser.add_argument("--actions", type=int, default=1_000_000)
    parser.add_argument("--num-envs", type=int, default=200)
    parser.add_argument("--each-action", action="store_true", help="measure depths after each action, not only at the end")
    args = parser.parse_args()
    results = []
    for task in args.tasks:
        env = envs.make(task, engine=args.engine)
        count = -(-args.actions // (args.num_envs * env.episode_length))
        results.append(row(env, itertools.islice(rounds(env, args.num_envs, not args.each_action), count)))
    head = ("task", "engine", "actions", "blew up", "object's speed, at most, m/s", "joint's, m/s or rad/s")
    print_table((*head, "deeper than 5 mm", "deepest, mm"), [row for row, _ in results])
    return 0 if all(good for _, good in results) else 1


if __name__ == "__main__":
    sys.exit(main())
