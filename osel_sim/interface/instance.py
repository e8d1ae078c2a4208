"""What an instance is: one scene with one instruction, fixed by its seed."""

from dataclasses import dataclass
from typing import Protocol

from osel_sim.interface.robot import DEFAULT_ROBOT

SPLITS = ("train", "validation", "test")
OURS = "osel_sim"
"""The suite whose tasks need no prefix."""
SUITE_SEPARATOR = ":"
"""Between the suite and the task, as in `metaworld:reach-v3`."""


class Instance(Protocol):
    """One scene with one instruction. Suites derive more of their own; this is what everybody else reads of it."""

    @property
    def key(self) -> str:
        """Name of the instance, unique over all suites: what `instance_key` makes of its task, split, level, axes, seed and robot."""
        ...

    @property
    def task(self) -> str:
        """Name of its task, with the suite where it is not ours."""
        ...

    @property
    def seed(self) -> int:
        """What it was drawn from, >= 0."""
        ...

    @property
    def level(self) -> int:
        """How far it is perturbed; 0: not at all."""
        ...

    @property
    def axes(self) -> str | None:
        """Axes of perturbation above the level, as `camera=2,light=1`; None where there are none."""
        ...

    @property
    def split(self) -> str:
        """`train`, `validation` or `test`."""
        ...

    @property
    def instruction(self) -> str:
        """What to do, in words."""
        ...

    @property
    def phrasing(self) -> str:
        """Which phrasing the instruction is made of; empty where nobody tells them apart."""
        ...

    @property
    def target(self) -> str:
        """What the instruction names first; empty where nothing is named."""
        ...

    @property
    def container(self) -> str:
        """What the instruction names second: where the first goes; empty where it names nothing else."""
        ...

    @property
    def other_robot(self) -> str | None:
        """Name of the robot, where it is another than the suite's usual one; None: the usual one."""
        ...


def label(level: int, axes: str | None) -> str:
    """`2`, `camera=2,light=1` or `1,camera=3`: the part of an instance's key that says how it is perturbed."""
    return str(level) if axes is None else axes if level == 0 else f"{level},{axes}"


def instance_key(task: str, split: str, perturbed: str, seed: int, robot: str | None = None) -> str:
    """What fixes an instance, as its name: `pick_place/test/2/7`, or `pick_place/test/2/7-UR5e` for another robot than the usual one.

    Args:
        perturbed: as `label` gives it.
        robot: None is the usual one.
    """
    return f"{task}/{split}/{perturbed}/{seed}" + ("" if robot in (None, DEFAULT_ROBOT) else f"-{robot}")


@dataclass(frozen=True)
class SeededInstance:
    """An instance of which a suite need say no more than its seed and its instruction. For suites that do: derive from it."""

    task: str
    seed: int
    split: str
    instruction: str
    level: int = 0
    axes: str | None = None
    phrasing: str = ""
    target: str = ""
    container: str = ""
    other_robot: str | None = None

    @property
    def key(self) -> str:
        """Name of the instance, unique over all suites."""
        return instance_key(self.task, self.split, label(self.level, self.axes), self.seed, self.other_robot)

    @property
    def simulator_seed(self) -> int:
        """A seed for the simulator's own random numbers: no two instances of a task share one, whatever their splits."""
        return len(SPLITS) * self.seed + SPLITS.index(self.split)
