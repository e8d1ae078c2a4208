"""Figures of a live run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")  # Paul Tol's bright scheme, told apart by colour-blind readers too


def learning_curve(file: Path, title: str, selector: str, policies: Sequence[str], chosen: Sequence[int], rewards: ArrayLike) -> None:
    """Mean reward so far of the selector (above) and how often each policy was chosen lately (below), over decisions.

    Args:
        file: the .png to write.
        chosen: (decisions,) column of the policy chosen.
        rewards: (decisions, policies), NaN where there is none. If a decision has all, each fixed policy and the hindsight oracle are drawn as well.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    table = np.asarray(rewards, np.float64)
    columns = np.asarray(chosen, np.int64)
    count = np.arange(1, len(table) + 1)
    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))

    complete = np.isfinite(table).all(axis=1)
    if complete.any():
        above.plot(count, _running_mean(np.where(complete, table.max(axis=1), np.nan)), "--", color="#444444", label="hindsight oracle")
        for index, policy in enumerate(policies):
            values = np.where(complete, table[:, index], np.nan)
            above.plot(count, _running_mean(values), color=COLOURS[index % len(COLOURS)], linewidth=1, label=f"always {policy}")
    above.plot(count, _running_mean(table[np.arange(len(table)), columns]), color="black", linewidth=2, label=selector)
    above.set_ylabel("mean reward so far")
    above.set_title(title)
    above.legend(fontsize=8)
    above.grid(alpha=0.3)

    window = max(5, len(table) // 10)
    shares = np.array([[np.mean(columns[max(0, end - window) : end] == index) for end in count] for index in range(len(policies))])
    below.stackplot(count, shares, labels=list(policies), colors=[COLOURS[index % len(COLOURS)] for index in range(len(policies))], alpha=0.8)
    below.set_ylim(0, 1)
    below.set_xlim(1, max(2, len(table)))
    below.set_xlabel("decision")
    below.set_ylabel(f"share, last {window}")
    below.legend(fontsize=8, loc="upper left")
    figure.savefig(file, dpi=120)


def _running_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the finite values up to each; NaN before the first."""
    known = np.isfinite(values)
    count = known.cumsum()
    total = np.where(known, values, 0.0).cumsum()
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
