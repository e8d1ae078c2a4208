"""robosuite's stock single-arm environments as a suite: `robosuite:Lift`, `robosuite:Lift/UR5e`."""

import functools
from collections.abc import Mapping

from osel_sim.core.files import content_digest
from osel_sim.interface.environment import Environment, EnvironmentSpec
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.phrasing import phrase, stream
from osel_sim.suites.robosuite.tasks import FINGERS, HORIZON, NAME, USUAL, parts, specification, words


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
            for name, entry in words().items()
        }

    def specification(self, task: str) -> EnvironmentSpec:
        """Actions as ours, OSC_POSE at 20 Hz; the state is that of ours with all joints of the gripper."""
        return specification(task)

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> PlainInstance:
        """Draw an instance: a seed for robosuite, and a phrasing. An arm changes neither."""
        name = parts(task)[0]
        entry = words()[name]
        phrasing, instruction = phrase(entry["train"], entry["held_out"], split, stream(name, seed, split))
        return PlainInstance(f"{NAME}:{task}", seed, split, instruction, level, phrasing=phrasing)

    def open(self, task: str) -> Environment:
        """Make the environment of a task; takes seconds."""
        from osel_sim.suites.robosuite.env import RobosuiteEnvironment

        return RobosuiteEnvironment(task)


def _task(name: str, arm: str) -> str:
    return name if arm == USUAL else f"{name}/{arm}"
