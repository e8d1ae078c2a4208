"""What a figure or a table shows, said once: plotly draws it in the page, matplotlib as PNG and SVG, and a table becomes HTML and CSV.

Colours are names, so that the page can show them light and dark: `ink`, `muted`, `good`, `bad` and the categories `c0` to `c17`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.analysis.estimate import Estimate
from osel_sim.core.errors import UsageError

Floats = NDArray[np.float64]

LIGHT = {
    **{"ink": "#1c2430", "muted": "#7b8794", "grid": "#e3e7ec", "surface": "#ffffff", "good": "#1f8a55", "bad": "#c8384b"},
    **{"c0": "#2f6db3", "c1": "#d1495b", "c2": "#2a8f5b", "c3": "#c98a00", "c4": "#7b52ab", "c5": "#1795a8"},
    **{"c6": "#d86fb1", "c7": "#7d6b4f", "c8": "#5b7f1e", "c9": "#e0702b", "c10": "#4b5bd6", "c11": "#00796b"},
    **{"c12": "#871e00", "c13": "#87004b", "c14": "#3c4b2d", "c15": "#1ea5ff", "c16": "#a5a500", "c17": "#2db400"},
}
DARK = {
    **{"ink": "#e8ecf1", "muted": "#8d99a6", "grid": "#2d343d", "surface": "#171b21", "good": "#5fcf95", "bad": "#ff7b8a"},
    **{"c0": "#6ea8ef", "c1": "#ff7b8a", "c2": "#5fcf95", "c3": "#f0b93e", "c4": "#b48cf0", "c5": "#4fd0e0"},
    **{"c6": "#f5a3d0", "c7": "#c8b08a", "c8": "#a9cf5a", "c9": "#ff9d5c", "c10": "#93a0ff", "c11": "#4db6a5"},
    **{"c12": "#ff4b2d", "c13": "#ff1ec3", "c14": "#879669", "c15": "#ffd2c3", "c16": "#b48778", "c17": "#00a500"},
}
CATEGORIES = sum(name[0] == "c" and name[1:].isdigit() for name in LIGHT)


MOST_ROW_LETTERS = 44
"""Of the name of a row or a category beside a figure."""


def colours(names: Sequence[str]) -> dict[str, str]:
    """A colour of its own for each name, in their order; they repeat after eighteen."""
    return {name: f"c{index % CATEGORIES}" for index, name in enumerate(names)}


@dataclass(frozen=True)
class Line:
    """A curve, with a band where `low` and `high` are given.

    Attributes:
        x, y, low, high: (n,) each; NaN leaves a gap.
        dots: mark the points on it.
        texts: (n,) what to say of each in the page.
        shown: False: in the page behind a click on the legend, not in the PNG.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    colour: str = "c0"
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    dash: bool = False
    width: float = 2.0
    steps: bool = False
    dots: bool = False
    texts: Sequence[str] | None = None
    shown: bool = True


@dataclass(frozen=True)
class Points:
    """A scatter of points.

    Attributes:
        x, y: (n,).
        texts: (n,) what to say of each in the page.
        x_interval, y_interval: (low, high), (n,) each.
        labelled: write the name beside the (single) point rather than in the legend, so that it can be read on a map.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    colour: str = "c0"
    texts: Sequence[str] | None = None
    x_interval: tuple[ArrayLike, ArrayLike] | None = None
    y_interval: tuple[ArrayLike, ArrayLike] | None = None
    size: float = 8.0
    symbol: Literal["circle", "diamond", "x", "star"] = "circle"
    labelled: bool = False
    shown: bool = True


@dataclass(frozen=True)
class Bars:
    """One bar for each category; several of these stand beside one another, or on one another where the panel is `stacked`.

    Attributes:
        categories: (n,) what each bar is of.
        y, low, high: (n,).
    """

    name: str
    categories: Sequence[str]
    y: ArrayLike
    colour: str = "c0"
    low: ArrayLike | None = None
    high: ArrayLike | None = None


@dataclass(frozen=True)
class Heat:
    """A map: the value at each (x, y).

    Attributes:
        x: (columns,); y: (rows,); z: (rows, columns).
        scale: from two colours over a middle one (`diverging`) or from the surface to one (`sequential`).
        low, high: values at the ends of the scale.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    z: ArrayLike
    scale: Literal["diverging", "sequential"] = "sequential"
    low: float = 0.0
    high: float = 1.0


Mark = Line | Points | Bars | Heat


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        x_label, y_label: with their units.
        bare: no ticks: places mean nothing (t-SNE).
        y_range: limits of the y axis; of what is there where None.
        rows: names in place of the numbers of the y axis, the first on top, at y = 0, 1, ...; the panel is as tall as they need.
    """

    title: str
    x_label: str
    y_label: str
    marks: Sequence[Mark]
    x_log: bool = False
    y_log: bool = False
    y_range: tuple[float, float] | None = None
    bare: bool = False
    stacked: bool = False
    rows: Sequence[str] = ()


@dataclass(frozen=True)
class Figure:
    """One figure: panels side by side where there is room for them, below one another on a phone.

    Attributes:
        name: of its files.
        caption: what it shows and what to look for.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]


Cell = str | int | float | bool | Estimate | None
"""What a table holds; None where there is nothing to say."""


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        key: name in the CSV and in the rows.
        heading: with its unit.
        style: how to write its numbers; `percent` takes a share in [0, 1].
        digits: after the point; None: by the magnitude of the column, as `digits_of`.
    """

    key: str
    heading: str
    style: Literal["text", "number", "percent"] = "number"
    digits: int | None = 2


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        name: of its file.
        rows: a cell for each column's key.
    """

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Cell]]

    def __post_init__(self) -> None:
        keys = {column.key for column in self.columns}
        for row in self.rows:
            if row.keys() != keys:
                raise UsageError(f"table {self.name}: a row has {sorted(row)}, the columns are {sorted(keys)}")
        columns = [column if column.digits is not None else replace(column, digits=digits_of(self._numbers(column.key))) for column in self.columns]
        object.__setattr__(self, "columns", columns)

    def _numbers(self, key: str) -> Iterable[float]:
        for row in self.rows:
            cell = row[key]
            number = cell.value if isinstance(cell, Estimate) else cell
            if isinstance(number, int | float):
                yield number


def digits_of(values: Iterable[float]) -> int:
    """So many digits after the point that the largest of these numbers shows three of its own, and at least one: cents can be 16.9 or 0.0492."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return 1 if largest == 0.0 else min(12, max(1, 2 - math.floor(math.log10(largest))))


def shortened(text: str, most: int) -> str:
    """At most so many letters, with an ellipsis where it is longer."""
    return text if len(text) <= most else text[: most - 1] + "…"


def thinned(length: int, most: int = 400) -> NDArray[np.int64]:
    """Which points of a long curve to draw: all of the first, then ever sparser, the last included.

    Args:
        length: how many there are.
        most: how many to keep.
    """
    if length <= most:
        return np.arange(length)
    even = np.linspace(0, length - 1, most // 2)
    early = np.geomspace(1, length, most - most // 2) - 1
    return np.unique(np.concatenate([even, early]).round().astype(np.int64))
