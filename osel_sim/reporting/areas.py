"""Panels of areas: cells by row and column, shares of a whole, regions of a plane."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import altair as alt
import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.analysis.log import Array
from osel_sim.reporting.charts import HEIGHT, WIDTH, Look, Panel, numbers, panel, unfolded
from osel_sim.reporting.palette import LIGHT

DARKEST = 0.36
"""Opacity of a cell's colour at most: the number in it is read on it, light and dark."""

_ROW = 24
"""Pixels of a row of cells."""

_LEVELS = 12
_CELL = 4
"""Pixels of the height of a cell of a map: whole, so that no seam is seen between two."""


@dataclass(frozen=True)
class Cell:
    """One cell of a heatmap.

    Attributes:
        shade: from 0 to 1.
        text: what is written in it.
        about: what to say of it.
    """

    row: str
    column: str
    shade: float
    text: str
    about: str


def heatmap(title: str, cells: Sequence[Cell], look: Look) -> Panel:
    """Cells in rows and columns, in the order they come. Each column has the colour that `look` gives its name."""
    rows, names = (list(dict.fromkeys(getattr(cell, side) for cell in cells)) for side in ("row", "column"))
    level = 6.2 * max(map(len, names)) < 0.74 * WIDTH / len(names)  # the page does the same for its own width
    records = [
        {"row": cell.row, "name": cell.column, "shade": round(DARKEST * min(max(cell.shade, 0.0), 1.0), 3), "text": cell.text, "about": cell.about}
        for cell in cells
    ]
    base = alt.Chart(alt.InlineData(values=records))
    x_axis = alt.Axis(orient="top", title=None, ticks=False, domain=False, labelAngle=0 if level else -35, labelColor=LIGHT["ink"], labelLimit=150)
    x = alt.X("name:N", sort=None, scale=alt.Scale(domain=names), axis=x_axis)
    y_axis = alt.Axis(title=None, ticks=False, domain=False, labelColor=LIGHT["ink"], labelPadding=6)
    y = alt.Y("row:N", sort=None, scale=alt.Scale(domain=rows), axis=y_axis)
    told = [alt.Tooltip("row:N", title="title"), alt.Tooltip("name:N", title="policy"), alt.Tooltip("about:N", title=title)]
    shade = alt.Opacity("shade:Q", scale=None)
    frame = base.mark_rect(fill=LIGHT["raised"], stroke=LIGHT["surface"], strokeWidth=2).encode(x=x, y=y)
    fill = base.mark_rect(stroke=None).encode(x=x, y=y, color=look.color(legend=False), opacity=shade, tooltip=told)
    text = base.mark_text(fontSize=12, color=LIGHT["ink"]).encode(x=x, y=y, text="text:N", tooltip=told)
    return panel(title, _ROW * len(rows), frame, fill, text)


def shares(title: str, groups: Sequence[str], parts: Mapping[str, ArrayLike], look: Look, x_title: str) -> Panel:
    """A bar for each group, made of its parts.

    Args:
        parts: name -> percent (groups,), in the order they are stacked.
    """
    records = [{"name": name, "order": order, "group": list(groups), "value": numbers(values)} for order, (name, values) in enumerate(parts.items())]
    base = unfolded(*records)
    y = alt.Y("group:N", title=None, sort=None, scale=alt.Scale(domain=list(groups)), axis=alt.Axis(ticks=False, domain=False, labelPadding=6))
    x = alt.X("value:Q", title=x_title, stack="zero", scale=alt.Scale(domain=[0, 100]), axis=alt.Axis(orient="top"))
    told = [alt.Tooltip("group:N", title="title"), alt.Tooltip("name:N", title="of"), alt.Tooltip("value:Q", title=x_title, format=".1f")]
    bars = base.mark_bar(stroke=LIGHT["surface"]).encode(x=x, y=y, color=look.color(symbol="square"), order="order:Q", tooltip=told)
    return panel(title, _ROW * len(groups), bars)


def stacked(title: str, x: ArrayLike, parts: Mapping[str, ArrayLike], look: Look, axes: tuple[str, str]) -> Panel:
    """Parts of a whole over a common axis, on top of one another.

    Args:
        x: (n,).
        parts: name -> (n,).
    """
    base = unfolded(*({"name": name, "x": numbers(x), "y": numbers(values)} for name, values in parts.items()))
    places = np.asarray(x, np.float64)
    scale = alt.Scale(domain=[float(places.min()), float(places.max())], nice=False, zero=False)
    area = base.mark_area(opacity=0.75, line=False).encode(
        x=alt.X("x:Q", title=axes[0], scale=scale, axis=alt.Axis(grid=False, tickCount=8, format=",d", tickMinStep=1)),
        y=alt.Y("y:Q", title=axes[1], stack="zero", scale=alt.Scale(domain=[0, 100])),
        color=look.color(symbol="square"),
    )
    return panel(title, HEIGHT, area)


def regions(
    title: str, axes: tuple[str, str], xs: Array, ys: Array, z: Array, most: float, legend: str, marked: Mapping[str, tuple[float, float]]
) -> Panel:
    """A value over a plane with logarithmic axes, in ink: the more the darker. Neighbouring cells of one level are one rectangle.

    Args:
        axes: titles of the two axes.
        xs: (X,); ys: (Y,), both rising by a constant factor.
        z: (Y, X), from 0 up.
        most: from this value on all is equally dark.
        legend: what the value is, with its unit.
        marked: places to name; the first is the one at hand.
    """
    step = most / _LEVELS
    level = np.clip(np.round(z / step), 0, _LEVELS).astype(np.int64)
    x_edges, y_edges = _edges(xs), _edges(ys)
    record: dict[str, list[Any]] = {key: [] for key in ("x", "x2", "y", "y2", "value")}
    for row, own in enumerate(level):
        starts = [0, *(np.flatnonzero(np.diff(own)) + 1).tolist(), len(own)]
        for start, end in pairwise(starts):
            for key, value in zip(record, (x_edges[start], x_edges[end], y_edges[row], y_edges[row + 1], own[start] * step), strict=True):
                record[key].append(numbers([value])[0])
    logs: list[dict[str, Any]] = [
        {
            "scale": alt.Scale(type="log", domain=[float(edges[0]), float(edges[-1])], nice=False),
            "axis": alt.Axis(grid=False, tickCount=4, format="~g"),
        }
        for edges in (x_edges, y_edges)
    ]
    x, y = alt.X("x:Q", title=axes[0], **logs[0]), alt.Y("y:Q", title=axes[1], **logs[1])
    shade = alt.Opacity(
        "value:Q", scale=alt.Scale(domain=[0, most], range=[0, 0.75]), legend=alt.Legend(title=legend, symbolType="square", values=_ticks(most))
    )
    told = [
        alt.Tooltip("value:Q", title=legend, format=".3g"),
        alt.Tooltip("x:Q", title=axes[0], format=".2g"),
        alt.Tooltip("y:Q", title=axes[1], format=".2g"),
    ]
    area = unfolded(record).mark_rect(color=LIGHT["ink"]).encode(x=x, x2="x2:Q", y=y, y2="y2:Q", opacity=shade, tooltip=told)
    return panel(title, _CELL * len(ys), area, *_named(marked, x, y))


def _named(marked: Mapping[str, tuple[float, float]], x: alt.X, y: alt.Y) -> list[alt.Chart]:
    """Places on a map with their names, which have a rim so that they can be read on any shade."""
    order = sorted(marked, key=lambda name: marked[name])
    records = [
        {"name": name, "x": marked[name][0], "y": marked[name][1], "here": number == 0, "dy": -12 if order.index(name) % 2 == 0 else 14}
        for number, name in enumerate(marked)
    ]
    base = alt.Chart(alt.InlineData(values=records))
    shape = alt.Shape("here:N", scale=alt.Scale(domain=[True, False], range=["diamond", "circle"]), legend=None)
    point = base.mark_point(filled=True, size=90, opacity=1, color=LIGHT["ink"], stroke=LIGHT["surface"], strokeWidth=1.5)
    rim, name = (
        base.mark_text(fontSize=11, dy=alt.expr("datum.dy"), **look)
        for look in ({"stroke": LIGHT["surface"], "strokeWidth": 3}, {"color": LIGHT["ink"]})
    )
    return [point.encode(x=x, y=y, shape=shape), rim.encode(x=x, y=y, text="name:N"), name.encode(x=x, y=y, text="name:N")]


def _edges(values: Array) -> NDArray[np.float64]:
    """Borders, (n + 1,), of cells around values (n,) that rise by a constant factor."""
    factor = np.sqrt(values[1] / values[0])
    return np.asarray(np.concatenate([values / factor, values[-1:] * factor]), np.float64)


def _ticks(most: float) -> list[float]:
    return [float(f"{part * most:.2g}") for part in (0.0, 0.25, 0.5, 0.75, 1.0)]
