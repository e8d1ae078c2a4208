"""Universal Robots' UR5e, six joints, with Robotiq's 85 mm gripper."""

from osel_sim.interface.robot import Robot
from osel_sim.sim.robots.robotiq import ROBOTIQ_85

UR5E = Robot(
    name="UR5e",
    model="robosuite.models.robots:UR5e",
    home=(-0.298, -1.498, 2.173, -2.246, -1.571, -1.868),  # the gripper where the Panda's is; robosuite's is 13 cm further back, and lower
    start_weights=(1.0, 1.0, 1.0, 1.5, 1.5, 2.0),
    start_lift=(0.0, -0.437, -0.406, -0.1, 0.0, 0.0),
    gripper=ROBOTIQ_85,
)
