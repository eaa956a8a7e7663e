"""Open-loop replay of recorded episodes of the original task: how far does the rebuilt one stray?

    python bench/fidelity.py [--engine native] [--tasks push pick_and_place slide]

Starts, goals and actions are those of tests/data/fetch_TASK.npz (see tests/data/README.md); nothing is fed back in 50 steps.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from timing import print_table

from mjx_dher import envs

DATA = Path(__file__).parent.parent / "tests" / "data"
KINDS = ("random actions", "script with noise", "script")
MOVED = 0.02  # m


def replay(env, recorded):
    """(grip, object) positions [E, T+1, 3] of the recorded actions from the recorded starts."""

    def one(object_qpos, desired_goal, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state.obs["observation"][:6]

        first = env.init_state(object_qpos, desired_goal)
        _, path = jax.lax.scan(step, first, actions)
        return jnp.concatenate([first.obs["observation"][None, :6], path])

    path = np.asarray(jax.jit(jax.vmap(one))(recorded["object_qpos"][:, 0], recorded["goal"], recorded["action"]))
    return path[..., :3], path[..., 3:]


def compare(task, engine):
    """Table rows of one task, a row for each kind of episode."""
    with np.load(DATA / f"fetch_{task}.npz") as file:
        recorded = {name: file[name] for name in file.files}
    grip, obj = replay(envs.make(task, engine=engine), recorded)
    grip_error = 1e3 * np.linalg.norm(grip - recorded["grip"], axis=-1)
    object_error = 1e3 * np.linalg.norm(obj[:, -1] - recorded["achieved"][:, -1], axis=-1)

    def moved(path):
        return np.linalg.norm(path[:, -1] - path[:, 0], axis=-1) > MOVED

    def succeeded(path):
        return np.linalg.norm(path[:, -1] - recorded["goal"], axis=-1) < 0.05

    same_moved = moved(obj) == moved(recorded["achieved"])
    same_success = succeeded(obj) == succeeded(recorded["achieved"])
    for kind, name in enumerate(KINDS):
        of = recorded["policy"] == kind
        yield (
            task,
            name,
            f"{grip_error[of].mean():.1f}",
            f"{np.percentile(grip_error[of], 95):.0f}",
            f"{np.median(object_error[of]):.1f}",
            f"{np.percentile(object_error[of], 95):.0f}",
            f"{same_moved[of].mean():.0%}",
            f"{same_success[of].mean():.0%}",
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--tasks", nargs="+", default=["push", "pick_and_place", "slide"])
    args = parser.parse_args()
    rows = [row for task in args.tasks for row in compare(task, args.engine)]
    head = ("task", "episodes", "grip, mean", "p95", "object at the end, median", "p95", "moved agrees", "success agrees")
    print_table(head, rows)


if __name__ == "__main__":
    main()
