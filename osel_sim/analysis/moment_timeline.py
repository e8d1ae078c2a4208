"""Episodes with who drove when, as a page draws them."""

from typing import Any

import numpy as np

from osel_sim.analysis.handovers import Handovers
from osel_sim.analysis.log import Array
from osel_sim.analysis.moment_log import MomentLog

MOST = 60


def timeline(log: MomentLog, share: Array, handovers: Handovers) -> list[dict[str, Any]]:
    """Some episodes, of all tasks in turn: the first policy is the one that the start selector chooses most often there, the repeat the first.

    Args:
        share: (N, P), how likely each first policy is chosen.
        handovers: (N, P, R, M, P), the most likely of which is drawn.

    Returns:
        of each: instance, task, first, second and at (control step of the handover) or null, steps, success, and success_alone: of the first policy
        to the end.
    """
    tasks = log.whole.labels("task")
    order = sorted(range(len(log)), key=lambda row: (tasks[:row].count(tasks[row]), tasks[row]))
    found = []
    for row in order[:MOST]:
        first = int(share[row].argmax())
        chance = handovers[row, first, 0]
        at, second = np.unravel_index(int(chance.argmax()), chance.shape)
        passes = chance[at, second] > 0.5
        won, steps = (log.ways[name][row, first, 0, at, second] if passes else log.alone[name][row, first, 0] for name in ("success", "steps"))
        alone = log.alone["success"][row, first, 0]
        if not np.isfinite(won) or not np.isfinite(alone):
            continue
        found.append(
            {
                "instance": log.whole.keys[row],
                "task": tasks[row],
                "first": log.policies[first],
                "second": log.policies[int(second)] if passes else None,
                "at": int(log.at_step[row, first, 0, at]) if passes else None,
                "steps": int(steps),
                "success": bool(won > 0.5),
                "success_alone": bool(alone > 0.5),
            }
        )
    return sorted(found, key=lambda one: (one["task"], one["instance"]))
