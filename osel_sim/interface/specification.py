"""What our environments offer policies: robosuite's OSC_POSE at 20 Hz, the convention of robosuite, LIBERO and the policies trained on them."""

from osel_sim.interface.environment import ActionSpec, EnvironmentSpec

CONTROL_HZ = 20
CAMERAS = ("agentview", "wrist")
CONTEXT_CAMERA = "agentview"
STATE = {"position": 3, "axis_angle": 3, "fingers": 2}
"""Gripper position (metres, world), its orientation as axis-angle (radians), two finger positions (metres)."""
STATE_DIM = sum(STATE.values())
NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
ACTION_DIM = len(NAMES)
ACTION = ActionSpec(NAMES, (-1.0,) * ACTION_DIM, (1.0,) * ACTION_DIM, gripper="gripper", turns=("roll", "pitch", "yaw"), rotation="axis_angle")
"""OSC_POSE deltas in [-1, 1], where 1 is 5 cm or 0.5 rad, and the gripper, -1 open, +1 closed."""


def specification(robot: str = "Panda", horizon: int | None = None) -> EnvironmentSpec:
    """Specification of the environment of any of our tasks.

    Args:
        horizon: of the task.
    """
    return EnvironmentSpec("osel_sim", CONTROL_HZ, ACTION, STATE, CAMERAS, CONTEXT_CAMERA, robot, horizon, snapshots=True, expert=True)
