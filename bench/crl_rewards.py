"""Both reward conventions for HER, and success at any step and time at the goal, with contrastive RL.

    python bench/crl_rewards.py --out rewards --first-seed 20 --plan
    python bench/crl_rewards.py --out rewards --first-seed 20 --minutes 12   trains, plays and reports; run it again to resume
    python bench/crl_rewards.py --out toy --toy --seeds 2   the same on Reach, on a CPU
    python bench/crl_rewards.py --out played --first-seed 20 --arms negative --tasks push slide   other tasks, without 0 and 1

It is bench/bakeoff.py with other arms, and has its options. p is corrected over the HER arms of a task. When all runs have
ended, it plays each policy for 500 episodes (rewards_played.csv) and writes rewards_curves.csv. Runs of --runs have no
policies. docs/experiments/crl_rewards.md has the plan.
"""

import dataclasses
import itertools
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import bakeoff
import crl
import jax
import jax.numpy as jnp
import numpy as np
from bakeoff_arms import Arm, Experiment
from bakeoff_runs import save

from mjx_dher.cli.common import make_env
from mjx_dher.envs.arms import ArmPushEasy
from mjx_dher.envs.fetch import PickAndPlace, Reach
from mjx_dher.policy import Policy
from mjx_dher.policy.load import load_plain
from mjx_dher.rollout import record_rollout
from mjx_dher.spec import RunSpec
from mjx_dher.stats import first_reach
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
HER = ("sac_k4", "sac_final", "tqc_k4", "tqc_final")
SETTINGS = {arm.name: arm for name in (*HER, "crl") for arm in crl.ARMS if arm.name == name}
ARMS = (Arm("negative", "negative"), Arm("positive", "positive"))


def spec_of(learner: str, task: str, arm: Arm, toy: bool = False) -> RunSpec:
    """Run of a setting of bench/crl.py with the arm's rewards, seed 0.

    `crl` reads no rewards, and tasks outside POSITIVE have only their own: one run for both arms.
    """
    task = "reach" if toy else task
    run = crl.spec_of("equal", task, SETTINGS[learner], toy)
    return dataclasses.replace(run, env=POSITIVE.get(task, task) if arm.name == "positive" and learner in HER else task)


TASKS = ("arm_push_easy", "pick_and_place", *(task for task in crl.SIZES if task not in POSITIVE))
REWARDS = Experiment(ARMS, tuple(SETTINGS), TASKS, spec_of, "rewards.csv", len(HER))


class Played(NamedTuple):
    """A run's policy at play, and its way to success."""

    learner: str
    task: str
    rewards: str  # "negative" or "positive", of `crl` "none"
    seed: int
    last: float  # share of episodes with success in the last state
    any_step: float  # ... in any state after the first
    time_at_goal: float  # share of the states after the first
    at_reset: float
    steps: float  # environment steps at the first evaluation with THRESHOLD; infinite where there is none
    seconds: float  # of training until then, without compiling, next to all runs of its program


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
    success = np.where(valid[:, None], success, 0.0).astype(float)  # [episodes, T + 1]
    after = success[:, 1:]
    return float(after[:, -1].mean()), float(after.max(1).mean()), float(after.mean()), float(success[:, 0].mean())


def main() -> int:
    """Trains and reports as bench/bakeoff.py does, then plays and writes curves. Returns its status."""
    args, status = bakeoff.parse(None, REWARDS, __doc__), bakeoff.main(None, REWARDS, __doc__)
    if status or args.plan:
        return status
    rows, curves, plays = [], [], dict[str, Any]()
    for task, learner in itertools.product(args.tasks, args.learners):
        for arm, trials in bakeoff.trials_by_arm(args, learner, task).items():
            run = spec_of(learner, task, next(each for each in ARMS if each.name == arm), args.toy)
            for trial in (trial for trial in trials if trial["final"]):  # others failed
                which = (learner, task, arm if learner in HER else "none", trial["seed"])
                steps, success, seconds = (np.asarray(trial["curve"][name], float) for name in CURVE)
                curves += [(*which, *point) for point in zip(steps, success, seconds)]
                (at,) = first_reach(steps, success[None], THRESHOLD)
                until = float(np.interp(at, steps, seconds)) if math.isfinite(at) else math.inf
                rows.append(Played(*which, *play(Path(trial["folder"]), run, plays), float(at), until))
    save(args.out / "rewards_played.csv", rows, Played._fields)
    save(args.out / "rewards_curves.csv", curves, ("learner", "task", "rewards", "seed", *CURVE))
    print(f"wrote rewards_played.csv and rewards_curves.csv, {len(rows)} runs")
    return status


if __name__ == "__main__":
    sys.exit(main())
