"""A six-joint arm from its MJCF: reach with the tip, and push a box. docs/your_robot.md explains it.

python train.py --env docs.examples.my_arm:Reach
"""

from mjx_dher.envs.task import JointDelta, MujocoTask, Position, Start


class Reach(MujocoTask):
    """Moves the tip of the arm to a point in the air."""

    model = "arm.xml"
    control = JointDelta("j*", scale=0.15)
    start = Start("home")
    goal = Position("site:tip", low=(0.25, -0.25, 0.1), high=(0.5, 0.25, 0.45))
    observations = ("site:tip", "vel:tip", "qpos:j*", "qvel:j*")


class Push(Reach):
    """Pushes the box to a point on the floor."""

    start = Start("home", ranges={"box": ((0.37, -0.15, 0.03), (0.52, 0.15, 0.03))})
    goal = Position("body:box", low=(0.37, -0.15, 0.03), high=(0.52, 0.15, 0.03))
    observations = (*Reach.observations, "body:box", "body:box - site:tip", "rot:box", "vel:box", "angvel:box")
