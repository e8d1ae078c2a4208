"""The monitor of a live run: what it sees is written down beside the journal, and told to it again when the run goes on."""

from collections.abc import Sequence
from pathlib import Path
from typing import override

from osel_sim.core.errors import DataError
from osel_sim.episodes.driver import monitor_seed
from osel_sim.episodes.handoffs import Fleet, Handoffs
from osel_sim.episodes.loop import Subscriber
from osel_sim.formats.journal import JOURNAL, Decision, Lines, as_read, check_beside, check_digests, line_digest
from osel_sim.formats.points import POINTS, Points, to_points
from osel_sim.interface.encoder import Encoder
from osel_sim.interface.monitor import DecisionPoint, Monitor, Turn, Watched
from osel_sim.selection.reward import RewardWeights, to_go


class RunMonitor:
    """A monitor with what a live run needs to use it and to go on with it.

    Args:
        monitor: has learnt nothing of the run's own decisions.
        policies: names of those that may drive.
        decide_every: a decision point is every so many calls, >= 1.
        encoder: of the pictures.
        weights: of the reward.
    """

    def __init__(self, monitor: Monitor, policies: Sequence[str], decide_every: int, encoder: Encoder, weights: RewardWeights) -> None:
        self.monitor, self.policies, self.decide_every = monitor, tuple(policies), decide_every
        self._encoder, self._weights = encoder, weights
        self._lines: Lines | None = None
        self._notes = _Notes()
        self._file = Path(POINTS)

    def open(self, folder: Path, decisions: int) -> None:
        """Look at what the folder holds of the run's decisions so far, and write what comes there.

        Raises:
            DataError: its lines are damaged, or do not fit the journal.
        """
        self._file = folder / POINTS
        check_beside(self._file, decisions, complete=True, going_on=True)
        check_digests(self._file)
        self._lines = Lines(self._file, keep=decisions)

    def handoffs(self, drivers: Fleet, horizon: int) -> Handoffs:
        """For the chosen policy's episode of the coming decision."""
        return Handoffs(drivers, self.policies, self.monitor, self.decide_every, horizon, self._encoder)

    def watch(self) -> Subscriber:
        """Notes what the monitor sees in the coming episode."""
        self._notes = _Notes()
        return self._notes

    def write(self, decision: Decision) -> str:
        """Write down what was seen in a decision's episode. Returns the line's checksum.

        Raises:
            DataError: the monitor gave what cannot be written, such as a number that is none.
        """
        line = Points(decision.index, tuple(self._notes.points), tuple(self._notes.turns)).to_dict()
        place = f"{self._file}, line {decision.index + 1}"
        to_points(as_read(line, place), decision.index, self._file, self.policies, decision.instruction)
        if self._lines is not None:
            self._lines.append(line)
        return line_digest(line)

    def learn(self, decision: Decision) -> None:
        """Let the monitor learn from the decision that was just made."""
        self._learn(decision, self._notes.points, self._notes.turns)

    def replay(self, decision: Decision) -> None:
        """Let the monitor live through a decision of the journal.

        Raises:
            DataError: its line is not of this decision, or the monitor now says otherwise.
        """
        if self._lines is None:
            raise DataError(f"{self._file} is not open")
        seen = to_points(self._lines.rows[decision.index][0], decision.index, self._file, self.policies, decision.instruction)
        self.monitor.reset(decision.instruction, decision.policy, monitor_seed(decision.instance, decision.policy))
        for number, (point, turn) in enumerate(zip(seen.points, seen.turns, strict=True)):
            now = self.monitor.drives_on(point)
            if now != turn:
                raise DataError(
                    f"{self._file}, line {decision.index + 1}, point {number}: says {turn.policy!r} drove on, this monitor now says {now.policy!r} "
                    f"with {now.propensities}: the run was made with other versions or on another machine"
                )
        told = decision.monitored
        if told is None or told.points != len(seen.points):
            raise DataError(f"{self._file}, line {decision.index + 1}: has {len(seen.points)} decision points, {JOURNAL} says otherwise")
        self._learn(decision, seen.points, seen.turns)

    def close(self) -> None:
        """Close the file."""
        if self._lines is not None:
            self._lines.close()

    def _learn(self, decision: Decision, points: Sequence[DecisionPoint], turns: Sequence[Turn]) -> None:
        if decision.reward is None:  # an error teaches nothing
            return
        rest = to_go(
            decision.reward, [point.seconds for point in points], [point.step for point in points], [point.price for point in points], self._weights
        )
        self.monitor.learn(Watched(tuple(points), tuple(turns), decision.outcome, decision.reward, rest))


class _Notes(Subscriber):
    """Keeps the decision points of an episode."""

    def __init__(self) -> None:
        self.points: list[DecisionPoint] = []
        self.turns: list[Turn] = []

    @override
    def on_point(self, point: DecisionPoint, turn: Turn) -> None:
        self.points.append(point)
        self.turns.append(turn)
