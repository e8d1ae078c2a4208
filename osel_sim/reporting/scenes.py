"""How instances of a log begin, rendered again from their seeds."""

from pathlib import Path

import numpy as np

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.core.errors import DataError
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.reporting.episodes import jpeg

SIZE = 240


def render_scenes(log: LoggedOutcomes, count: int, tasks: Path | None = None) -> dict[int, bytes]:
    """Pictures of so many instances, spread evenly over the log: instance -> JPEG.

    Args:
        tasks: folder with task files of the user's own.

    Raises:
        UnknownNameError: no such task or suite here.
        MissingPackageError: a suite needs a package that is not installed.
        DataError: an instance has no seed, or the task now makes another instance of it.
        DisplayError: no OpenGL backend works.
    """
    from osel_sim.formats.levels import parse_axes
    from osel_sim.suites.registry import find_task

    rows = np.unique(np.linspace(0, len(log) - 1, min(count, len(log))).round().astype(int)).tolist()
    wanted = sorted({(log.instances[row].task, log.instances[row].robot or "") for row in rows})
    pictures: dict[int, bytes] = {}
    for name, robot in wanted:
        own = find_task(name, tasks)
        task = find_task(name, tasks, robot or DEFAULT_ROBOT) if own.robot else own  # a file may name another robot since
        env = task.open()
        try:
            for row in rows:
                logged = log.instances[row]
                if (logged.task, logged.robot or "") != (name, robot):
                    continue
                if logged.seed is None or logged.level is None or logged.split is None:
                    raise DataError(f"{log.source}: instance {logged.key!r} has no seed, level and split, so it cannot be rendered again")
                label = logged.key.removeprefix(name).split("/")[2]  # the key has what the columns lack
                perturbed = parse_axes((part for part in label.split(",") if "=" in part), task.suite.spec.axes)
                instance = task.instance(logged.seed, logged.level, logged.split, perturbed)
                if (instance.key, instance.instruction) != (logged.key, logged.instruction):
                    raise DataError(f"task {name!r} no longer makes the instance {logged.key!r} of {log.source}")
                env.load(instance)
                pictures[row] = jpeg(env.image(env.specification.context_camera, SIZE, SIZE, "full"), SIZE)
        finally:
            env.close()
    return pictures
