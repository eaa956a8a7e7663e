"""Open-loop replay of recorded episodes of the original hand tasks: how far do ours deviate?

    python bench/fidelity_hand.py [--engines native] [--tasks block_rotate_xyz egg_rotate pen_rotate hand_reach]

It replays the recorded actions from the recorded starts, without feedback, and prints a table. With all tasks on `native` it
writes the table into docs/fidelity.md (all of whose rows need `--engines native jax warp`). Tasks that an engine does not
support are left out. `--episodes` and `--steps` shorten it.

`record` plays the episodes. `yardstick` replays them in the original itself, with the start moved by 0.1 mm (0.1 mrad without
an object). Both need a separate virtual environment with an older MuJoCo:

    python -m venv .fetch && .fetch/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.11.0
    PYTHONPATH=. .fetch/bin/python bench/fidelity_hand.py record
    PYTHONPATH=. .fetch/bin/python bench/fidelity_hand.py yardstick

tests/data/hand_TASK.npz has E episodes of T steps, and every tenth state:

    action  (E, T, 20)         int8, in units of 1/127
    qpos    (E, T/10 + 1, nq)  joint angles, rad, then the object's position, m, and orientation (w, x, y, z)
    qvel    (E, nv)            at the start
    goal    (E, G)
    kind    (E,)               index into KINDS
    reward  (E, T)             int8, of the sparse reward
    starts  (R, 7), (R, 0)     the object's pose after R other resets
    goals   (R, G)             their goals
"""

import argparse
import sys
from typing import Any

import numpy as np
from fidelity import DATA, OPTIONS, load, make_original, moved_originals, put_into_document, yardstick

YARDSTICK = DATA / "hand_yardstick.csv"
BEGIN, END = "<!-- hands: begin -->", "<!-- hands: end -->"

TASKS = ("block_rotate_xyz", "egg_rotate", "pen_rotate", "hand_reach")
KINDS = ("random actions", "random postures", "small motions")
RESETS = 200
EPISODES = 15  # of each task, in turn of each kind
KEPT = 10  # steps between kept states
JOINTS = 24
# Errors are those at these times and, of the joints, the mean over the episode.
HEAD = (
    *("task", "actions", "run by", "joints, mrad: after 0.4 s", "mean"),
    *("object, mm: after 0.4 s", "after 2 s", "at the end"),
    *("turn, rad: after 0.4 s", "after 2 s", "at the end", "in hand agrees"),
)


def actions_of(recorded):
    """Recorded actions [E, T, 20], float32."""
    return (recorded["action"] / np.float32(127)).astype(np.float32)


def draw_actions(kind, steps, rng):
    """Actions [T, 20] as int8."""
    if kind == 0:
        chosen = rng.uniform(-1, 1, (steps, 20))
    elif kind == 1:
        chosen = np.repeat(rng.uniform(-1, 1, (steps // 10, 20)), 10, axis=0) + 0.1 * rng.normal(size=(steps, 20))
    else:
        chosen = 0.3 * np.repeat(rng.uniform(-1, 1, (steps // 5, 20)), 5, axis=0) + 0.05 * rng.normal(size=(steps, 20))
    return np.round(127 * np.clip(chosen, -1, 1)).astype(np.int8)


def short(error):
    """The median of errors, as text: "0.000" if it is rounding."""
    value = np.median(error)
    return f"{value:.3f}" if value < 1 else f"{value:.1f}"


def turn(a, b):
    """Angle in rad between orientations [..., 4]; q and -q are the same orientation."""
    return 2 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=-1)), 0, 1))


def figures(recorded, qpos, of):
    """Cells of HEAD from "joints" on: medians over episodes.

    Args:
      recorded: the task's episodes.
      qpos: [K, T/10 + 1, nq] of K replayed episodes.
      of: [K] indices of the replayed episodes.
    """
    there = recorded["qpos"][of][:, : qpos.shape[1]].astype(float)
    joints = 1e3 * np.abs(qpos - there)[..., :JOINTS].mean(axis=-1)
    late = min(5, qpos.shape[1] - 1)
    cells = [short(joints[:, 1]), short(joints.mean(axis=1))]
    if qpos.shape[2] == JOINTS:
        return (*cells, *[""] * 7)
    place = 1e3 * np.linalg.norm((qpos - there)[..., JOINTS : JOINTS + 3], axis=-1)
    angle = turn(qpos[..., JOINTS + 3 :], there[..., JOINTS + 3 :])
    held = [path[:, -1, JOINTS + 2] > 0.04 for path in (qpos, there)]
    for error in (place, angle):
        cells += [short(error[:, at]) for at in (1, late, -1)]
    return (*cells, f"{np.mean(held[0] == held[1]):.0%}")


# Our tasks.


def replay(env, recorded, episodes, steps):
    """Kept states [E, T/10 + 1, nq] of the recorded actions from the recorded starts."""
    import jax
    import jax.numpy as jnp

    def one(qpos, qvel, goal, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state.physics.qpos

        first = env.init_state(qpos, goal, qvel)
        return jnp.concatenate([qpos[None], jax.lax.scan(step, first, actions)[1][KEPT - 1 :: KEPT]])

    starts = (recorded["qpos"][:episodes, 0], recorded["qvel"][:episodes], recorded["goal"][:episodes])
    return np.asarray(jax.jit(jax.vmap(one))(*starts, actions_of(recorded)[:episodes, :steps]), float)


def report(tasks, engines, episodes, steps):
    """The table, as text."""
    from timing import table

    from mjx_dher import envs

    originals, rows = moved_originals(YARDSTICK), []
    for task in tasks:
        recorded, paths = load(f"hand_{task}"), {}
        for engine in engines:
            try:
                env: Any = envs.make(task, engine=engine, **OPTIONS.get(engine, {}))
            except ValueError as error:  # jax has no egg
                print(f"{task}: {error}", file=sys.stderr)
                continue
            name = f"{engine} {env.engine.path}" if engine == "warp" else engine
            paths[name] = replay(env, recorded, episodes, steps)
        for kind, name in enumerate(KINDS):
            of = np.flatnonzero(recorded["kind"][:episodes] == kind)
            if len(of):
                rows += [(task, name, engine, *figures(recorded, path[of], of)) for engine, path in paths.items()]
            rows += [row for row in originals if row[:2] == (task, name)]
    return table(HEAD, rows)


# The originals.


def record(seed=0):
    """Writes tests/data/hand_TASK.npz."""
    for task in TASKS:
        env, rng = make_original(task), np.random.default_rng(seed)
        # Coordinates that the original shares with ours. Its others belong to the drawn target.
        steps, nq, nv = (50, JOINTS, JOINTS) if task == "hand_reach" else (100, JOINTS + 7, JOINTS + 6)
        episodes = []
        for index in range(EPISODES):
            kind = index % len(KINDS)
            obs, _ = env.reset(seed=int(rng.integers(2**31)))
            action, reward = draw_actions(kind, steps, rng), np.zeros(steps, np.int8)
            start, qpos = env.data.qvel[:nv].copy(), [env.data.qpos[:nq].copy()]
            for step in range(steps):
                _, reward[step], *_ = env.step((action[step] / np.float32(127)).astype(np.float32))
                if step % KEPT == KEPT - 1:
                    qpos.append(env.data.qpos[:nq].copy())
            episodes.append({"action": action, "qpos": qpos, "qvel": start, "goal": obs["desired_goal"], "reward": reward})
        arrays: dict[str, Any] = {name: np.array([each[name] for each in episodes]) for name in episodes[0]}
        arrays = {name: x if x.dtype == np.int8 else x.astype(np.float32) for name, x in arrays.items()}
        resets = [(env.reset(seed=int(rng.integers(2**31)))[0], env.data.qpos[JOINTS:nq].copy())[::-1] for _ in range(RESETS)]
        arrays["starts"] = np.array([start for start, _ in resets], np.float32)
        arrays["goals"] = np.array([obs["desired_goal"] for _, obs in resets], np.float32)
        path = DATA / f"hand_{task}.npz"
        np.savez_compressed(path, kind=np.arange(EPISODES, dtype=np.int8) % len(KINDS), **arrays)
        print(task, path.stat().st_size, "bytes")


def replay_original(env, recorded, shift, rng):
    """Kept states [E, T/10 + 1, nq], alone in a tuple, in the original, from starts moved by `shift` in a random direction."""
    import mujoco

    paths = []
    nq, nv = recorded["qpos"].shape[2], recorded["qvel"].shape[1]
    moved = slice(JOINTS, JOINTS + 3) if nq > JOINTS else slice(0, JOINTS)
    for index, actions in enumerate(actions_of(recorded)):
        env.reset(seed=0)
        env.data.qpos[:nq], env.data.qvel[:nv] = recorded["qpos"][index, 0], recorded["qvel"][index]
        way = rng.normal(size=len(env.data.qpos[moved]))
        env.data.qpos[moved] += shift * way / np.linalg.norm(way) * (1 if nq > JOINTS else np.sqrt(len(way)))
        mujoco.mj_forward(env.model, env.data)
        path = [env.data.qpos[:nq].copy()]
        for step, action in enumerate(actions):
            env.step(action)
            if step % KEPT == KEPT - 1:
                path.append(env.data.qpos[:nq].copy())
        paths.append(path)
    return (np.array(paths),)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", nargs="?", choices=("report", "record", "yardstick"), default="report")
    parser.add_argument("--engines", nargs="+", choices=("native", "jax", "warp"), default=("native",))
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    if args.mode == "record":
        return record()
    if args.mode == "yardstick":
        return yardstick(YARDSTICK, HEAD, [(f"hand_{task}", "kind") for task in TASKS], KINDS, replay_original, figures)
    block = report(args.tasks, args.engines, args.episodes, args.steps)
    print(block)
    if set(args.tasks) == set(TASKS) and (args.episodes, args.steps) == (EPISODES, 100):
        put_into_document(block, BEGIN, END)


if __name__ == "__main__":
    main()
