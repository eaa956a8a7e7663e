"""Task of grasping a cube and bringing it to a goal on the table or in the air (FetchPickAndPlace-v4)."""

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class PickAndPlace(FetchEnv):
    """FetchPickAndPlace: like Push, but `action[3]` moves the fingers, and half of the goals lie up to 45 cm higher."""

    name = "pick_and_place"
    task = FetchTask(
        xml="pick_and_place.xml",
        arm_qpos=(0.00969037654, -0.825628108, -0.00311989443, 1.44384795, 0.00264075557, 0.953287094, 0.00587191243),
        arm_qvel=(0.000744743, 0.00594378, -0.0013853, -0.000864291, 0.00109634, -0.00279653, -0.000918971),
        initial_grip_pos=(1.3419341, 0.7491005, 0.53473306),
        target_range=0.15,
        object_height=0.42489222,
        max_goal_lift=0.45,
    )
