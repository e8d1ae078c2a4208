"""A contact sheet: pictures of tasks, a row a task (or an axis), a column a level, the instruction underneath."""

import contextlib
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import SettingError, UnknownNameError
from osel_sim.interface.environment import Environment
from osel_sim.interface.suite import Task

BAND, MARGIN, HEADER = 55, 130, 26
"""Pixels: the instruction below a picture, the row's name at the left, the levels at the top."""
INK, GREY, PAPER = (30, 30, 30), (110, 110, 110), (255, 255, 255)


@dataclass(frozen=True)
class SheetOptions:
    """What a contact sheet shows.

    Attributes:
        seed: of the instances.
        size: pixels of a picture, square.
        camera: None: the one that encoders are shown.
        each_axis: of one task, a row for each axis alone.
    """

    seed: int
    size: int
    camera: str | None
    each_axis: bool


def contact_sheet(config: SheetOptions, tasks: Sequence[Task]) -> NDArray[np.uint8]:
    """Draw the sheet of some tasks, uint8 (height, width, 3).

    Raises:
        UnknownNameError: a task has no such camera.
        SettingError: a task has no axes to show alone.
    """
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


def _row(config: SheetOptions, task: Task, env: Environment, name: str, settings: Sequence[int | Mapping[str, int] | None]) -> NDArray[np.uint8]:
    """One row: the same seed, more and more perturbed: by a level, or by axes at levels of their own; None leaves a gap."""
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


def _write(image: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    import cv2

    cv2.putText(image, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
