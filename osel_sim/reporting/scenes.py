"""How instances of a log begin, rendered again from their seeds."""

from pathlib import Path

import numpy as np

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.core import content
from osel_sim.core.errors import DataError
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.reporting.episodes import jpeg

CAMERA, SIZE = "agentview", 240


def render_scenes(log: LoggedOutcomes, count: int, tasks: Path | None = None) -> dict[int, bytes]:
    """Pictures of so many instances, spread evenly over the log: instance -> JPEG.

    Args:
        tasks: folder with task files of the user's own.

    Raises:
        UnknownNameError: no such task here.
        DataError: an instance has no seed, or the task now makes another instance of it.
        DisplayError: no OpenGL backend works.
    """
    from osel_sim.formats.levels import parse_axes
    from osel_sim.formats.task_file import load_task_file
    from osel_sim.sim.env import TaskEnv
    from osel_sim.sim.gl import choose_backend
    from osel_sim.sim.instance import make_instance
    from osel_sim.sim.robots import with_robot

    rows = np.unique(np.linspace(0, len(log) - 1, min(count, len(log))).round().astype(int)).tolist()
    wanted = sorted({(log.instances[row].task, log.instances[row].robot or DEFAULT_ROBOT) for row in rows})
    choose_backend()
    pictures: dict[int, bytes] = {}
    for name, robot in wanted:
        task = with_robot([load_task_file(content.find("tasks", name, tasks))], robot)[0]
        env = TaskEnv(task)
        try:
            for row in rows:
                logged = log.instances[row]
                if (logged.task, logged.robot or DEFAULT_ROBOT) != (name, robot):
                    continue
                if logged.seed is None or logged.level is None or logged.split is None:
                    raise DataError(f"{log.source}: instance {logged.key!r} has no seed, level and split, so it cannot be rendered again")
                perturbed = parse_axes(part for part in logged.key.split("/")[2].split(",") if "=" in part)  # the key has what the columns lack
                instance = make_instance(task, logged.seed, logged.level, logged.split, perturbed)
                if (instance.key, instance.instruction) != (logged.key, logged.instruction):
                    raise DataError(f"{task.file} no longer makes the instance {logged.key!r} of {log.source}")
                env.load(instance)
                pictures[row] = jpeg(env.image(CAMERA, SIZE, SIZE, "full"), SIZE)
        finally:
            env.close()
    return pictures
