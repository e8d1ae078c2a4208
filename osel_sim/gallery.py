"""A contact sheet of every task at every level: `python -m osel_sim.gallery --out sheet.png`."""

import contextlib
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from osel_sim.api.settings import CONTENT, MAIN, Count, Folder, Index, Names, Settings, settings
from osel_sim.cli.command import Command
from osel_sim.core import content
from osel_sim.core.errors import SettingError
from osel_sim.core.files import write_bytes
from osel_sim.formats.levels import AXES, LEVELS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from osel_sim.sim.env import TaskEnv

ALL = "all"
BAND, MARGIN, HEADER = 55, 130, 26
"""Pixels: the instruction below a picture, the row's name at the left, the levels at the top."""
INK, GREY, PAPER = (30, 30, 30), (110, 110, 110), (255, 255, 255)

EXAMPLES = """examples:
  python -m osel_sim.gallery --out sheet.png                              # every task, levels 0 to 3
  python -m osel_sim.gallery --task pick_place --out sheet.png --seed 7
  python -m osel_sim.gallery --task pick_place --each-axis --out axes.png # one task: every axis alone
"""


@settings
class GalleryConfig(Settings):
    """Draw a contact sheet: a row a task (or an axis), a column a level, the instruction underneath."""

    out: Annotated[Path | None, MAIN] = None
    """the .png to write"""
    task: Annotated[Names | None, MAIN] = None
    """which tasks (default: all)"""
    each_axis: Annotated[bool, MAIN] = False
    """of one task: a row for each axis alone"""
    seed: Annotated[Index, MAIN] = 0
    """of the instances"""
    size: Annotated[Count, MAIN] = 256
    """pixels of a picture, square"""
    camera: Annotated[Literal["agentview", "wrist"], MAIN] = "agentview"
    """which camera"""
    robot: Annotated[str | None, MAIN] = None
    """robot that stands there, such as UR5e (default: the one each task file names, else Panda)"""
    tasks: Annotated[Folder | None, CONTENT] = None
    """folder with task files of your own"""


def _execute(config: GalleryConfig) -> int:
    known = list(content.files("tasks", config.tasks))
    names = known if config.task in (None, (ALL,)) else config.task
    if config.out is None or config.out.suffix.lower() != ".png":
        raise SettingError("out", "is missing: give the .png to write" if config.out is None else f"{config.out} must end in .png")
    if config.each_axis and len(names) != 1:
        raise SettingError("each_axis", f"shows one task: give --task with one of {', '.join(known)}")
    picture = _sheet(config, names)

    import cv2

    config.out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(config.out, cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
    print(f"{config.out}: {picture.shape[1]} x {picture.shape[0]} pixels")
    return 0


def _sheet(config: GalleryConfig, names: Sequence[str]) -> "NDArray[np.uint8]":
    import numpy as np

    from osel_sim.formats.task_file import load_task_file
    from osel_sim.sim.env import TaskEnv
    from osel_sim.sim.gl import choose_backend
    from osel_sim.sim.robots import with_robot

    tasks = with_robot([load_task_file(content.find("tasks", name, config.tasks)) for name in names], config.robot)
    choose_backend()
    rows: list[NDArray[np.uint8]] = []
    for task in tasks:
        with contextlib.closing(TaskEnv(task)) as env:
            if config.each_axis:
                rows += [_row(config, env, axis, [{axis: level} for level in LEVELS]) for axis in AXES if axis in task.axes]
            else:
                rows.append(_row(config, env, task.name, [dict.fromkeys(task.axes, level) for level in LEVELS]))
    header = np.full((HEADER, rows[0].shape[1], 3), PAPER, np.uint8)
    for level in LEVELS:
        _write(header, f"level {level}", (MARGIN + level * config.size + 6, 18), INK, 0.5)
    return np.concatenate([header, *rows])


def _row(config: GalleryConfig, env: "TaskEnv", name: str, settings: Sequence[Mapping[str, int]]) -> "NDArray[np.uint8]":
    """One row: the same seed, more and more perturbed."""
    import numpy as np

    from osel_sim.sim.instance import make_instance

    size = config.size
    row = np.full((size + BAND, MARGIN + len(settings) * size, 3), PAPER, np.uint8)
    for number, line in enumerate(textwrap.wrap(name.replace("_", " "), 14)):
        _write(row, line, (8, 24 + 20 * number), INK, 0.5)
    for column, axes in enumerate(settings):
        instance = make_instance(env.task, config.seed, axes=axes)
        env.load(instance)
        left = MARGIN + column * size
        row[:size, left : left + size] = env.image(config.camera, size, size, "full")
        for number, line in enumerate(textwrap.wrap(instance.instruction, size // 7)[:3]):
            _write(row, line, (left + 4, size + 15 + 15 * number), GREY, 0.36)
    return row


def _write(image: "NDArray[np.uint8]", text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    import cv2

    cv2.putText(image, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


main = Command("gallery", GalleryConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
