"""Panels of lines over a common axis: learning curves, regret, shares, distributions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import altair as alt
import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.reporting.charts import HEIGHT, Look, Panel, numbers, panel, unfolded
from osel_sim.reporting.palette import LIGHT

_HOVERED = 24
"""Places along the axis at which the page tells the values of all lines."""

_TOLD = 16
"""Lines that it tells of."""


@dataclass(frozen=True)
class Line:
    """A curve, with a band where `low` and `high` are given.

    Attributes:
        y, low, high: (n,) each; NaN leaves a gap.
    """

    name: str
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None


def curves(
    title: str,
    x: ArrayLike,
    lines: Sequence[Line],
    look: Look,
    axes: tuple[str, str],
    y_domain: tuple[float, float] | None = None,
    steps: bool = False,
    marks: Sequence[float] = (),
) -> Panel:
    """Lines with their bands; pointing at a place tells the values there.

    Args:
        x: (n,), common to all lines.
        axes: titles of the two axes, with their units.
        y_domain: limits of the y axis, beyond which lines are cut off; of what is there where None.
        steps: each value holds up to the next x.
        marks: where thin upright lines stand.
    """
    places = np.asarray(x, np.float64)
    base = unfolded(*(_record(places, line) for line in lines))
    ends = [float(places.min()), float(places.max())]
    y_scale = alt.Scale(domain=list(y_domain), nice=False) if y_domain else alt.Scale(zero=steps)
    counted: dict[str, Any] = {"format": ",d", "tickMinStep": 1} if (places == places.round()).all() else {}
    x_axis = alt.X("x:Q", title=axes[0], scale=alt.Scale(domain=ends, nice=False, zero=False), axis=alt.Axis(grid=False, tickCount=8, **counted))
    y_axis = alt.Y("y:Q", title=axes[1], scale=y_scale, axis=alt.Axis(tickCount=6))
    interpolate: Any = "step-after" if steps else "linear"
    clip = _goes_beyond(lines, y_domain)
    layers: list[alt.Chart] = []
    if marks:
        upright = unfolded({"x": numbers(marks)}).mark_rule(stroke=LIGHT["muted"], strokeDash=[2, 3], strokeWidth=1)
        layers.append(upright.encode(x=x_axis))
    if any(line.low is not None for line in lines):
        band = base.mark_area(fillOpacity=0.16, clip=clip, interpolate=interpolate)
        layers.append(
            band.encode(x=x_axis, y=alt.Y("low:Q", title=axes[1], scale=y_scale, axis=alt.Axis(tickCount=6)), y2="high:Q", color=look.color())
        )
    layers.append(
        base.mark_line(strokeWidth=2, clip=clip, interpolate=interpolate).encode(x=x_axis, y=y_axis, color=look.color(), strokeDash=look.dash())
    )
    layers.append(_told(places, [line for line in lines if line.name not in look.hidden], axes[0]))
    return panel(title, HEIGHT, *layers)


def thinned(length: int, most: int = 100) -> NDArray[np.int64]:
    """Which points of a long curve to draw: all of the first, then ever sparser, the last included.

    Args:
        length: how many there are.
        most: how many to keep.
    """
    if length <= most:
        return np.arange(length)
    even = np.linspace(0, length - 1, most * 2 // 3)
    early = np.geomspace(1, length, most - most * 2 // 3) - 1
    return np.unique(np.concatenate([even, early]).round().astype(np.int64))


def settled_domain(x: ArrayLike, lines: Sequence[Line]) -> tuple[float, float] | None:
    """Limits of the y axis that show these lines, and their bands, after the first few x, in which luck rules."""
    places = np.asarray(x, np.float64)
    settled = places >= min(30.0, 0.3 * float(places.max()))
    values = [np.asarray(part, np.float64)[settled] for line in lines for part in (line.y, line.low, line.high) if part is not None]
    known = np.concatenate([part[np.isfinite(part)] for part in values]) if values else np.zeros(0)
    if not known.size:
        return None
    margin = 0.06 * max(float(known.max() - known.min()), 1e-6)
    return float(known.min()) - margin, float(known.max()) + margin


def _goes_beyond(lines: Sequence[Line], y_domain: tuple[float, float] | None) -> bool:
    """Whether some line or band leaves the panel. Cutting them off takes most of the time that a picture takes to make."""
    if y_domain is None:
        return False
    parts = [np.asarray(part, np.float64) for line in lines for part in (line.y, line.low, line.high) if part is not None]
    return any(bool(((part < y_domain[0]) | (part > y_domain[1])).any()) for part in parts)


def _record(x: NDArray[np.float64], line: Line) -> dict[str, Any]:
    record: dict[str, Any] = {"name": line.name, "x": numbers(x), "y": numbers(line.y)}
    none: list[float | None] = [None] * len(x)
    low, high = line.low, line.high
    return record | {"low": none if low is None else numbers(low, 3), "high": none if high is None else numbers(high, 3)}


def _told(x: NDArray[np.float64], lines: Sequence[Line], x_title: str) -> alt.Chart:
    """Unseen stripes over the panel, each of which tells what the lines come to there, the highest at the end first."""
    at = np.unique(np.linspace(0, len(x) - 1, min(_HOVERED, len(x))).round().astype(np.int64))
    places = x[at]
    edges = np.concatenate([places[:1], (places[1:] + places[:-1]) / 2, places[-1:]])
    last = {line.name: float(np.nan_to_num(np.asarray(line.y, np.float64)[-1], nan=-np.inf)) for line in lines}
    told = sorted(lines, key=lambda line: -last[line.name])[:_TOLD]
    record: dict[str, Any] = {"x": numbers(places), "from": edges[:-1].tolist(), "to": edges[1:].tolist()}
    record |= {f"s{number}": [_words(line, int(place)) for place in at] for number, line in enumerate(told)}
    tooltips = [alt.Tooltip("x:Q", title=x_title), *(alt.Tooltip(f"s{number}:N", title=line.name) for number, line in enumerate(told))]
    stripes = unfolded(record).mark_rect(fill=LIGHT["ink"], fillOpacity=0)
    told_of: alt.Chart = stripes.encode(x=alt.X("from:Q", title=x_title, scale=alt.Scale(nice=False, zero=False)), x2="to:Q", tooltip=tooltips)
    return told_of


def _words(line: Line, place: int) -> str:
    value, low, high = (None if part is None else float(np.asarray(part, np.float64)[place]) for part in (line.y, line.low, line.high))
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.3g}" + (f" [{low:.3g}, {high:.3g}]" if low is not None and high is not None and np.isfinite(low) else "")
