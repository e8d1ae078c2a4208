"""What Meta-World's tasks are, without the simulator."""

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.interface.environment import ActionSpec, EnvironmentSpec

FILE = Path(__file__).resolve().parent / "tasks.toml"
HORIZON = 500
"""Meta-World's own."""
CAMERAS = ("corner2", "gripperPOV", "topview", "behindGripper", "corner", "corner3")
SPECIFICATION = EnvironmentSpec(
    name="metaworld",
    control_hz=80,
    action=ActionSpec(("x", "y", "z", "gripper"), (-1.0,) * 4, (1.0,) * 4, gripper="gripper"),
    state={"position": 3, "gripper": 1},
    cameras=CAMERAS,
    context_camera="corner2",
    robot="Sawyer",
    horizon=HORIZON,
    snapshots=True,
    expert=True,
)
"""An action of 1 moves the hand's target by 1 cm along an axis of the world; the gripper is a force, positive closes."""
AXES = ("light", "camera", "texture", "start", "phrasing")
TABLE_TOPS = {1: ("wood1", "wood3"), 2: ("light_wood_v2", "wood4"), 3: ("marble", "granite", "navy_blue")}
"""Level of the axis `texture` -> pictures of Meta-World's own that the table gets."""


@dataclass(frozen=True)
class TaskText:
    """What `tasks.toml` says of a task.

    Attributes:
        subgoals: the simulator's own signals that say something about it, before success.
        train, held_out: phrasings of the instruction.
    """

    title: str
    subgoals: tuple[str, ...]
    tags: tuple[str, ...]
    train: tuple[str, ...]
    held_out: tuple[str, ...]


@functools.cache
def load_tasks() -> dict[str, TaskText]:
    """All 50, by name."""
    with FILE.open("rb") as handle:
        found: dict[str, dict[str, Any]] = tomllib.load(handle)
    lists = ("subgoals", "tags", "train", "held_out")
    return {name: TaskText(task["title"], *(tuple(task[key]) for key in lists)) for name, task in found.items()}
