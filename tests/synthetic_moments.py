"""Tables of moments whose answer is known."""

from pathlib import Path

import numpy as np

from osel_sim.analysis.log import LoggedInstance, LoggedOutcomes
from osel_sim.analysis.moment_log import KEPT, MomentLog
from osel_sim.formats.moments import SIGNALS, Seen

POLICIES = ("local", "remote")
CALLS = (4, 8)


def stuck_log(instances: int = 240, repeats: int = 2, seed: int = 0, seen: bool = True) -> MomentLog:
    """The local policy is stuck in 40% of the episodes, which the picture at call 4 shows (or with `seen` off, does not), and then fails unless the
    remote one takes over there; at call 8 it is too late. Otherwise it succeeds, and so does the remote one, for 20 cents."""
    random = np.random.default_rng(seed)
    stuck = random.random((instances, repeats)) < 0.4
    shape = (instances, 2, repeats, 2)
    ways = {name: np.zeros((*shape, 2)) for name in KEPT}
    for at, (before, rescued) in enumerate(((40, True), (80, False))):
        ways["success"][:, 0, :, at, 0] = ~stuck
        ways["success"][:, 0, :, at, 1] = ~stuck | rescued
        ways["success"][:, 1, :, at, :] = 1.0
        ways["price"][:, 0, :, at, 1], ways["remote_steps"][:, 0, :, at, 1] = 10.0, 100 - before
        ways["price"][:, 1, :, at, 1], ways["remote_steps"][:, 1, :, at, 1] = 20.0, 100
        ways["price"][:, 1, :, at, 0], ways["remote_steps"][:, 1, :, at, 0] = 20.0 * before / 100, before
    ways["subgoals"] = ways["success"].copy()
    ways["steps"][:] = 100.0
    ways["seconds"][:] = 5.0
    own = {name: np.stack([values[:, first, :, 0, first] for first in range(2)], axis=1) for name, values in ways.items()}
    pictures = random.normal(size=(instances * 2 * repeats * 2, 8)).astype(np.float32)
    seen_at = np.arange(len(pictures)).reshape(shape)
    if seen:
        pictures[seen_at[:, 0], 0] = np.where(stuck, 3.0, -3.0)[..., None]
    nothing = np.zeros((instances, 2, repeats))
    about = tuple(LoggedInstance(f"task/test/0/{number}", "task", seed=number, level=0, split="test") for number in range(instances))
    whole = LoggedOutcomes(
        Path("synthetic"), about, POLICIES, random.normal(size=(instances, 6)).astype(np.float32), "none", own["success"], own["subgoals"],
        nothing * np.nan, own["steps"], nothing, nothing, nothing, own["seconds"], own["price"], nothing > 0, nothing > 0, nothing > 0, {},
    )  # fmt: skip
    at_step = np.broadcast_to(np.array([40.0, 80.0]), shape).copy()
    signals = np.zeros((len(pictures), len(SIGNALS)))
    return MomentLog(whole, CALLS, ways, at_step, seen_at, Seen(pictures, signals), np.array([False, True]), {"every": 4, "most": 2})
