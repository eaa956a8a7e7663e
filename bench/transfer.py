"""Zero-shot transfer: plays a trained policy in the original Fetch task, unchanged.

The original needs a MuJoCo older than ours, so it runs in an environment of its own; the policy needs NumPy alone:

    python -m venv .fetch && .fetch/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.11.0
    PYTHONPATH=. .fetch/bin/python bench/transfer.py RUN [--episodes 300]
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np

from mjx_dher.policy import load_policy
from mjx_dher.run_folder import read_config
from mjx_dher.stats import wilson_interval

ORIGINALS = {
    "push": "FetchPush-v4",
    "pick_and_place": "FetchPickAndPlace-v4",
    "slide": "FetchSlide-v4",
    "reach": "FetchReach-v4",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1000, help="of the first episode; the next ones follow")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    import gymnasium as gym
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    name = ORIGINALS[read_config(args.run).config.env]
    env, policy = gym.make(name), load_policy(args.run)
    successes = at_reset = 0
    for episode in range(args.episodes):
        obs, _ = env.reset(seed=args.seed + episode)
        at_reset += int(np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) < 0.05)
        ended, info = False, {}
        while not ended:
            obs, _, _, ended, info = env.step(policy(obs))
        successes += int(info["is_success"])
    low, high = wilson_interval(successes, args.episodes)
    print(
        f"{name}: success {successes / args.episodes:.3f} (95 % interval {low:.3f} to {high:.3f}, {args.episodes} episodes);"
        f" already at reset {at_reset / args.episodes:.3f}"
    )


if __name__ == "__main__":
    main()
