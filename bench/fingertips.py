"""How near the goals of `hand_reach` the fingertips can come, by joint limits and the tendons that couple joints.

    python bench/fingertips.py [--goals 300]

For each goal, least squares from eight postures minimize the distance of all five fingertips together. Forces, contacts and
servos are left out, so no policy comes nearer, unless all eight searches ended in local minima. docs/fidelity.md has results.
"""

import argparse
from typing import Any

import jax
import mujoco
import numpy as np
from scipy.optimize import least_squares

from mjx_dher.envs import make
from mjx_dher.envs.hand import TIPS

STARTS, TENDON = 8, 1e4  # postures to start from; mm of a residual for each meter that a tendon is too long or too short


class Hand:
    """Fingertips of a posture, in mm from a goal, and their derivatives."""

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)
        self.sites = [model.site(name).id for name in TIPS]
        self.coupled = np.zeros((model.ntendon, model.nv))  # length of each fixed tendon = coupled @ qpos
        for tendon, (start, number) in enumerate(zip(model.tendon_adr, model.tendon_num)):
            for at in range(start, start + number):
                self.coupled[tendon, model.wrap_objid[at]] = model.wrap_prm[at]

    def beyond(self, qpos: np.ndarray) -> np.ndarray:
        """How far each tendon's length lies outside its range, in m."""
        length, (low, high) = self.coupled @ qpos, self.model.tendon_range.T
        return np.maximum(length - high, 0) + np.minimum(length - low, 0)

    def residuals(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        self._pose(qpos)
        return np.concatenate([1000 * (self.data.site_xpos[self.sites] - goal).ravel(), TENDON * self.beyond(qpos)])

    def derivatives(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        del goal
        self._pose(qpos)
        rows = np.zeros((len(self.sites), 3, self.model.nv))
        for row, site in zip(rows, self.sites):
            mujoco.mj_jacSite(self.model, self.data, row, None, site)
        tendons = TENDON * self.coupled * (self.beyond(qpos) != 0)[:, None]
        return np.concatenate([1000 * rows.reshape(-1, self.model.nv), tendons])

    def _pose(self, qpos: np.ndarray) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def floor(self, goal: np.ndarray, rng: np.random.Generator) -> float:
        """Least distance found to a goal [5, 3], in mm."""
        low, high = self.model.jnt_range.T
        starts = [np.clip(self.model.key_qpos[0], low + 1e-6, high - 1e-6), *rng.uniform(low, high, (STARTS - 1, len(low)))]
        found = (least_squares(self.residuals, at, self.derivatives, (low, high), args=(goal,), max_nfev=100) for at in starts)
        return min(float(np.linalg.norm(each.fun)) for each in found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--goals", type=int, default=300, help="goals of each finger")
    count = parser.parse_args().goals
    if count < 1:
        parser.error(f"--goals must be 1 or more; got {count}")
    env: Any = make("hand_reach", engine="native")
    keys = jax.random.split(jax.random.key(1), 8 * count)
    goals = np.asarray(jax.vmap(env.goal.sample)(keys)).reshape(-1, len(TIPS), 3)
    moved = np.abs(goals - env.goal.first).max(2) > 1e-6
    hand, rng = Hand(env.model), np.random.default_rng(1)
    print("| finger that meets the thumb | goals | least distance, mm: median | 90 % | largest | above 10 mm | above 8.9 mm |")
    print("|---|---|---|---|---|---|---|")
    for finger, name in enumerate(TIPS[:-1]):
        own = goals[moved[:, finger] & moved[:, -1]][:count]
        least = np.array([hand.floor(goal, rng) for goal in own])
        middle, high = np.percentile(least, [50, 90])
        shares = f"{np.mean(least > 10):.2f} | {np.mean(least > 8.9):.2f}"
        print(f"| `{name}` | {len(own)} | {middle:.1f} | {high:.1f} | {least.max():.1f} | {shares} |", flush=True)


if __name__ == "__main__":
    main()
