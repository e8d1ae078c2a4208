"""Kinova's Gen3, seven joints, with Robotiq's 85 mm gripper."""

from osel_sim.interface.robot import Robot
from osel_sim.sim.robots.robotiq import ROBOTIQ_85

KINOVA3 = Robot(
    name="Kinova3",
    model="robosuite.models.robots:Kinova3",
    home=(-0.07, 0.395, -0.005, 2.159, 0.003, 0.587, -1.648),  # the gripper where the Panda's is
    nearer=0.12,  # where robosuite puts it, the far end of the table takes its elbow through the straight, and it comes back the other way round
    start_weights=(1.0, 1.0, 1.0, 1.0, 1.5, 1.5, 2.0),
    start_lift=(0.0, -0.336, 0.0, -0.174, 0.0, 0.0, 0.0),
    lowering=0.4,
    centred=0.005,
    gripper=ROBOTIQ_85,
)
