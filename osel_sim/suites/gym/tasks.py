"""What a file says of a gymnasium environment: instructions, and what it does not say of itself."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from osel_sim.core.errors import ContentError, did_you_mean
from osel_sim.interface.environment import GRIPPERS
from osel_sim.suites.gymnasium_env import HOLDS, Unsaid

FOLDER = Path(__file__).resolve().parent / "files"


@dataclass(frozen=True)
class GymTask(Unsaid):
    """One environment, and what it does not say of itself.

    Attributes:
        id: as `gymnasium.make` takes it, `module:Name-v0` for one that a module registers.
        title: one line about it.
        train, held_out: phrasings of the instruction; without any it is the words of the id.
        make: further arguments of `gymnasium.make`.
    """

    id: str
    title: str = ""
    train: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    make: Mapping[str, Any] = field(default_factory=dict)

    def packed(self) -> str:
        """All of it as one text, for the host."""
        return json.dumps(asdict(self))


def unpacked(text: str) -> GymTask:
    """What `packed` gave."""
    return _task(json.loads(text))


def _task(data: Mapping[str, Any]) -> GymTask:
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
    return GymTask(**values)


def load_tasks(folder: Path | None = None) -> dict[str, GymTask]:
    """Id -> task of every file.

    Args:
        folder: the user's own `gym` folder beside task files; its files win.

    Raises:
        ContentError: a file is wrong.
    """
    found = {}
    for place in (FOLDER, folder):
        for file in sorted(place.glob("*.toml")) if place is not None else []:
            task = read_task(file)
            found[task.id] = task
    return found


def read_task(file: Path) -> GymTask:
    """Read one file.

    Raises:
        ContentError: naming the key and what would be right.
    """
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ContentError(file, "TOML", str(error)) from None
    known = {one.name: one.type for one in fields(GymTask)}
    kinds: dict[str, tuple[type, ...]] = {"control_hz": (int, float), "horizon": (int,), "make": (dict,), "reset": (dict,)}
    lists = ("train", "held_out", "tags", "actions", "state")
    for key, value in data.items():
        if key not in known:
            raise ContentError(file, key, f"unknown key: {did_you_mean(key, known)}known: {', '.join(known)}")
        if key in lists:
            if not isinstance(value, list) or not all(isinstance(item, str) and item for item in value):
                raise ContentError(file, key, f"must be a list of texts, got {value!r}")
        elif isinstance(value, bool) or not isinstance(value, kinds.get(key, (str,))):
            raise ContentError(file, key, f"must be {' or '.join(kind.__name__ for kind in kinds.get(key, (str,)))}, got {value!r}")
    if not data.get("id"):
        raise ContentError(file, "id", "is missing: the name that gymnasium.make takes")
    if data.get("hold", "zero") not in HOLDS:
        raise ContentError(file, "hold", f"must be one of {', '.join(HOLDS)}, got {data['hold']!r}")
    if data.get("gripper_convention", GRIPPERS[0]) not in GRIPPERS:
        raise ContentError(file, "gripper_convention", f"must be one of {', '.join(GRIPPERS)}, got {data['gripper_convention']!r}")
    for key in ("control_hz", "horizon"):
        if data.get(key, 1) <= 0:
            raise ContentError(file, key, f"must be positive, got {data[key]!r}")
    return _task(data)
