"""TensorBoard event files of a live run: `tensorboard/` in its folder."""

import importlib.util
import math
from collections.abc import Mapping
from typing import Any, override

from osel_sim.core.errors import UsageError
from osel_sim.episodes.run_subscribers import Run, RunSubscriber
from osel_sim.formats.journal import Decision
from osel_sim.formats.policy_changes import PolicyChange
from osel_sim.interface.outcome import credited

FOLDER = "tensorboard"


def check_installed() -> None:
    """Raises UsageError where the optional package is missing, before anything heavy is loaded."""
    if importlib.util.find_spec("tensorboard") is None:
        raise UsageError("--tensorboard needs the package tensorboard: pip install 'osel-sim[tensorboard]'")


class TensorBoard(RunSubscriber):
    """Writes a run's decisions as scalars, step by step.

    A resumed run writes its earlier decisions again, from the journal, in place of the old event files: what a killed process had not yet written is
    then there as well, and nothing is there twice.
    """

    def __init__(self) -> None:
        self._writer: Any = None
        self._policies: list[str] = []
        self._reward, self._success, self._valid, self._regret = 0.0, 0.0, 0, 0.0

    @override
    def on_start(self, run: Run) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        for old in (run.folder / FOLDER).glob("events.out.tfevents.*"):
            old.unlink()
        self._writer, self._policies = SummaryWriter(str(run.folder / FOLDER)), list(run.policies)
        for decision, row in zip(run.decisions, run.rewards.tolist(), strict=True):
            self._add(decision, dict(zip(self._policies, row, strict=True)))
        self._writer.flush()

    @override
    def on_event(self, event: PolicyChange) -> None:
        self._policies = list(dict.fromkeys([*self._policies, event.policy]))
        self._writer.add_text("event", event.words, event.before)

    @override
    def on_decision(self, decision: Decision, rewards: Mapping[str, float | None]) -> None:
        self._add(decision, {policy: math.nan if rewards.get(policy) is None else float(rewards[policy] or 0.0) for policy in self._policies})
        self._writer.flush()

    @override
    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()

    def _add(self, decision: Decision, rewards: Mapping[str, float]) -> None:
        scalars = {f"propensity/{policy}": decision.propensities.get(policy, 0.0) for policy in self._policies}
        scalars |= {f"chosen/{policy}": float(decision.policy == policy) for policy in self._policies}
        if decision.error is None and decision.reward is not None:
            self._valid += 1
            self._reward += decision.reward
            success = credited(decision, "success")
            self._success += success
            scalars |= {
                **{"decision/reward": decision.reward, "decision/success": success, "decision/steps": float(decision.steps)},
                **{"decision/seconds": decision.seconds.motion, "decision/price": decision.price},
                **{"mean/reward": self._reward / self._valid, "mean/success": self._success / self._valid},
            }
        if all(map(math.isfinite, rewards.values())) and decision.reward is not None:
            self._regret += max(rewards.values()) - decision.reward
            scalars["mean/cumulative_regret"] = self._regret
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, decision.index)
