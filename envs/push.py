"""Push a cube to a goal on the table, with the fingers closed (FetchPush-v4)."""

from __future__ import annotations

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Push(FetchEnv):
    """FetchPush: the goal lies on the table, up to 15 cm from the gripper along x and along y."""

    name = "push"
    task = FetchTask(
        xml="push.xml",
        initial_grip_pos=(1.3629766, 0.7490998, 0.41601148),
        initial_grip_vel=(-0.074636, 0.000407, -0.000006),
        object_height=0.42489222,
        object_range=0.15,
        target_range=0.15,
    )
