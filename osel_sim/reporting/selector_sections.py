"""What selectors came to over a stream of decisions, as figures: mean reward, regret, success against penalties, who was chosen."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate, mean_of, rate_of
from osel_sim.analysis.log import Array
from osel_sim.reporting.description import Bars, Figure, Line, Mark, Panel, Points, colours, thinned
from osel_sim.reporting.log_sections import score_label
from osel_sim.selection.reward import RewardWeights

MAIN = ("auto:warm", "auto", "ppo", "ppo_tuned", "epsilon_greedy", "random")
"""Of many selectors, those drawn without being asked for: the recommended one, and those of the paper's figure 5."""

ORACLES = {"hindsight": "hindsight oracle", "expected": "expected oracle", "predictable": "predictable oracle", "per_task": "per-task oracle"}
_FEW = 8
_NORMAL = 1.959964


@dataclass(frozen=True)
class Style:
    """How each way of choosing is drawn.

    Attributes:
        colour: of each name.
        shown: drawn without being asked for.
    """

    colour: Mapping[str, str]
    shown: frozenset[str]


@dataclass(frozen=True)
class Stream:
    """What one way of choosing received. S seeds (1 in a live run), T decisions; NaN where it is not known.

    Attributes:
        reward, success, score, penalty, seconds, price: (S, T); the score is what the reward counts as success, the penalty alpha_time time +
            alpha_price price.
        chosen: (S, T) column of the policy; None for what chooses none.
    """

    reward: Array
    success: Array
    score: Array
    penalty: Array
    seconds: Array
    price: Array
    chosen: NDArray[np.int64] | None = None


def style_of(names: Sequence[str], policies: Sequence[str], always: Mapping[str, str], keep: Collection[str] = (), learnable: str = "") -> Style:
    """Colours: a fixed policy has its policy's, hindsight and learnable oracle are ink, other oracles muted, all others have one of their own.

    Args:
        always: name of a fixed policy -> the policy.
        keep: shown in any case; of few names all are, of many the main ones; of the oracles the hindsight and the learnable one.
        learnable: name of that oracle.
    """
    oracles, bounds = set(ORACLES.values()), {ORACLES["hindsight"], learnable}
    of_policy = colours(policies)
    shown = [name for name in names if name in bounds or (name not in oracles and (len(names) <= _FEW or name in MAIN or name in keep))]
    # Those shown first: colours repeat, and two that are seen together must not share one.
    others = sorted((name for name in names if name not in always and name not in oracles), key=lambda name: name not in shown)
    own = colours([*policies, *others])
    colour = (
        {name: own.get(name, "muted") for name in names} | {name: of_policy[policy] for name, policy in always.items()} | dict.fromkeys(bounds, "ink")
    )
    return Style(colour, frozenset(shown))


def running_mean(values: Array) -> Array:
    """Mean of what is known up to each decision, (S, T)."""
    known = np.isfinite(values)
    count = known.cumsum(axis=-1)
    return np.where(count > 0, np.where(known, values, 0.0).cumsum(axis=-1) / np.maximum(count, 1), np.nan)


def curve_figure(streams: Mapping[str, Stream], style: Style) -> Figure:
    """Cumulative mean reward over decisions with bands over seeds (paper, figure 5)."""
    seeds = max(len(stream.reward) for stream in streams.values())
    marks = _lines({name: running_mean(stream.reward) for name, stream in streams.items()}, style)
    band = f" Bands: 95% intervals of the mean over {seeds} seeds." if seeds > 1 else ""
    caption = f"Mean of the rewards up to each decision (the paper's figure 5).{band} Click a name to hide or show it."
    panel = Panel("", "decision", "mean reward so far", marks, y_range=_settled_range(marks))
    return Figure("curves", "Learning curves", caption, [panel])


def regret_figure(streams: Mapping[str, Stream], references: Sequence[str], style: Style) -> Figure:
    """Cumulative regret: what each of the references (names of streams) would have received more."""
    panels = []
    for reference in references:
        base = streams[reference].reward
        regrets = {
            name: np.nan_to_num(base - stream.reward).cumsum(axis=-1)
            for name, stream in streams.items()
            if name not in ORACLES.values() and name != reference
        }
        panels.append(Panel(f"to {reference}", "decision", "cumulative regret (reward)", _lines(regrets, style)))
    caption = (
        "Reward that the reference would have received more, summed up to each decision; below zero a selector is ahead of it, falling it gains. "
        "Decisions in which some policy has no outcome add nothing."
    )
    return Figure("regret", "Regret", caption, panels)


def penalty_figure(streams: Mapping[str, Stream], weights: RewardWeights, style: Style) -> Figure:
    """Success against the weighted sum of time and price (paper, figure 6)."""
    label, scale = score_label(weights)
    marks: list[Mark] = []
    for name, stream in streams.items():
        score, penalty = over_seeds(stream.score), over_seeds(stream.penalty)
        if score is None or penalty is None:
            continue
        marks.append(
            Points(
                name,
                [penalty.value],
                [scale * score.value],
                style.colour[name],
                x_interval=([penalty.low], [penalty.high]),
                y_interval=([scale * score.low], [scale * score.high]),
                size=11,
                symbol="star" if name in ORACLES.values() else "circle",
                shown=name in style.shown,
            )
        )
    caption = (
        "Means over all decisions with 95% intervals (the paper's figure 6). Up and to the left is better; reward is height minus way to the right."
    )
    panel = Panel("", "alpha_time · time + alpha_price · cents (reward)", label, marks)
    return Figure("success_against_penalty", f"{label.partition(' (')[0].capitalize()} against time and cost", caption, [panel])


def share_figure(streams: Mapping[str, Stream], policies: Sequence[str], style: Style) -> Figure | None:
    """How often each selector chose each policy lately."""
    chosen = {name: stream.chosen for name, stream in streams.items() if stream.chosen is not None}
    if not chosen or len(policies) < 2:
        return None
    panels = []
    for column, policy in enumerate(policies if len(policies) > 2 else policies[-1:], 0 if len(policies) > 2 else 1):
        marks: list[Mark] = []
        for name, columns in chosen.items():
            share = _moving(100.0 * (columns == column).mean(axis=0))
            at = thinned(len(share))
            marks.append(Line(name, at + 1, share[at], style.colour[name], shown=name in style.shown))
        panels.append(Panel(policy, "decision", "chosen (%)", marks, y_range=(-2.0, 102.0)))
    caption = "Share of the decisions, over all seeds and the latest tenth of the stream up to each decision, in which a policy was chosen."
    return Figure("choices", "Who is chosen", caption, panels)


def gap_figure(gaps: Mapping[str, tuple[Estimate | float | None, Estimate | float | None]], oracle: str) -> Figure | None:
    """Share of the learnable gap closed, over the whole stream and its last quarter.

    Args:
        gaps: of each selector, None where it has none.
        oracle: what 100% is.
    """
    shown = {name: both for name, both in gaps.items() if any(value is not None for value in both)}
    if not shown:
        return None
    marks: list[Mark] = []
    for place, (label, colour) in enumerate((("whole stream", "c0"), ("last quarter", "c3"))):
        found = [(name, _with_ends(both[place])) for name, both in shown.items()]
        found = [(name, estimate) for name, estimate in found if np.isfinite(estimate.value)]
        if not found:
            continue
        values, low, high = ([100 * getattr(estimate, end) for _, estimate in found] for end in ("value", "low", "high"))
        marks.append(Bars(label, [name for name, _ in found], values, colour, low, high))
    caption = f"0% is the best single policy, 100% the {oracle}. With 95% intervals over seeds and over what the expected oracle may be off."
    caption += " A selector that sees more than an oracle by groups can pass it."
    return Figure("gap_closed", "Share of the learnable gap closed", caption, [Panel("", "", "learnable gap closed (%)", marks)])


def _with_ends(value: Estimate | float | None) -> Estimate:
    """Of a number without interval the ends are NaN, which draws none."""
    if isinstance(value, Estimate):
        return value
    return Estimate(np.nan if value is None else value, np.nan, np.nan)


def over_seeds(values: Array) -> Estimate | None:
    """Mean over decisions and seeds (S, T), with the interval over seeds; of a single seed, that over its decisions."""
    known = np.isfinite(values)
    if not known.any():
        return None
    means = np.array([row[mask].mean() for row, mask in zip(values, known, strict=True) if mask.any()])
    if len(means) == 1:
        return rate_of(values.T) if np.isin(values[known], (0.0, 1.0)).all() else mean_of(values)
    half = _NORMAL * float(means.std(ddof=1)) / np.sqrt(len(means))
    return Estimate(float(means.mean()), float(means.mean() - half), float(means.mean() + half))


def _lines(values: Mapping[str, Array], style: Style) -> list[Mark]:
    marks: list[Mark] = []
    for name, table in values.items():
        at = thinned(table.shape[1])
        part = table[:, at]
        mean = part.mean(axis=0)
        half = _NORMAL * part.std(axis=0, ddof=1) / np.sqrt(len(part)) if len(part) > 1 else None
        low, high = (None, None) if half is None else (mean - half, mean + half)
        wide = 2.6 if name in ("auto", "ppo") else 1.7
        dash = name == ORACLES["hindsight"] or (name == ORACLES["predictable"] and style.colour[name] == "muted")
        marks.append(Line(name, at + 1, mean, style.colour[name], low, high, dash, wide, shown=name in style.shown))
    return marks


def _settled_range(marks: Sequence[Mark]) -> tuple[float, float] | None:
    """Limits of the y axis that show what is drawn after the first few decisions, in which luck rules."""
    low: list[float] = []
    high: list[float] = []
    for mark in marks:
        if isinstance(mark, Line) and mark.shown:
            settled = np.asarray(mark.x) >= min(30.0, 0.3 * float(np.max(np.asarray(mark.x))))
            for values, ends in ((mark.y, (low, high)), (mark.low, (low,)), (mark.high, (high,))):
                known = np.asarray(values, np.float64)[settled] if values is not None else np.zeros(0)
                known = known[np.isfinite(known)]
                for end in ends if known.size else ():
                    end.append(float(known.min() if end is low else known.max()))
    if not low or not high:
        return None
    margin = 0.06 * max(max(high) - min(low), 1e-6)
    return min(low) - margin, max(high) + margin


def _moving(values: Array) -> Array:
    """Mean over the latest tenth, at least 5 decisions."""
    window = max(5, len(values) // 10)
    sums = np.concatenate([[0.0], values.cumsum()])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts), np.float64)
