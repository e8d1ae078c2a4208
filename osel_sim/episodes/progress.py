"""The progress bar of a live run."""

import contextlib
import logging
from collections.abc import Mapping
from typing import override

from osel_sim.core.progress import Bar, progress
from osel_sim.episodes.run_subscribers import Run, RunSubscriber
from osel_sim.formats.journal import Decision
from osel_sim.formats.policy_changes import PolicyChange
from osel_sim.interface.outcome import credited

logger = logging.getLogger(__name__)


class Progress(RunSubscriber):
    """Draws a bar with mean reward, success and how often each policy was chosen.

    Args:
        decisions: how many there will be.
    """

    def __init__(self, decisions: int) -> None:
        self._total = decisions
        self._shown = contextlib.ExitStack()
        self._bar: Bar | None = None
        self._policies: list[str] = []
        self._seen: list[Decision] = []

    @override
    def on_start(self, run: Run) -> None:
        self._policies, self._seen = list(run.policies), list(run.decisions)
        self._bar = self._shown.enter_context(progress(self._total, "episode", initial=len(self._seen)))

    @override
    def on_event(self, event: PolicyChange) -> None:
        logger.info("%s", event.words)
        self._policies = list(dict.fromkeys([*self._policies, event.policy]))

    @override
    def on_choice(self, index: int, policy: str) -> None:
        if self._bar is not None:  # by now the environment is open, and what had to be compiled is
            self._bar.begin()

    @override
    def on_decision(self, decision: Decision, rewards: Mapping[str, float | None]) -> None:
        self._seen.append(decision)
        if self._bar is not None:
            self._bar.note(self._words())
            self._bar.update()

    @override
    def on_end(self, run: Run) -> None:
        self.close()

    @override
    def close(self) -> None:
        self._shown.close()

    def _words(self) -> str:
        rewards = [decision.reward for decision in self._seen if decision.reward is not None]
        successes = [credited(decision, "success") for decision in self._seen if decision.error is None]
        shares = (f"{name} {100 * sum(decision.policy == name for decision in self._seen) / len(self._seen):.0f}%" for name in self._policies)
        mean = (f"reward {sum(rewards) / len(rewards):.3f}, success {100 * sum(successes) / len(successes):.0f}%",) if rewards else ()
        return ", ".join((*mean, *shares))
