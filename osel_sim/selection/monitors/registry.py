"""Monitors by name. Listing them imports none: torch and stable-baselines3 come in with the monitor that needs them."""

import inspect
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.core.registry import Registry

if TYPE_CHECKING:  # imports numpy
    from osel_sim.interface.monitor import Candidate, Monitor

ENTRY_POINTS = "osel_sim.monitors"
"""Entry-point group in which other packages offer monitors: `name = "module:Class"`."""

BUILT_IN = {
    "blind": "osel_sim.selection.monitors.unseeing:BlindMonitor",
    "disagreement": "osel_sim.selection.monitors.signals:DisagreementMonitor",
    "never": "osel_sim.selection.monitors.unseeing:NeverMonitor",
    "ppo": "osel_sim.selection.monitors.ppo:PPOMonitor",
    "random": "osel_sim.selection.monitors.unseeing:RandomMonitor",
    "stall": "osel_sim.selection.monitors.signals:StallMonitor",
    "value": "osel_sim.selection.monitors.value:ValueMonitor",
}

FORMS = {
    "blind": "blind:K or blind:K:TO",
    "disagreement": "disagreement, disagreement:LIMIT or disagreement:LIMIT:ASKED",
    "random": "random:P",
    "stall": "stall or stall:TO",
    "value": "value or value:MOST",
}
"""How those are written that take parameters."""

ABOUT = {
    "blind": "blind:K[:TO]: hands over (to TO) after K calls, whatever happens",
    "disagreement": "disagreement[:LIMIT[:ASKED]]: hands over where the driver's chunks, or its own and that of ASKED, differ by more than LIMIT",
    "never": "never hands over",
    "ppo": "PPO of stable-baselines3 on the sequential problem: learns, slowly",
    "random": "random:P: at random, so that remote policies drive a share P of the steps",
    "stall": "stall[:TO]: hands over (to TO) where neither robot nor picture move any more",
    "value": "value[:MOST]: learns what going on and handing over come to, and hands over at most MOST times an episode (1)",
}
"""A line about each of our own."""

MONITORS = Registry[Any]("monitor", ENTRY_POINTS, BUILT_IN)


def monitor_locations() -> dict[str, str]:
    """Name -> `module:Class` of every monitor, installed plugins included; a plugin cannot replace a built-in one."""
    return MONITORS.locations()


def make_monitor(name: str, candidates: "Sequence[Candidate]", picture_dim: int, seed: int) -> "Monitor":
    """Build a monitor.

    Args:
        name: as `monitor_locations` lists it, with its parameters after colons, such as `blind:8:remote_large`.
        candidates: the policies that may drive.
        picture_dim: length of a picture.
        seed: of everything random in it.

    Raises:
        UnknownNameError: no such monitor, or a parameter names a policy that is not among the candidates.
        UsageError: it does not take these parameters.
    """
    from osel_sim.formats.merged_policy import MERGE  # imports pydantic, which a list does without

    kind, *parameters = re.split(f"(?<!:{MERGE}):", name)  # a parameter may be the name of a merge, which has a colon of its own
    if kind not in MONITORS:
        raise UnknownNameError("monitor", name, MONITORS, "--list shows what they are")
    factory = MONITORS.load(kind)
    try:
        inspect.signature(factory).bind(candidates, picture_dim, seed, *parameters)
        fits = "" not in parameters
    except TypeError:
        fits = False
    if not fits:
        form = FORMS.get(kind, kind if kind in BUILT_IN else f"{kind} with other parameters")
        raise UsageError(f"monitor {name!r}: write {form}")
    return cast("Monitor", factory(candidates, picture_dim, seed, *parameters))
