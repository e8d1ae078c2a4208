"""What robosuite's stock environments are, without the simulator."""

import functools
import tomllib
from pathlib import Path
from typing import Any

from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.specification import ACTION, CONTROL_HZ

NAME = "robosuite"
FILE = Path(__file__).resolve().parent / "tasks.toml"
HORIZON = 500
FINGERS = {"Panda": 2, "UR5e": 6, "IIWA": 6, "Jaco": 6, "Kinova3": 6}
"""Arm -> joints of the gripper that robosuite gives it. Sawyer is not among them: its meshes do not load in MuJoCo 3.9."""
USUAL = "Panda"
STOCK = ("IIWA",)
"""Arms whose actions are given in a frame that moves with a joint: robosuite's own control steps them, at its own speed and without snapshots."""
CAMERAS = {"agentview": "agentview", "wrist": "robot0_eye_in_hand", "frontview": "frontview", "birdview": "birdview"}
"""Name of a camera -> robosuite's."""


def parts(task: str) -> tuple[str, str]:
    """Environment and arm."""
    name, _, arm = task.partition("/")
    return name, arm or USUAL


def specification(task: str) -> EnvironmentSpec:
    """What the environment of a task offers policies."""
    name, arm = parts(task)
    return EnvironmentSpec(
        name=NAME,
        control_hz=CONTROL_HZ,
        action=ACTION,
        state={"position": 3, "axis_angle": 3, "fingers": FINGERS[arm]},
        cameras=tuple(CAMERAS),
        context_camera="agentview",
        robot=arm,
        horizon=words()[name].get("horizon", HORIZON),
        snapshots=arm not in STOCK,
    )


@functools.cache
def words() -> dict[str, dict[str, Any]]:
    """What `tasks.toml` says of each environment."""
    with FILE.open("rb") as handle:
        return tomllib.load(handle)
