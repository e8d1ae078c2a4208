"""A contact sheet of every task at every level: `python -m osel_sim.gallery --out sheet.png`."""

import contextlib
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from osel_sim.api.settings import CONTENT, MAIN, Count, Folder, Index, Names, Settings, settings
from osel_sim.cli.command import Command
from osel_sim.core.errors import SettingError, UnknownNameError
from osel_sim.core.files import write_bytes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from osel_sim.interface.environment import Environment
    from osel_sim.interface.suite import Task

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
    """which tasks: names, tag:TAG, or all; of other suites SUITE:NAME (default: all)"""
    each_axis: Annotated[bool, MAIN] = False
    """of one task: a row for each axis alone"""
    seed: Annotated[Index, MAIN] = 0
    """of the instances"""
    size: Annotated[Count, MAIN] = 256
    """pixels of a picture, square"""
    camera: Annotated[str | None, MAIN] = None
    """which camera, such as wrist (default: the one that encoders are shown)"""
    robot: Annotated[str | None, MAIN] = None
    """robot that stands there, such as UR5e (default: the one each task file names, else Panda)"""
    tasks: Annotated[Folder | None, CONTENT] = None
    """folder with task files of your own"""


def _execute(config: GalleryConfig) -> int:
    from osel_sim.suites.registry import ALL, select_tasks

    if config.out is None or config.out.suffix.lower() != ".png":
        raise SettingError("out", "is missing: give the .png to write" if config.out is None else f"{config.out} must end in .png")
    tasks = select_tasks(config.task or (ALL,), config.tasks, config.robot)
    if config.each_axis and len(tasks) != 1:
        raise SettingError("each_axis", f"shows one task: give --task with one of {', '.join(task.name for task in tasks)}")
    picture = _sheet(config, tasks)

    import cv2

    config.out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(config.out, cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
    print(f"{config.out}: {picture.shape[1]} x {picture.shape[0]} pixels")
    return 0


def _sheet(config: GalleryConfig, tasks: "Sequence[Task]") -> "NDArray[np.uint8]":
    import numpy as np

    levels = sorted({level for task in tasks for level in task.suite.spec.levels})
    rows: list[NDArray[np.uint8]] = []
    for task in tasks:
        if config.camera not in (None, *task.specification.cameras):
            raise UnknownNameError("camera", config.camera or "", task.specification.cameras, f"--camera; task {task.name}")
        own = [level if level in task.suite.spec.levels else None for level in levels]
        with contextlib.closing(task.open()) as env:
            if config.each_axis:
                axes = [axis for axis in task.suite.spec.axes if axis in task.info.axes]
                rows += [_row(config, task, env, axis, [None if level is None else {axis: level} for level in own]) for axis in axes]
            else:
                rows.append(_row(config, task, env, task.name, own))
    if not rows:
        raise SettingError("each_axis", f"task {tasks[0].name} has no axes")
    header = np.full((HEADER, rows[0].shape[1], 3), PAPER, np.uint8)
    for column, level in enumerate(levels):
        _write(header, f"level {level}", (MARGIN + column * config.size + 6, 18), INK, 0.5)
    return np.concatenate([header, *rows])


def _row(
    config: GalleryConfig, task: "Task", env: "Environment", name: str, settings: "Sequence[int | Mapping[str, int] | None]"
) -> "NDArray[np.uint8]":
    """One row: the same seed, more and more perturbed: by a level, or by axes at levels of their own; None leaves a gap."""
    import numpy as np

    size = config.size
    row = np.full((size + BAND, MARGIN + len(settings) * size, 3), PAPER, np.uint8)
    for number, line in enumerate(textwrap.wrap(name.replace("_", " "), 14)):
        _write(row, line, (8, 24 + 20 * number), INK, 0.5)
    for column, setting in enumerate(settings):
        if setting is None:
            continue
        instance = task.instance(config.seed, setting) if isinstance(setting, int) else task.instance(config.seed, axes=setting)
        env.load(instance)
        left = MARGIN + column * size
        row[:size, left : left + size] = env.image(config.camera or env.specification.context_camera, size, size, "full")
        for number, line in enumerate(textwrap.wrap(instance.instruction, size // 7)[:3]):
            _write(row, line, (left + 4, size + 15 + 15 * number), GREY, 0.36)
    return row


def _write(image: "NDArray[np.uint8]", text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    import cv2

    cv2.putText(image, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


main = Command("gallery", GalleryConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
