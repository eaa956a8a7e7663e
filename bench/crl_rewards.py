"""Both reward conventions for HER, and success at any step and time at the goal, beside contrastive RL.

    python bench/crl_rewards.py --out rewards --first-seed 20 --plan
    python bench/crl_rewards.py --out rewards --first-seed 20 --minutes 12   trains, plays and reports; run it again to resume
    python bench/crl_rewards.py --out toy --toy --seeds 2   the same on Reach, on a CPU

It is bench/bakeoff.py with other arms, and has its options. When all runs have ended, it plays each policy for 500 episodes
and writes rewards_played.csv. docs/experiments/crl.md has the plan.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import bakeoff
import crl
import jax
import jax.numpy as jnp
import numpy as np
from bakeoff_arms import Arm, Experiment

from mjx_dher.cli.common import make_env
from mjx_dher.envs.arms import ArmPushEasy
from mjx_dher.envs.fetch import PickAndPlace, Reach
from mjx_dher.policy import Policy
from mjx_dher.policy.load import load_plain
from mjx_dher.rollout import record_rollout
from mjx_dher.runs.folder import reading
from mjx_dher.spec import RunSpec
from mjx_dher.stats import first_reach
from mjx_dher.sweeps import grid, tables
from mjx_dher.system import files
from mjx_dher.types import Array, EnvSpec

EPISODES, SEED, THRESHOLD = 500, 1, 0.5
CURVE = ("env_steps", "success_rate", "wall_seconds")
ARRAYS = ("layers", "observation_mean", "observation_std", "goal_mean", "goal_std")


class Positive:
    """Rewards of 1 at the goal and 0 elsewhere, in place of 0 and -1."""

    reached: Any

    @property
    def spec(self) -> EnvSpec:
        """The task's contract, with rewards in [0, 1]."""
        return dataclasses.replace(super().spec, reward_range=(0.0, 1.0))  # type: ignore[misc]

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards [...] of goals [..., G]."""
        return self.reached(achieved_goal, desired_goal).astype(jnp.float32)


class PositiveReach(Positive, Reach):
    """Reach with these rewards."""


class PositivePickAndPlace(Positive, PickAndPlace):
    """PickAndPlace with these rewards."""


class PositiveArmPushEasy(Positive, ArmPushEasy):
    """JaxGCRL's arm_push_easy with these rewards."""


POSITIVE = {
    "reach": "crl_rewards:PositiveReach",  # of the toy
    "pick_and_place": "crl_rewards:PositivePickAndPlace",
    "arm_push_easy": "crl_rewards:PositiveArmPushEasy",
}
SETTINGS = {arm.name: arm for arm in crl.ARMS if arm.name in ("crl", "sac_k4", "sac_final", "tqc_k4", "tqc_final")}
ARMS = (Arm("negative", "negative"), Arm("positive", "positive"))


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of a setting of bench/crl.py with the arm's rewards, seed 0. `crl` reads none, so its two runs differ by chance."""
    task = "reach" if toy else task
    run = crl.spec_of("equal", task, SETTINGS[learner], toy)
    return dataclasses.replace(run, env=POSITIVE[task] if arm.name == "positive" else task)


def minutes(learners: tuple[str, ...], tasks: tuple[str, ...], arms: tuple[Arm, ...], seeds: int) -> float:
    """Estimated minutes of one H100, compilation included."""
    return len(arms) * sum(crl.minutes(("equal",), tasks, (SETTINGS[name],), seeds) for name in learners)


REWARDS = Experiment(ARMS, tuple(SETTINGS), ("arm_push_easy", "pick_and_place"), spec_of, minutes, "rewards.csv")


class Played(NamedTuple):
    """A run's policy at play, and its way to success."""

    learner: str
    task: str
    rewards: str
    seed: int
    last: float  # share of episodes with success in the last state
    any_step: float  # ... in any state after the first
    time_at_goal: float  # share of the states after the first
    at_reset: float
    steps: float  # environment steps at the first evaluation with THRESHOLD; infinite where there is none
    seconds: float  # of training until then, with all runs of its program


def play(folder: Path, run: RunSpec, plays: dict[str, Any]) -> tuple[float, float, float, float]:
    """Success in the last state, in any, time at the goal and success at the reset, each in [0, 1], of a run's policy.

    `plays` keeps one compiled program for each task.
    """
    policy = load_plain(folder, "this script")
    if run.env not in plays:
        env = make_env(run)

        def episodes(arrays: dict[str, Any], key: Array) -> tuple[Array, Array]:
            own: Policy = dataclasses.replace(policy, **arrays)
            act = lambda _, obs: own.forward(obs["observation"], obs["desired_goal"], jnp)  # noqa: E731
            _, outcome, success = record_rollout(env, act, key, EPISODES, lambda state: state.success)
            return success, outcome.valid

        plays[run.env] = jax.jit(episodes)
    arrays = {name: getattr(policy, name) for name in ARRAYS}
    success, valid = map(np.asarray, plays[run.env](arrays, jax.random.key(SEED)))
    success = np.where(valid[:, None], success, 0.0)  # [episodes, T + 1]
    after = success[:, 1:]
    return float(after[:, -1].mean()), float(after.max(1).mean()), float(after.mean()), float(success[:, 0].mean())


def played(out: Path, tasks: Iterable[str], toy: bool) -> list[Played]:
    """Rows of all runs that have ended."""
    rows, plays = [], dict[str, Any]()
    for task in tasks:
        for learner in SETTINGS:
            wanted = {spec_of(learner, task, arm, toy): arm.name for arm in ARMS}
            folder = bakeoff.folder_of(bakeoff.argparse.Namespace(out=out), learner, task)
            for trial in tables.read(folder) if any((folder / grid.CELLS).glob("*/result.json")) else []:
                _, run = reading.read_run(trial["folder"])
                rewards = wanted.get(dataclasses.replace(run, seed=0))
                if rewards is None or not trial["final"]:
                    continue
                steps, success, seconds = (np.asarray(trial["curve"][name], float) for name in CURVE)
                (at,) = first_reach(steps, success[None], THRESHOLD)
                until = float(np.interp(at, steps, seconds)) if math.isfinite(at) else math.inf
                own = play(Path(trial["folder"]), run, plays)
                rows.append(Played(learner, task, rewards, run.seed, *own, float(at), until))
    return rows


def main() -> int:
    """Trains and reports as bench/bakeoff.py does, then plays. Returns its status."""
    status = bakeoff.main(None, REWARDS, __doc__)
    args = bakeoff.parse(None, REWARDS, __doc__)
    if status == 0 and not args.plan and (rows := played(args.out, args.tasks, args.toy)):
        path = args.out / "rewards_played.csv"
        with files.atomic_write(path) as partial, partial.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(Played._fields)
            writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
        print(f"wrote {path}, {len(rows)} runs")
    return status


if __name__ == "__main__":
    sys.exit(main())
