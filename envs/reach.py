"""Reach a point in the air with the gripper (FetchReach-v4)."""

from __future__ import annotations

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Reach(FetchEnv):
    """FetchReach: the goal is a place for the grip point, up to 15 cm away along each axis; observation [10]."""

    name = "reach"
    task = FetchTask(
        xml="reach.xml",
        initial_grip_pos=(1.3418334, 0.74910102, 0.53473344),
        initial_grip_vel=(-0.00015, -0.000002, 0.000533),
        target_range=0.15,
    )
