"""robosuite's stock single-arm environments as a suite: `robosuite:Lift`, `robosuite:Lift/UR5e`."""

import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from osel_sim.core.files import content_digest
from osel_sim.interface.environment import Environment, EnvironmentSpec
from osel_sim.interface.specification import ACTION, CONTROL_HZ
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.phrasing import phrase, stream

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


class Robosuite:
    """The suite. It runs in this process: robosuite is what our own scenes are made of."""

    spec = SuiteSpec(
        NAME,
        "robosuite's stock environments of one arm, at our speed",
        packages=("robosuite",),
        opengl=True,
        cannot=("no perturbation levels", "no subgoals before success"),
    )

    @functools.cached_property
    def tasks(self) -> Mapping[str, TaskInfo]:
        """Every environment with every arm; the Panda's need not be named."""
        return {
            _task(name, arm): TaskInfo(entry["title"], entry.get("horizon", HORIZON), f"1-{content_digest(repr(entry))[:12]}", (arm.lower(),))
            for arm in FINGERS
            for name, entry in _words().items()
        }

    def specification(self, task: str) -> EnvironmentSpec:
        """Actions as ours, OSC_POSE at 20 Hz; the state is that of ours with all joints of the gripper."""
        return specification(task)

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> PlainInstance:
        """Draw an instance: a seed for robosuite, and a phrasing. An arm changes neither."""
        name = parts(task)[0]
        entry = _words()[name]
        phrasing, instruction = phrase(entry["train"], entry["held_out"], split, stream(name, seed, split))
        return PlainInstance(f"{NAME}:{task}", seed, split, instruction, level, phrasing=phrasing)

    def open(self, task: str) -> Environment:
        """Make the environment of a task; takes seconds."""
        from osel_sim.suites.robosuite.env import RobosuiteEnvironment

        return RobosuiteEnvironment(task)


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
        horizon=_words()[name].get("horizon", HORIZON),
        snapshots=arm not in STOCK,
    )


def _task(name: str, arm: str) -> str:
    return name if arm == USUAL else f"{name}/{arm}"


@functools.cache
def _words() -> dict[str, dict[str, Any]]:
    with FILE.open("rb") as handle:
        return tomllib.load(handle)
