"""Grasp a cube and bring it to a goal on the table or in the air (FetchPickAndPlace-v4)."""

from __future__ import annotations

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class PickAndPlace(FetchEnv):
    """FetchPickAndPlace: as Push, with fingers that `action[3]` opens and closes; half of all goals lie up to 45 cm higher."""

    name = "pick_and_place"
    task = FetchTask(
        xml="pick_and_place.xml",
        initial_grip_pos=(1.3419341, 0.7491005, 0.53473306),
        initial_grip_vel=(-0.00015, -0.000002, 0.000533),
        target_range=0.15,
        object_height=0.42489222,
        max_goal_lift=0.45,
    )
