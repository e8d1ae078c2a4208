"""Notices, while a live run goes on, that a policy succeeds less than it did, or costs another price than its file says."""

import logging
import math
from collections.abc import Collection, Mapping
from typing import override

from osel_sim.episodes.run_subscribers import Run, RunSubscriber
from osel_sim.formats.journal import Decision
from osel_sim.formats.policy_file import Price
from osel_sim.formats.run_warnings import RunWarning, write_warnings
from osel_sim.interface.outcome import credited
from osel_sim.statistics.change import RATE, FallDetector

logger = logging.getLogger(__name__)
CLOSE = 1e-6
"""Relative difference of prices that is rounding."""


class Watch:
    """Looks at each decision once, in order. What it says follows from the decisions alone, so that a run that goes on says the same again.

    A policy's successes are compared with what it came to in the same task at the same level (`osel_sim.statistics.change`), since selectors learn to
    send a policy where it is good. Within those, which of the instances it gets must not become harder than before. Falls are looked for and no
    rises: a selector that learns makes every policy look better. Decisions that a monitor watched are left out: who drove is not one policy's doing.

    Args:
        prices: of the policies by their files; what those that are missing cost is not looked at.
        strata: (task, level) of the decisions to come.
    """

    def __init__(self, prices: Mapping[str, Price], strata: Collection[tuple[str, int]]) -> None:
        self._prices = prices
        self._strata = {stratum: number for number, stratum in enumerate(dict.fromkeys(strata))}
        self._detectors: dict[str, FallDetector] = {}
        self._made: dict[str, list[int]] = {}  # policy -> indices of the decisions whose outcomes were looked at
        self._told: dict[str, float] = {}  # policy -> how many times the declared price was paid

    def see(self, decision: Decision) -> list[RunWarning]:
        """Take one more decision into account. Returns what there is to say."""
        if decision.error is not None or decision.monitored is not None:
            return []
        found = [self._price(decision), self._success(decision)]
        return [warning for warning in found if warning is not None]

    def _success(self, decision: Decision) -> RunWarning | None:
        name, stratum = decision.policy, self._strata.get((decision.task, decision.level))
        if stratum is None:
            return None
        detector = self._detectors.setdefault(name, FallDetector(len(self._strata)))
        self._made.setdefault(name, []).append(decision.index)
        if detector.see(stratum, credited(decision, "success") > 0.5)[0] < math.log(1.0 / RATE):
            return None
        fall = detector.likeliest()
        self._detectors[name] = detector.after()
        return RunWarning(decision.index, "success", name, self._made[name][fall.since], fall.before, fall.after)

    def _price(self, decision: Decision) -> RunWarning | None:
        """Once for each other price; what messages weighed is in no journal, so a policy that is paid by the megabyte is left out."""
        price = self._prices.get(decision.policy)
        if price is None or decision.fallback is not None or price.per_megabyte > 0.0:
            return None
        declared = price.of(decision.actions, decision.calls, 0.0)
        ratio = decision.price / declared if declared > 0.0 else float(decision.price > 0.0) + 1.0
        before = self._told.get(decision.policy, 1.0)
        if abs(ratio - before) <= CLOSE * before:
            return None
        self._told[decision.policy] = ratio
        return RunWarning(decision.index, "price", decision.policy, decision.index, declared, decision.price) if abs(ratio - 1.0) > CLOSE else None


class WarningFile(RunSubscriber):
    """Writes `warnings.jsonl` and says on the terminal what is new in it."""

    def __init__(self) -> None:
        self._run: Run | None = None

    @override
    def on_start(self, run: Run) -> None:
        self._run = run
        write_warnings(run.folder, list(run.warnings))

    @override
    def on_warning(self, warning: RunWarning) -> None:
        logger.warning("%s", warning.sentence)
        if self._run is not None:
            write_warnings(self._run.folder, list(self._run.warnings))
