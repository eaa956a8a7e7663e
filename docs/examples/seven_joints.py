"""Reach, push and pick with an arm of seven joints and a gripper, with the published sizes of a Franka Panda.

python train.py --env docs.examples.seven_joints:Reach
"""

from mjx_dher.envs.task import Actuators, JointDelta, MujocoTask, Position, Start

ARM = ("site:grip", "vel:grip", "qpos:joint*", "qvel:joint*")
BOX = ("body:box", "body:box - site:grip", "rot:box", "vel:box", "angvel:box")


class Reach(MujocoTask):
    """Moves the point between the fingers to a point in the air."""

    model = "seven_joints.xml"
    control = JointDelta("joint*", scale=0.1)
    start = Start("home")
    goal = Position("site:grip", low=(0.35, -0.25, 0.05), high=(0.65, 0.25, 0.5))
    observations = ARM


class Push(Reach):
    """Pushes the box on the floor, with the fingers as they are."""

    start = Start("low", ranges={"box": ((0.4, -0.15, 0.02), (0.6, 0.15, 0.02))})
    goal = Position("body:box", low=(0.4, -0.15, 0.02), high=(0.6, 0.15, 0.02))
    observations = (*ARM, *BOX)


class Pick(Push):
    """Lifts the box to a point in the air. The last number of an action moves both fingers."""

    control = (JointDelta("joint*", scale=0.1), Actuators("finger*", together=True))
    goal = Position("body:box", low=(0.4, -0.15, 0.02), high=(0.6, 0.15, 0.3))
    observations = (*ARM, *BOX, "qpos:finger*")
