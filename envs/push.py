"""Task of pushing a cube to a goal on the table, with the fingers closed (FetchPush-v4)."""

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Push(FetchEnv):
    """FetchPush: the goal lies on the table, up to 15 cm from the gripper along x and y."""

    name = "push"
    task = FetchTask(
        xml="push.xml",
        arm_qpos=(0.0116377772, -0.580433428, -0.00457914917, 1.42152997, 0.00145336833, 0.690240166, 0.00724187328),
        arm_qvel=(0.00379832, -0.0436523, -0.00313292, 0.109691, 0.00269572, 0.0891523, 0.00103944),
        initial_grip_pos=(1.3631267, 0.7490998, 0.41601148),
        object_height=0.42489222,
        object_range=0.15,
        target_range=0.15,
    )
