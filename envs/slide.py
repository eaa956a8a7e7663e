"""Hit a puck so that it slides to a goal out of the arm's reach (FetchSlide-v4)."""

from __future__ import annotations

from mjx_dher.envs.fetch import FetchEnv, FetchTask


class Slide(FetchEnv):
    """FetchSlide: a puck on a slippery table; the goal lies up to 30 cm around a point 40 cm ahead of the gripper."""

    name = "slide"
    task = FetchTask(
        xml="slide.xml",
        initial_grip_pos=(1.0130990, 0.7491539, 0.4155006),
        initial_grip_vel=(-0.0865967, 0.000630, 0.000185),
        target_range=0.3,
        target_offset=(0.4, 0.0, 0.0),
        object_height=0.41999957,
        object_range=0.1,
    )
