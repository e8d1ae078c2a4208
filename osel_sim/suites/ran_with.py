"""What tasks are run with on this machine, for `run.json`."""

from collections.abc import Iterable
from typing import Any

from osel_sim.core import content
from osel_sim.formats.run_config import environment
from osel_sim.interface.suite import Task


def ran_with(tasks: Iterable[Task]) -> dict[str, Any]:
    """Versions, those of the suites' packages included, and the OpenGL backend: `none` where no suite renders in this process.

    Raises:
        DisplayError: a suite needs a backend, and none works.
    """
    from osel_sim.sim.gl import choose_backend

    suites = [task.suite.spec for task in tasks]
    backend = choose_backend() if any(suite.opengl for suite in suites) else "none"
    return environment(backend, content.root(), sorted({package for suite in suites for package in suite.packages}))
