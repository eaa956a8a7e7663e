"""Task of hitting a puck so that it slides to a goal out of the arm's reach (FetchSlide-v4)."""

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Slide(FetchEnv):
    """FetchSlide: a puck on a slippery table. The goal lies up to 30 cm around a point 40 cm ahead of the gripper."""

    name = "slide"
    task = FetchTask(
        xml="slide.xml",
        arm_qpos=(0.0133685885, -0.575905496, -0.005929734, 1.4139215, -1.28234476e-06, 0.682503565, 0.00871218759),
        arm_qvel=(0.00697181, -0.0504703, -0.00531813, 0.120123, 0.00142379, 0.116102, 0.00411597),
        initial_grip_pos=(1.0132714, 0.7491539, 0.4155006),
        target_range=0.3,
        target_offset=(0.4, 0.0, 0.0),
        object_height=0.41999957,
        object_range=0.1,
        finger_qvel=(3.60453e-06, 0.00245563),
    )
