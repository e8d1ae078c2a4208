"""A figure: Altair charts side by side, with the words about them. Page, PNG, SVG and notebook all show the same Vega-Lite specification."""

import base64
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

import altair as alt
import numpy as np
from numpy.typing import ArrayLike

from osel_sim.core.errors import UsageError
from osel_sim.core.files import write_bytes
from osel_sim.core.shown import all_shown
from osel_sim.reporting.palette import LIGHT

WIDTH, WIDE, HEIGHT = 440, 760, 260
"""Pixels of a panel in an image: its width among others, its width alone, its height. The page fits the width to its column."""

COLUMNS = 2
_LETTER = 6.2
_SCALE = 2.0

SHOWN = "indexof(hidden, datum.name) < 0"
"""Filter of every mark that a name in the legend hides and shows. `hidden` is a parameter of the figure: the names that are not drawn."""

_INK, _MUTED, _GRID = LIGHT["ink"], LIGHT["muted"], LIGHT["grid"]

CONFIG: dict[str, Any] = {
    "background": LIGHT["surface"],
    "font": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif",
    "aria": False,  # the figure as a whole has an alternative text; one for each of a thousand dots helps nobody
    "axis": {
        **{"labelColor": _MUTED, "titleColor": _INK, "gridColor": _GRID, "domainColor": _GRID, "tickColor": _GRID},
        **{"labelFontSize": 11, "titleFontSize": 12, "titleFontWeight": "normal", "labelLimit": 240, "titlePadding": 8},
    },
    "title": {"color": _INK, "anchor": "start", "fontSize": 13, "fontWeight": 600, "offset": 8, "frame": "group"},
    "legend": {
        **{"labelColor": _INK, "titleColor": _INK, "labelFontSize": 11, "titleFontSize": 11, "titleFontWeight": "normal"},
        **{"labelLimit": 300, "titleLimit": 400, "symbolLimit": 0, "orient": "bottom", "columnPadding": 14},
    },
}
"""Look of every figure, in the colours of the light theme."""

Panel = alt.LayerChart


@dataclass(frozen=True)
class Look:
    """How the names of a figure are drawn; a policy and a selector have the same look in every figure.

    Attributes:
        colour: of each name, as the palette calls it. In this order they stand in the legend.
        dashed: names whose lines are dashed.
        shapes: of names whose dots are no circles.
        hidden: names that are not drawn before they are asked for.
    """

    colour: Mapping[str, str]
    dashed: Collection[str] = ()
    shapes: Mapping[str, str] = field(default_factory=dict)
    hidden: Collection[str] = ()

    @property
    def names(self) -> list[str]:
        """All names, in the order of the legend."""
        return list(self.colour)

    @property
    def shown(self) -> list[str]:
        """The names that are drawn."""
        return [name for name in self.colour if name not in self.hidden]

    def only(self, names: Collection[str]) -> "Look":
        """The look of some of the names."""
        return Look({name: colour for name, colour in self.colour.items() if name in names}, self.dashed, self.shapes, self.hidden)

    def color(self, legend: bool = True, symbol: str = "stroke") -> alt.Color:
        """Encoding of `name` as colour."""
        scale = alt.Scale(domain=self.names, range=[LIGHT[colour] for colour in self.colour.values()])
        return alt.Color("name:N", scale=scale, legend=self.legend(symbol) if legend else None)

    def dash(self, legend: bool = True) -> alt.StrokeDash:
        """Encoding of `name` as dashes."""
        scale = alt.Scale(domain=self.names, range=[[5, 3] if name in self.dashed else [1, 0] for name in self.names])
        return alt.StrokeDash("name:N", scale=scale, legend=self.legend("stroke") if legend else None)

    def shape(self) -> alt.Shape:
        """Encoding of `name` as the shape of dots."""
        scale = alt.Scale(domain=self.names, range=[self.shapes.get(name, "circle") for name in self.names])
        return alt.Shape("name:N", scale=scale, legend=self.legend(""))

    def legend(self, symbol: str) -> alt.Legend | None:
        """A legend of what is drawn; None for a single name. The page draws one of its own from the same scale, which hides and shows."""
        if len(self.names) < 2:
            return None
        longest = min(max(map(len, self.shown), default=1), 48)
        columns = max(1, min(len(self.shown), int(WIDE / (longest * _LETTER + 40))))
        look: dict[str, Any] = {"symbolType": symbol} if symbol else {}
        if symbol == "stroke":
            look |= {"symbolStrokeWidth": 2.5, "symbolSize": 220}
        return alt.Legend(values=self.shown, title=None, columns=columns, symbolOpacity=1, **look)


@dataclass(frozen=True)
class Figure:
    """One figure: panels side by side where there is room for them, below one another on a phone.

    Attributes:
        name: of its files.
        caption: what it shows and what to look for.
        alternative: what one would see in it, with its main numbers, for those who cannot.
        panels: charts that the page fits to its column; none has a width yet.
        hidden: names that are not drawn before they are asked for.
        one_legend: the panels share one; else each has its own.
    """

    name: str
    title: str
    caption: str
    alternative: str
    panels: Sequence[Panel]
    hidden: Collection[str] = ()
    one_legend: bool = True

    @cached_property
    def chart(self) -> alt.ConcatChart:
        """All of it as one Altair chart."""
        width = WIDTH if len(self.panels) > 1 else WIDE
        legend: Literal["shared", "independent"] = "shared" if self.one_legend else "independent"
        # All at once: each method of a chart would copy it with its data.
        return alt.concat(
            *self.panels,
            columns=COLUMNS,
            spacing=28,
            title=alt.Title(self.title, fontSize=15, offset=14),
            resolve=alt.Resolve(scale=alt.ScaleResolveMap(color=legend, shape=legend, strokeDash=legend, opacity="independent")),
            params=[alt.param(name="hidden", value=sorted(self.hidden)).param],
            config=alt.Config(**{**CONFIG, "view": {"stroke": None, "continuousWidth": width, "discreteWidth": width}}),
        )

    @cached_property
    def spec(self) -> dict[str, Any]:
        """The chart as Vega-Lite's JSON, its texts as they may be shown. The page embeds it, and the images are made from it."""
        return dict(all_shown(self.chart.to_dict(validate=False)))  # the tests validate; it takes longer than all the rest

    def save(self, file: Path | str) -> Path:
        """Write it as `.png`, `.svg` or `.json` (Vega-Lite), by the file's ending; folders are made.

        Raises:
            UsageError: another ending.
        """
        path = Path(file)
        kind = path.suffix.removeprefix(".")
        if kind not in ("png", "svg", "json"):
            raise UsageError(f"{path}: a figure is saved as .png, .svg or .json")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, json.dumps(self.spec).encode() if kind == "json" else to_images(self)[kind])
        return path

    def _repr_mimebundle_(self, *_: Any, **__: Any) -> dict[str, Any]:
        """Shows itself in a notebook: drawn there where it can draw Vega-Lite, else as a picture. Nothing is fetched."""
        picture = base64.b64encode(to_images(self)["png"]).decode()
        return {"application/vnd.vegalite.v6+json": self.spec, "image/png": picture, "text/plain": f"{self.title}: {self.alternative}"}


def to_images(figure: Figure) -> dict[str, bytes]:
    """Its PNG and SVG, by the file's ending; the same figure is the same bytes."""
    import vl_convert

    # Nothing in a specification names an address; none could be reached.
    svg = _clipped_once(_renumbered(vl_convert.vegalite_to_svg(figure.spec, allowed_base_urls=[])))
    return {"svg": svg.encode(), "png": vl_convert.svg_to_png(svg, scale=_SCALE)}


def _renumbered(svg: str) -> str:
    """Clip paths numbered from 0: Vega goes on counting from one picture to the next, and the same picture would not be the same bytes."""
    numbers: dict[str, str] = {}
    return re.sub(r'(id="|="url\(#)(clip\d+)', lambda found: found[1] + numbers.setdefault(found[2], f"clip{len(numbers)}"), svg)


def _clipped_once(svg: str) -> str:
    """Lines of one layer cut off together, not each by itself: each cut takes a picture of its own, which is most of the time that a PNG takes."""
    for layer in dict.fromkeys(re.findall(r'"mark-group role-scope (\w+)_pathgroup"', svg)):
        if clips := re.findall(rf'{layer}_marks" (clip-path="[^"]+")', svg):  # all of them the panel's rectangle
            svg = re.sub(rf'({layer}_marks") clip-path="[^"]+"', r"\1", svg)
            svg = svg.replace(f'{layer}_pathgroup"', f'{layer}_pathgroup" {clips[0]}')
    return svg


def numbers(values: ArrayLike, digits: int = 4) -> list[float | None]:
    """Numbers for JSON, which has no NaN, rounded to what can be seen."""
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in np.asarray(values, np.float64).ravel().tolist()]


def unfolded(*records: Mapping[str, Any]) -> alt.Chart:
    """A chart of data of which each record holds whole columns: a fraction of the bytes of a record for each row. Marks are put on it.

    Args:
        records: all of the same keys. A list is a column; anything else, a tuple too, is the same in all rows of its record, `name` what the legend
            hides it by.
    """
    wide: list[str | alt.FieldName] = [key for key, value in records[0].items() if isinstance(value, list)]
    base = alt.Chart(alt.InlineData(values=tuple(map(dict, records))))  # a list would be copied with its numbers, again and again
    # Names that have a column of their own come with it: they are hidden after it is unfolded.
    shown = base.transform_filter(SHOWN) if "name" in records[0] and "name" not in wide else base
    return shown.transform_flatten(wide)


def panel(title: str, height: int, *layers: alt.Chart) -> Panel:
    """Layers on one pair of axes, the first at the bottom.

    Args:
        height: in pixels, without axes.
    """
    return cast(alt.LayerChart, alt.layer(*layers, title=alt.Title(title)).properties(height=height))


def listed(parts: Sequence[str], most: int = 8) -> str:
    """`a, b and 3 more`, for alternative texts."""
    return ", ".join(parts[:most]) + (f" and {len(parts) - most} more" if len(parts) > most else "")
