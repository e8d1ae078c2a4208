"""TensorBoard event files of a live run: `tensorboard/` in its folder."""

import importlib.util
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError

if TYPE_CHECKING:
    from osel_sim.episodes.live import LiveRun
    from osel_sim.formats.journal import Decision

FOLDER = "tensorboard"


def check_installed() -> None:
    """Raises UsageError where the optional package is missing, before anything heavy is loaded."""
    if importlib.util.find_spec("tensorboard") is None:
        raise UsageError("--tensorboard needs the package tensorboard: pip install 'osel-sim[tensorboard]'")


class TensorBoard:
    """Writes a run's decisions as scalars, step by step.

    A resumed run writes its earlier decisions again, from the journal, in place of the old event files: what a killed process had not yet written is
    then there as well, and nothing is there twice.
    """

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        for old in (folder / FOLDER).glob("events.out.tfevents.*"):
            old.unlink()
        self._writer = SummaryWriter(str(folder / FOLDER))
        self._written = 0
        self._reward, self._success, self._valid, self._regret = 0.0, 0, 0, 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writer.close()

    def update(self, live: "LiveRun") -> None:
        """Write all decisions that are not written yet."""
        rewards = live.rewards
        for decision in live.decisions[self._written :]:
            self._add(decision, rewards[decision.index], live.selector.policies)
        self._written = len(live.decisions)
        self._writer.flush()

    def _add(self, decision: "Decision", rewards: NDArray[np.float64], policies: "tuple[str, ...] | list[str]") -> None:
        scalars = {f"propensity/{policy}": decision.propensities.get(policy, 0.0) for policy in policies}
        scalars |= {f"chosen/{policy}": float(decision.policy == policy) for policy in policies}
        if decision.error is None and decision.reward is not None:
            self._valid += 1
            self._reward += decision.reward
            self._success += decision.success
            scalars |= {
                **{"decision/reward": decision.reward, "decision/success": float(decision.success), "decision/steps": float(decision.steps)},
                **{"decision/seconds": decision.seconds.motion, "decision/price": decision.price},
                **{"mean/reward": self._reward / self._valid, "mean/success": self._success / self._valid},
            }
        if np.isfinite(rewards).all() and decision.reward is not None:
            self._regret += float(rewards.max()) - decision.reward
            scalars["mean/cumulative_regret"] = self._regret
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, decision.index)
