"""What worker processes that run episodes import, whatever the policies; so it is imported once for all of them."""

from collections.abc import Iterable

from osel_sim.interface.instance import OURS
from osel_sim.interface.suite import Task

_EPISODES = (
    "osel_sim.context.encoder",
    "osel_sim.episodes.drivers",
    "osel_sim.episodes.loop",
    "osel_sim.episodes.moments",
    "osel_sim.episodes.start",
    "osel_sim.episodes.view",
    "osel_sim.suites.open_tasks",
)


def worker_imports(tasks: Iterable[Task], torch: bool) -> tuple[str, ...]:
    """Names of modules, for `run_jobs`. Simulators of others stay out: to import one may open a display.

    Args:
        torch: whether every worker needs it.
    """
    ours = ("osel_sim.sim.ahead",) if any(task.suite.spec.name == OURS for task in tasks) else ()
    return (*_EPISODES, *ours, *(("torch",) if torch else ()))
