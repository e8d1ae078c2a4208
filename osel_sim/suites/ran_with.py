"""What tasks are run with on this machine, for `run.json`."""

from collections.abc import Iterable
from typing import Any

from osel_sim.core import content
from osel_sim.formats.run_config import environment
from osel_sim.interface.suite import Task
from osel_sim.suites.environments import environment as suite_environment


def ran_with(tasks: Iterable[Task]) -> dict[str, Any]:
    """Versions, those of the suites' packages included, the OpenGL backend (`none` where no suite renders), and what the suites cannot do.

    Raises:
        DisplayError: a suite needs a backend, and none works.
    """
    from osel_sim.sim.gl import choose_backend

    suites = {task.suite.spec.name: task.suite.spec for task in tasks}.values()
    backend = choose_backend() if any(suite.opengl for suite in suites) else "none"
    beside_us = sorted({package for suite in suites if not suite.environments for package in suite.packages})
    found = environment(backend, content.root(), beside_us)
    for suite in suites:
        for place in suite.environments:
            own = suite_environment(place).versions(suite.packages)
            found["versions"] |= {f"{place}/{package}": version for package, version in own.items()}
    cannot = {suite.name: "; ".join(suite.cannot) for suite in suites if suite.cannot}
    return found | ({"suites": cannot} if cannot else {})
