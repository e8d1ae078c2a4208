"""Panels of dots: against two axes, in rows with their intervals, and clouds of many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import altair as alt
import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.analysis.estimate import Estimate
from osel_sim.reporting.charts import HEIGHT, SHOWN, WIDTH, Look, Panel, numbers, panel, unfolded
from osel_sim.reporting.palette import LIGHT

_APART = 8.0
"""Pixels by which dots that coincide are drawn from their common place."""


@dataclass(frozen=True)
class Dot:
    """One dot, with its intervals where they are known.

    Attributes:
        about: what to say of it besides its name.
    """

    name: str
    x: Estimate
    y: Estimate
    about: str = ""


@dataclass(frozen=True)
class Path:
    """Dots joined by a line, in their order.

    Attributes:
        x, y: (n,); NaN leaves a gap.
        about: (n,) what to say of each.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    about: Sequence[str]


def certain(value: float) -> Estimate:
    """A number of which no interval is known."""
    return Estimate(value, np.nan, np.nan)


def scatter(title: str, dots: Sequence[Dot], look: Look, axes: tuple[str, str], paths: Sequence[Path] = ()) -> Panel:
    """Dots with intervals in both directions, and paths. Dots that coincide stand side by side around their place; their intervals stay there.

    Args:
        axes: titles of the two axes, with their units.
    """
    loose = alt.Scale(zero=False)
    x = alt.X("x:Q", title=axes[0], scale=loose, axis=alt.Axis(tickCount=8))
    y = alt.Y("y:Q", title=axes[1], scale=loose, axis=alt.Axis(tickCount=6))
    about = [
        alt.Tooltip("name:N", title="title"),
        alt.Tooltip("about:N", title="at"),
        alt.Tooltip("tx:N", title=axes[0]),
        alt.Tooltip("ty:N", title=axes[1]),
    ]
    layers = []
    if paths:
        base = unfolded(*(_path(path) for path in paths))
        layers.append(base.mark_line(strokeWidth=1.8).encode(x=x, y=y, order="order:Q", color=look.color(), strokeDash=look.dash()))
        layers.append(base.mark_point(filled=True, size=16, opacity=1).encode(x=x, y=y, color=look.color(), tooltip=about))
    moved = apart(np.array([dot.x.value for dot in dots]), np.array([dot.y.value for dot in dots]))
    places = [_dot(dot, *offset) for dot, offset in zip(dots, moved.tolist(), strict=True)]
    base = alt.Chart(alt.InlineData(values=places)).transform_filter(SHOWN)
    rule = base.mark_rule(opacity=0.5).encode(color=look.color(symbol=""))
    if any(np.isfinite(dot.x.low) for dot in dots):
        layers.append(rule.encode(x=alt.X("x0:Q", title=axes[0], axis=alt.Axis(tickCount=8)), x2="x1:Q", y=y))
    if any(np.isfinite(dot.y.low) for dot in dots):
        layers.append(rule.encode(x=x, y=alt.Y("y0:Q", title=axes[1], axis=alt.Axis(tickCount=6)), y2="y1:Q"))
    point = base.mark_point(
        filled=True, size=140, opacity=1, stroke=LIGHT["surface"], strokeWidth=1, xOffset=alt.expr("datum.dx"), yOffset=alt.expr("datum.dy")
    )
    layers.append(point.encode(x=x, y=y, color=look.color(symbol=""), shape=look.shape(), tooltip=about))
    return panel(title, HEIGHT, *layers)


def rows(title: str, groups: Sequence[str], found: Mapping[str, Mapping[str, Estimate]], look: Look, x_title: str, percent: bool = False) -> Panel:
    """A row for each group, in it a dot with its interval for each name, one below the other.

    Args:
        groups: from top to bottom.
        found: name -> group -> estimate; what is missing is not drawn.
        percent: the estimates are shares in [0, 1].
    """
    base = unfolded(*(_row(name, own, percent) for name, own in found.items()))
    y = alt.Y(
        "group:N", title=None, scale=alt.Scale(domain=list(groups)), sort=None, axis=alt.Axis(ticks=False, domain=False, grid=False, labelPadding=6)
    )
    offset = alt.YOffset("name:N", scale=alt.Scale(domain=look.names, paddingOuter=0.6), sort=None)
    x_axis = alt.Axis(orient="top", tickCount=6, format="%" if percent else alt.Undefined)
    where = {"y": y, "yOffset": offset}
    heading = None if x_title == title else x_title
    x = alt.X("value:Q", title=heading, axis=x_axis, scale=alt.Scale(domain=[0, 1]) if percent else alt.Scale(zero=False))
    rule = base.mark_rule(strokeWidth=1.6, opacity=0.6).encode(
        x=alt.X("low:Q", title=heading, axis=x_axis), x2="high:Q", color=look.color(symbol=""), **where
    )
    told = [alt.Tooltip("group:N", title="title"), alt.Tooltip("name:N", title="of"), alt.Tooltip("about:N", title=x_title)]
    point = base.mark_point(filled=True, size=55, opacity=1).encode(x=x, color=look.color(symbol=""), shape=look.shape(), tooltip=told, **where)
    lines = alt.Chart(alt.InlineData(values=[{"group": group} for group in groups])).mark_rule(color=LIGHT["grid"]).encode(y=y)
    known = any(np.isfinite(estimate.low) for own in found.values() for estimate in own.values())
    layers = [lines, rule, point] if known else [lines, point]
    return panel(title, len(groups) * min(64, max(20, 8 * len(look.names) + 4)), *layers)


def clouds(places: NDArray[np.float64], told: tuple[Sequence[str], Sequence[int]], aspects: Mapping[str, tuple[Sequence[str], Look]]) -> list[Panel]:
    """Many dots whose places mean nothing but their distances: the same dots in each panel, coloured by another aspect.

    Args:
        places: (n, 2).
        told: what each is about, (n,), and the instance it stands for, (n,): a click on it in the page shows its episodes.
        aspects: title of a panel -> the name (n,) that each dot is drawn as, and the look of these names.
    """
    x, y = _strewn(places).T
    record = {"x": numbers(x), "y": numbers(y), "about": list(told[0]), "instance": list(told[1])}
    for number, (labels, _) in enumerate(aspects.values()):
        known = tuple(dict.fromkeys(labels))  # each label once, as what is no column
        record |= {f"labels{number}": known, f"n{number}": [known.index(label) for label in labels]}
    bare = alt.Axis(labels=False, ticks=False, grid=False, domain=False, title=None)
    panels: list[Panel] = []
    for number, (title, (_, look)) in enumerate(aspects.items()):
        base = unfolded(record).transform_calculate(name=f"datum.labels{number}[datum.n{number}]").transform_filter(SHOWN)
        point = base.mark_point(filled=True, size=22, opacity=0.8).encode(
            x=alt.X("x:Q", axis=bare, scale=alt.Scale(zero=False)),
            y=alt.Y("y:Q", axis=bare, scale=alt.Scale(zero=False)),
            color=look.color(symbol=""),
            shape=look.shape(),
            tooltip=[alt.Tooltip("about:N", title="title"), alt.Tooltip("name:N", title=title)],
        )
        panels.append(panel(title, HEIGHT, point))
    return panels


def apart(x: NDArray[np.float64], y: NDArray[np.float64], width: float = WIDTH, height: float = HEIGHT) -> NDArray[np.float64]:
    """By how many pixels, (n, 2), to move each dot so that those which coincide can be told apart: around their common place, in their order.

    Args:
        x, y: (n,) places of the dots.
        width, height: pixels over which they spread.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial.distance import cdist

    offsets = np.zeros((len(x), 2))
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(known) < 2:
        return offsets
    pixels = np.stack([_unit(x[known]) * width, _unit(y[known]) * height], axis=1)
    count, group = connected_components(cdist(pixels, pixels) < _APART)
    for number in range(count):
        members = known[group == number]
        if len(members) > 1:
            angles = np.pi + 2.0 * np.pi * np.arange(len(members)) / len(members)
            radius = max(_APART, 1.2 * _APART * len(members) / np.pi)
            offsets[members] = (radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)).round(2)
    return offsets


def _strewn(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) of which those that are the same are strewn around it like the seeds of a sunflower."""
    size = float(np.ptp(places, axis=0).max()) or 1.0
    _, group, count = np.unique((places / (1e-3 * size)).round(), axis=0, return_inverse=True, return_counts=True)
    moved, group = places.astype(np.float64), group.ravel()
    for number in np.flatnonzero(count > 1):
        members = np.flatnonzero(group == number)
        order = np.arange(len(members))
        angles, radius = order * np.pi * (3.0 - np.sqrt(5.0)), 0.008 * size * np.sqrt(order)
        moved[members] += (radius * np.stack([np.cos(angles), np.sin(angles)])).T
    return moved


def _unit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    span = float(np.ptp(values))
    return (values - values.min()) / span if span > 0.0 else np.zeros_like(values)


def _dot(dot: Dot, dx: float, dy: float) -> dict[str, Any]:
    x, x0, x1, y, y0, y1 = numbers([dot.x.value, dot.x.low, dot.x.high, dot.y.value, dot.y.low, dot.y.high])
    place = {"x": x, "x0": x0, "x1": x1, "y": y, "y0": y0, "y1": y1, "dx": dx, "dy": dy}
    return {"name": dot.name, **place, "about": dot.about or "–", "tx": _words(dot.x), "ty": _words(dot.y)}


def _path(path: Path) -> dict[str, Any]:
    x, y = numbers(path.x), numbers(path.y)
    words = {"tx": [_text(value) for value in x], "ty": [_text(value) for value in y], "about": list(path.about)}
    return {"name": path.name, "x": x, "y": y, "order": list(range(len(x))), **words}


def _row(name: str, own: Mapping[str, Estimate], percent: bool) -> dict[str, Any]:
    values, low, high = (numbers([getattr(estimate, end) for estimate in own.values()]) for end in ("value", "low", "high"))
    return {
        "name": name,
        "group": list(own),
        "value": values,
        "low": low,
        "high": high,
        "about": [_words(estimate, percent) for estimate in own.values()],
    }


def _words(estimate: Estimate, percent: bool = False) -> str:
    value = _text(estimate.value, percent)
    return f"{value} [{_text(estimate.low, percent)}, {_text(estimate.high, percent)}]" if np.isfinite(estimate.low) else value


def _text(value: float | None, percent: bool = False) -> str:
    if value is None or not np.isfinite(value):
        return "–"
    return f"{100 * value:.0f}%" if percent else f"{value:.3g}"
