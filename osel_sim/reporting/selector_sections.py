"""What selectors came to over a stream of decisions, as figures: mean reward, regret, success against penalties, who was chosen."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate, rate_of
from osel_sim.analysis.log import Array
from osel_sim.analysis.streamed import over_units
from osel_sim.reporting.areas import stacked
from osel_sim.reporting.charts import Figure, Look, Panel, listed
from osel_sim.reporting.curves import Line, curves, settled_domain, thinned
from osel_sim.reporting.dots import Dot, certain, rows, scatter
from osel_sim.reporting.log_sections import score_label
from osel_sim.reporting.palette import colours
from osel_sim.selection.reward import RewardWeights

MAIN = ("auto:warm", "auto", "ppo", "ppo_tuned", "epsilon_greedy", "random")
"""Of many selectors, those drawn without being asked for: the recommended one, and those of the paper's figure 5."""

ORACLES = {"hindsight": "hindsight oracle", "expected": "expected oracle", "predictable": "predictable oracle", "per_task": "per-task oracle"}
_FEW = 8
_NORMAL = 1.959964
_SMOOTH = 60
"""Points of a curve of which there are many: sums and moving means are smooth."""


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


_MOST_PANELS = 24
"""Of so many policies it is drawn how often they are chosen; of more, of those chosen most."""


def look_of(names: Sequence[str], policies: Sequence[str], always: Mapping[str, str], keep: Collection[str] = (), learnable: str = "") -> Look:
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
    colour = {name: own.get(name, "muted") for name in names} | {name: of_policy[policy] for name, policy in always.items()}
    colour |= {name: "ink" for name in names if name in bounds}
    shapes = {name: "diamond" for name in always} | dict.fromkeys(oracles, "cross")
    return Look(colour, {ORACLES["hindsight"], ORACLES["predictable"]}, shapes, {name for name in names if name not in shown})


def running_mean(values: Array) -> Array:
    """Mean of what is known up to each decision, (S, T)."""
    known = np.isfinite(values)
    count = known.cumsum(axis=-1)
    return np.where(count > 0, np.where(known, values, 0.0).cumsum(axis=-1) / np.maximum(count, 1), np.nan)


def curve_figure(streams: Mapping[str, Stream], look: Look, policies: Sequence[str] = ()) -> Figure:
    """Cumulative mean reward over decisions with bands over orders (paper, figure 5).

    Args:
        policies: of a single selector: those it chose among, to show beside the curves how often it chose each.
    """
    seeds = max(len(stream.reward) for stream in streams.values())
    at, lines = _lines({name: running_mean(stream.reward) for name, stream in streams.items()})
    domain = settled_domain(at + 1, [line for line in lines if line.name not in look.hidden])
    panels: list[Panel] = [curves("", at + 1, lines, look, ("decision", "mean reward so far"), domain)]
    chosen = _shares(streams, len(policies)) if len(policies) > 1 else {}
    for name, shares in chosen.items():
        parts = {policy: shares[column][at] for column, policy in enumerate(policies)}
        panels.append(stacked("", at + 1, parts, Look(colours(policies)), ("decision", f"chosen by {name} (%)")))
    band = (
        f" Bands: the spread over {seeds} orders of the same instances (95% of their mean); the table has intervals over instances."
        if seeds > 1
        else ""
    )
    caption = f"Mean of the rewards up to each decision (the paper's figure 5).{band} Click a name to hide or show it."
    caption += " Right: share of the latest tenth of the decisions in which each policy was chosen." if chosen else ""
    ends = sorted(((float(np.asarray(line.y)[-1]), line.name) for line in lines), reverse=True)
    text = f"Curves of the mean reward over {int(at[-1]) + 1:,} decisions. At the end: {listed([f'{name} {value:.3f}' for value, name in ends])}."
    return Figure("curves", "Learning curves", caption, text, panels, look.hidden, one_legend=False)


def regret_figure(streams: Mapping[str, Stream], references: Sequence[str], look: Look) -> Figure:
    """Cumulative regret: what each of the references (names of streams) would have received more."""
    panels, ends = [], []
    own = look.only([name for name in streams if name not in ORACLES.values()])
    for reference in references:
        base = streams[reference].reward
        regrets = {name: np.nan_to_num(base - streams[name].reward).cumsum(axis=-1) for name in own.names if name != reference}
        at, lines = _lines(regrets, _SMOOTH)
        panels.append(curves(f"to {reference}", at + 1, lines, own, ("decision", "cumulative regret (reward)")))
        ends += [f"{name} to {reference} {float(table[:, -1].mean()):.1f}" for name, table in regrets.items() if name not in look.hidden]
    caption = (
        "Reward that the reference would have received more, summed up to each decision; below zero a selector is ahead of it, falling it gains. "
        "Decisions in which some policy has no outcome add nothing."
    )
    text = f"Curves of the regret summed over decisions. At the end: {listed(ends)}."
    return Figure("regret", "Regret", caption, text, panels, look.hidden)


def penalty_figure(
    streams: Mapping[str, Stream],
    weights: RewardWeights,
    look: Look,
    instances: NDArray[Any],
    units: NDArray[np.int64],
) -> Figure:
    """Success against the weighted sum of time and price (paper, figure 6).

    Args:
        instances: (S, T), which instance was decided on.
        units: (N,) of the instances.
    """
    label, scale = score_label(weights)
    dots: list[Dot] = []
    for name, stream in streams.items():
        score, penalty = (_mean_over(values, instances, units) for values in (stream.score, stream.penalty))
        if score is not None and penalty is not None:
            dots.append(Dot(name, penalty, Estimate(scale * score.value, scale * score.low, scale * score.high)))
    caption = (
        "Means over all decisions with 95% intervals over instances (the paper's figure 6). Up and to the left is better; reward is height minus way "
        "to the right. "
        "Diamonds: fixed policies; crosses: oracles. Dots that coincide stand side by side."
    )
    axes = ("alpha_time · time + alpha_price · cents (reward)", label)
    places = listed([f"{dot.name} {dot.y.value:.3g} at {dot.x.value:.3g}" for dot in dots])
    text = f"A dot for each way of choosing: {label} against the penalty. {places}."
    panel = scatter("", dots, look.only([dot.name for dot in dots]), axes)
    return Figure("success_against_penalty", f"{label.partition(' (')[0].capitalize()} against time and cost", caption, text, [panel], look.hidden)


def share_figure(streams: Mapping[str, Stream], policies: Sequence[str], look: Look) -> Figure | None:
    """How often each selector chose each policy lately."""
    shares = {name: own for name, own in _shares(streams, len(policies)).items() if len(policies) > 1}
    if not shares:
        return None
    at = thinned(next(len(own[0]) for own in shares.values()), _SMOOTH)
    caption = "Share of the decisions, over all seeds and the latest tenth of the stream up to each decision, in which a policy was chosen."
    ends = [
        f"{name} {policy} {share[-1]:.0f}%"
        for name, own in shares.items()
        if name not in look.hidden
        for policy, share in zip(policies, own, strict=True)
    ]
    text = f"Curves of how often each policy was chosen, a panel for each. At the end: {listed(ends, 12)}."
    chosen = np.sum([[share.mean() for share in own] for own in shares.values()], axis=0)
    drawn = sorted(np.argsort(-chosen, kind="stable")[:_MOST_PANELS].tolist())
    if len(drawn) < len(policies):
        caption += f" Of {len(policies)} policies these {len(drawn)} were chosen most."
    panels = []
    for column, policy in ((column, policies[column]) for column in drawn):
        lines = [Line(name, own[column][at]) for name, own in shares.items()]
        panels.append(curves(policy, at + 1, lines, look.only(list(shares)), ("decision", "chosen (%)"), (-2.0, 102.0)))
    return Figure("choices", "Who is chosen", caption, text, panels if len(policies) > 2 else panels[1:], look.hidden)


def gap_figure(gaps: Mapping[str, tuple[Estimate | float | None, Estimate | float | None]], oracle: str) -> Figure | None:
    """Share of the learnable gap closed, over the whole stream and its last quarter.

    Args:
        gaps: of each selector, None where it has none.
        oracle: what 100% is.
    """
    found: dict[str, dict[str, Estimate]] = {"whole stream": {}, "last quarter": {}}
    for name, both in gaps.items():
        for part, value in zip(found.values(), both, strict=True):
            if value is not None:
                part[name] = value if isinstance(value, Estimate) else certain(float(value))
    shown = [name for name in gaps if any(name in part for part in found.values())]
    if not shown:
        return None
    shown.sort(key=lambda name: -max(part[name].value for part in found.values() if name in part))
    scaled = {label: {name: Estimate(100 * own.value, 100 * own.low, 100 * own.high) for name, own in part.items()} for label, part in found.items()}
    caption = f"0% is the best single policy, 100% the {oracle}. With 95% intervals over instances and over what the expected oracle may be off."
    ends = [f"{name} {scaled['last quarter'][name].value:.0f}%" for name in shown if name in scaled["last quarter"]]
    text = f"Dots with intervals, a row for each selector. Share of the gap to the {oracle} closed in the last quarter: {listed(ends)}."
    look = Look({"whole stream": "muted", "last quarter": "ink"}, shapes={"last quarter": "diamond"})
    panel = rows("", shown, scaled, look, "learnable gap closed (%)")
    return Figure("gap_closed", "Share of the learnable gap closed", caption, text, [panel])


def _mean_over(values: Array, instances: NDArray[Any], units: NDArray[np.int64]) -> Estimate | None:
    """Mean over decisions and seeds (S, T) with its interval over units; of yes and no in a single stream Wilson's."""
    known = values[np.isfinite(values)]
    if len(values) == 1 and np.isin(known, (0.0, 1.0)).all():
        return rate_of(values.T, units[instances[0]])
    found = over_units(values, instances, units)
    if found is None:
        return None
    return Estimate(found.mean, *found.interval()) if found.units > 1 else certain(found.mean)


def _lines(values: Mapping[str, Array], most: int = 100) -> tuple[NDArray[np.int64], list[Line]]:
    """Which decisions are drawn, `most` of them, and of each name the mean over seeds with its band. All tables are (S, T) of the same T."""
    at = thinned(next(iter(values.values())).shape[1], most)
    lines = []
    for name, table in values.items():
        part = table[:, at]
        mean = part.mean(axis=0)
        half = _NORMAL * part.std(axis=0, ddof=1) / np.sqrt(len(part)) if len(part) > 1 else None
        lines.append(Line(name, mean) if half is None else Line(name, mean, mean - half, mean + half))
    return at, lines


def _shares(streams: Mapping[str, Stream], policies: int) -> dict[str, list[Array]]:
    """Of what chooses: for each policy the percent (T,) of the decisions, over all seeds and the latest tenth of them, in which it was chosen."""
    return {
        name: [_moving(100.0 * (stream.chosen == column).mean(axis=0)) for column in range(policies)]
        for name, stream in streams.items()
        if stream.chosen is not None
    }


def _moving(values: Array) -> Array:
    """Mean over the latest tenth, at least 5 decisions."""
    window = max(5, len(values) // 10)
    sums = np.concatenate([[0.0], values.cumsum()])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts), np.float64)
