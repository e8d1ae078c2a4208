"""Franka's Panda with its own hand: the robot of every task that names no other."""

import math

from osel_sim.interface.robot import Gripper, Robot

PANDA = Robot(
    name="Panda",
    model="robosuite.models.robots:Panda",
    home=(0.0, math.pi / 16.0, 0.0, -math.pi / 2.0 - math.pi / 3.0, 0.0, math.pi - 0.2, math.pi / 4.0),
    start_weights=(1.0, 1.0, 1.0, 1.0, 1.5, 1.5, 2.0),  # the wrist's joints move the hand less
    start_lift=(0.0, -0.457, 0.0, 0.315, 0.0, 0.113, 0.0),
    gripper=Gripper(
        model="robosuite.models.grippers:PandaGripper",
        rest=(0.04, -0.04),
        closing=(-1.0, 1.0),
        left=("gripper0_right_finger1_collision", "gripper0_right_finger1_pad_collision"),
        right=("gripper0_right_finger2_collision", "gripper0_right_finger2_pad_collision"),
    ),
)
