"""A contact sheet of every task at every level: `python -m osel_sim.gallery --out sheet.png`."""

import argparse
import contextlib
import os
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim import cli
from osel_sim.core import content
from osel_sim.core.errors import UsageError
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


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    known = list(content.files("tasks", options.tasks))
    names = known if options.task in (None, [ALL]) else options.task
    if options.out.suffix.lower() != ".png":
        raise UsageError(f"--out {options.out} must end in .png")
    if options.each_axis and len(names) != 1:
        raise UsageError(f"--each-axis shows one task: give --task with one of {', '.join(known)}")
    picture = _sheet(options, names)

    import cv2

    partial = options.out.with_name(f".{options.out.name}.partial")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    partial.write_bytes(cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
    os.replace(partial, options.out)
    print(f"{options.out}: {picture.shape[1]} x {picture.shape[0]} pixels")
    return 0


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("gallery", "Draw a contact sheet: a row a task (or an axis), a column a level, the instruction underneath.", EXAMPLES)
    add = result.add_argument
    add("--task", nargs="+", metavar="NAME", help="which tasks (default: all)")
    add("--each-axis", action="store_true", help="of one task: a row for each axis alone")
    add("--seed", type=cli.non_negative_int, default=0, help="of the instances (default: %(default)s)")
    add("--size", type=cli.positive_int, default=256, help="pixels of a picture, square (default: %(default)s)")
    add("--camera", choices=("agentview", "wrist"), default="agentview", help="default: %(default)s")
    add("--out", type=Path, required=True, metavar="FILE", help="the .png to write")
    add("--tasks", type=cli.folder, metavar="DIR", help="folder with task files of your own")
    return result


def _sheet(options: argparse.Namespace, names: Sequence[str]) -> "NDArray[np.uint8]":
    import numpy as np

    from osel_sim.formats.task_file import load_task_file
    from osel_sim.sim.env import TaskEnv
    from osel_sim.sim.gl import choose_backend

    tasks = [load_task_file(content.find("tasks", name, options.tasks)) for name in names]
    choose_backend()
    rows: list[NDArray[np.uint8]] = []
    for task in tasks:
        with contextlib.closing(TaskEnv(task)) as env:
            if options.each_axis:
                rows += [_row(options, env, axis, [{axis: level} for level in LEVELS]) for axis in AXES if axis in task.axes]
            else:
                rows.append(_row(options, env, task.name, [dict.fromkeys(task.axes, level) for level in LEVELS]))
    header = np.full((HEADER, rows[0].shape[1], 3), PAPER, np.uint8)
    for level in LEVELS:
        _write(header, f"level {level}", (MARGIN + level * options.size + 6, 18), INK, 0.5)
    return np.concatenate([header, *rows])


def _row(options: argparse.Namespace, env: "TaskEnv", name: str, settings: Sequence[Mapping[str, int]]) -> "NDArray[np.uint8]":
    """One row: the same seed, more and more perturbed."""
    import numpy as np

    from osel_sim.sim.instance import make_instance

    size: int = options.size
    row = np.full((size + BAND, MARGIN + len(settings) * size, 3), PAPER, np.uint8)
    for number, line in enumerate(textwrap.wrap(name.replace("_", " "), 14)):
        _write(row, line, (8, 24 + 20 * number), INK, 0.5)
    for column, axes in enumerate(settings):
        instance = make_instance(env.task, options.seed, axes=axes)
        env.load(instance)
        left = MARGIN + column * size
        row[:size, left : left + size] = env.image(options.camera, size, size, "full")
        for number, line in enumerate(textwrap.wrap(instance.instruction, size // 7)[:3]):
            _write(row, line, (left + 4, size + 15 + 15 * number), GREY, 0.36)
    return row


def _write(image: "NDArray[np.uint8]", text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    import cv2

    cv2.putText(image, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


if __name__ == "__main__":
    sys.exit(main(None))
