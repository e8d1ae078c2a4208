"""A contact sheet of every task at every level: `python -m osel_sim.gallery --out sheet.png`."""

import sys
from pathlib import Path
from typing import Annotated

from osel_sim.api.settings import CONTENT, MAIN, Count, Folder, Index, Names, Settings, settings
from osel_sim.cli.command import Command
from osel_sim.core.errors import SettingError
from osel_sim.core.files import write_bytes

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
    from osel_sim.cli.next_step import print_next
    from osel_sim.reporting.contact_sheet import SheetOptions, contact_sheet
    from osel_sim.suites.registry import ALL, select_tasks

    if config.out is None or config.out.suffix.lower() != ".png":
        raise SettingError("out", "is missing: give the .png to write" if config.out is None else f"{config.out} must end in .png")
    tasks = select_tasks(config.task or (ALL,), config.tasks, config.robot)
    if config.each_axis and len(tasks) != 1:
        raise SettingError("each_axis", f"shows one task: give --task with one of {', '.join(task.name for task in tasks)}")
    picture = contact_sheet(SheetOptions(config.seed, config.size, config.camera, config.each_axis), tasks)

    import cv2

    config.out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(config.out, cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
    print(f"written to {config.out}: {picture.shape[1]} x {picture.shape[0]} pixels")
    print_next(("runs one of them", "run", ["--task", tasks[0].name, *(["--tasks", config.tasks] if config.tasks else []), "--level", 0, 2]))
    return 0


main = Command("gallery", GalleryConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
