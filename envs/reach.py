"""Task of reaching a point in the air with the gripper (FetchReach-v4)."""

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Reach(FetchEnv):
    """FetchReach: the goal is a position of the grip point, up to 15 cm away along each axis. The observation is [10]."""

    name = "reach"
    task = FetchTask(
        xml="reach.xml",
        arm_qpos=(0.00969146345, -0.825628071, -0.00312048482, 1.4438479, 0.00263934828, 0.953287132, 0.0058733811),
        arm_qvel=(0.000743176, 0.00594367, -0.00138399, -0.000864239, 0.00109662, -0.00279652, -0.000919709),
        initial_grip_pos=(1.3418334, 0.74910102, 0.53473344),
        target_range=0.15,
    )
