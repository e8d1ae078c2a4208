"""Monitors that hand over where a signal says that the driver is in trouble; they learn nothing."""

from collections.abc import Sequence
from typing import override

from osel_sim.interface.monitor import Candidate, DecisionPoint, Turn
from osel_sim.selection.monitors.base import MonitorBase, number

STILL = 0.03
"""A robot whose state changed by no more than this from one decision point to the next (root mean square over metres and radians) stands still.

Like `SAME` and `LIMIT` chosen on the learning half of `assets/logs/moments`; see `docs/moments.md`."""
SAME = 0.03
"""Images that differ by no more than this share of their range are the same."""
LIMIT = 0.2
"""Chunks that differ by more than this share of half an action's range do not want the same thing."""


class StallMonitor(MonitorBase):
    """Hands over where neither the robot's state nor the picture have changed since the decision point before.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
        to: whom to; empty: the first policy on the other side of the network.

    Raises:
        UnknownNameError: `to` is no candidate.
    """

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int, to: str = "") -> None:
        super().__init__(candidates, picture_dim, seed)
        self._to = self.known(to, "TO of monitor stall") if to else ""

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        change = point.look.change()
        still = point.moved is None or point.moved <= STILL
        if change is None or change > SAME or not still:
            return Turn(point.driver)
        moved = "" if point.moved is None else f"robot moved {point.moved:.4f}, "
        return Turn(self._to or self.other(point.driver), f"{moved}picture {change:.4f}")


class DisagreementMonitor(MonitorBase):
    """Hands over where chunks differ that plan the same moments: the driver's last two, or the driver's and that of a policy that is asked for one.

    Asking costs a call of that policy at every decision point, in cents and in time.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
        limit: how far they may differ, in half ranges of an action, >= 0; empty: `LIMIT`.
        asked: the policy to ask, and to hand over to; empty: none is asked, and the first on the other side of the network takes over.

    Raises:
        UsageError: `limit` is no such number.
        UnknownNameError: `asked` is no candidate.
    """

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int, limit: str = "", asked: str = "") -> None:
        super().__init__(candidates, picture_dim, seed)
        self._limit = number(limit, "monitor disagreement: LIMIT", 0.0) if limit else LIMIT
        self._asked = self.known(asked, "ASKED of monitor disagreement") if asked else ""

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        if self._asked == point.driver:
            return Turn(point.driver)
        apart = point.look.difference(self._asked) if self._asked else point.overlap
        if apart is None or apart <= self._limit:
            return Turn(point.driver)
        return Turn(self._asked or self.other(point.driver), f"chunks differ by {apart:.3f}")
