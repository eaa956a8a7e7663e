"""Environment steps a second of the hand tasks: `native` here against one process of the original.

    python bench/hand_speed.py --python .fetch/bin/python [--tasks block_rotate_xyz egg_rotate hand_reach] [--num-envs 32]

Both play whole episodes of random actions, resets included, and take turns. `--python` is an environment that has the
originals (bench/fidelity_hand.py). The rate for each second of one core's time does not depend on other programs.
"""

import argparse
import json
import os
import subprocess
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
TASKS = ("block_rotate_xyz", "egg_rotate", "pen_rotate", "hand_reach")
ROUNDS, EPISODES = 3, 4


def rates(play, steps):
    """Steps for each second, and for each second of a core."""
    begin, core = time.perf_counter(), time.process_time()
    play()
    return steps / (time.perf_counter() - begin), steps / (time.process_time() - core)


def original(task):
    """Prints the rates of the original, which this process plays."""
    import numpy as np
    from fidelity import make_original

    env = make_original(task)
    length, rng = 50 if task == "hand_reach" else 100, np.random.default_rng(0)
    env.reset(seed=0)

    def play():
        for _ in range(EPISODES):
            env.reset()
            for _ in range(length):
                env.step(rng.uniform(-1, 1, 20).astype(np.float32))

    print(json.dumps(rates(play, EPISODES * length)))


def ours(task, num_envs):
    """A function that gives the rates of `native`."""
    import jax

    from mjx_dher import envs
    from mjx_dher.rollout import rollout

    env = envs.make(task, engine="native")

    @jax.jit
    def play(key):
        actions = jax.random.uniform(key, (env.episode_length, num_envs, env.action_size), minval=-1.0)
        return rollout(env, lambda action, obs: action, key, num_envs, actions)[1].ret

    jax.block_until_ready(play(jax.random.key(0)))
    return lambda: rates(lambda: jax.block_until_ready(play(jax.random.key(1))), num_envs * env.episode_length)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", type=Path)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--original", choices=TASKS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.original:
        return original(args.original)
    if args.python is None:
        parser.error("--python must name a Python that has the originals")
    from timing import print_table

    rows = []
    for task in args.tasks:
        here, command = ours(task, args.num_envs), [str(args.python), __file__, "--original", task]
        played = []
        for _ in range(ROUNDS):
            done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, check=True)
            played.append((*here(), *json.loads(done.stdout.splitlines()[-1])))
        wall, core, wall_there, core_there = (sorted(column)[ROUNDS // 2] for column in zip(*played))
        ratios = f"{wall / wall_there:.1f}", f"{core / core_there:.2f}"
        rows.append((task, *(f"{rate:,.0f}" for rate in (wall, wall_there, core, core_there)), *ratios))
    head = ("task", "native, steps/s", "original", "native, for each second of a core", "original", "ratio", "for each core")
    print_table(head, rows)


if __name__ == "__main__":
    main()
