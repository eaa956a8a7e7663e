"""Environment steps per second through gymnasium, with random actions, resets included: one environment, and many in parallel.

    python bench/gym_views.py [--tasks FetchPush FetchReach] [--num-envs 32]

For the same without gymnasium, with a policy network, see throughput.py.
"""

import argparse
import time

import gymnasium
import numpy as np
from timing import median_seconds, print_table

EPISODES = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["FetchPush", "FetchReach"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[32])
    args = parser.parse_args()
    rows = []
    for task in args.tasks:
        env = gymnasium.make(f"mjx_dher.gym:mjx_dher/{task}-v0")
        rows.append((task, "make", 1, *measure(env, 1)))
        for num_envs in args.num_envs:
            many = gymnasium.make_vec(f"mjx_dher/{task}-v0", num_envs=num_envs, vectorization_mode="vector_entry_point")
            rows.append((task, "make_vec", num_envs, *measure(many, num_envs)))
    print_table(("task", "made by", "num_envs", "env steps/s", "first reset and step, s"), rows)


def measure(env, num_envs: int) -> tuple[str, str]:
    """Steps per second over whole episodes (resets are timed but not counted), and seconds until it is compiled."""
    actions = np.random.default_rng(0).uniform(-1, 1, (50, *env.action_space.shape)).astype(np.float32)
    start = time.perf_counter()
    env.reset(seed=0)
    env.step(actions[0])
    compiled = time.perf_counter() - start

    def play():
        for _ in range(EPISODES):
            env.reset()
            for action in actions:
                env.step(action)

    seconds = median_seconds(play, repeats=5)
    return f"{EPISODES * len(actions) * num_envs / seconds:,.0f}", f"{compiled:.1f}"


if __name__ == "__main__":
    main()
