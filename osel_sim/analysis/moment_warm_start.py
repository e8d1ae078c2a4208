"""A warm start of a monitor: what came of handing over and of going on at the moments of a log, shown before a live run's first decision."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from osel_sim.analysis.asked_monitors import show_ways
from osel_sim.analysis.moment_log import MomentLog, read_moment_log
from osel_sim.core.errors import UsageError
from osel_sim.interface.monitor import Monitor
from osel_sim.selection.reward import RewardWeights


def check_can_start_warm(name: str, monitor: Monitor) -> None:
    """Whether a monitor may be shown episodes that it did not watch.

    Raises:
        UsageError: it learns nothing, or from its own decisions only.
    """
    if not getattr(monitor, "off_policy", False):
        raise UsageError(f"monitor {name!r} does not learn from episodes of others, so it cannot start warm; of ours value can")


def read_warm_start(folder: Path, encoder: str, policies: tuple[str, ...]) -> MomentLog:
    """The moments of a log between these policies.

    Raises:
        DataError, UnknownNameError: the log cannot be read, or lacks a policy.
        UsageError: its pictures are another encoder's.
    """
    log = read_moment_log(folder).only(policies)
    if log.metadata["encoder"] != encoder:
        raise UsageError(
            f"{folder}: its moments have pictures of the encoder {log.metadata['encoder']!r}, this run has {encoder!r}; give the same --encoder"
        )
    return log


def show_moments(monitor: Monitor, log: MomentLog, weights: RewardWeights, own: Collection[str]) -> int:
    """Let a monitor learn from every way on, except on instances that the run decides on. Returns how many instances there were."""
    others = np.array([key not in own for key in log.whole.keys], bool)
    show_ways(log, weights, monitor, others)
    return int(others.sum())
