"""A figure's description as plotly's JSON. Colours stay names (`@c0`, `@c0/0.2`): the page puts in those of the light or dark theme."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from osel_sim.reporting.description import MOST_ROW_LETTERS, Bars, Figure, Heat, Line, Mark, Panel, Points, shortened

_SCALES: dict[str, list[list[float | str]]] = {
    "sequential": [[0.0, "@surface"], [1.0, "@c0"]],
    "diverging": [[0.0, "@c0"], [0.5, "@surface"], [1.0, "@c1"]],
}


_NARROW = 20
"""Letters of the name of a row where there is little room, as on a phone; a touch on a point shows all of it."""


def to_plotly(figure: Figure) -> dict[str, Any]:
    """`{name, panels: [{data, layout, narrow}]}`, plain data for JSON; `narrow`: names of the rows where there is little room."""
    return {
        "name": figure.name,
        "panels": [
            {"data": _traces(panel), "layout": _layout(panel), "narrow": [escaped(shortened(name, _NARROW)) for name in panel.rows]}
            for panel in figure.panels
        ],
    }


def numbers(values: ArrayLike) -> list[float | None]:
    """Numbers for JSON, which has no NaN, rounded to what can be seen."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in np.asarray(values, np.float64).ravel().tolist()]


def escaped(text: str) -> str:
    """Text for plotly, which reads some HTML in it."""
    return html.escape(text, quote=False)


def _traces(panel: Panel) -> list[dict[str, Any]]:
    named: set[str] = set()
    traces: list[dict[str, Any]] = []
    for mark in panel.marks:
        first = mark.name not in named
        named.add(mark.name)
        for trace in _trace(mark):
            trace.setdefault("showlegend", first)
            traces.append(trace)
    return traces


def _trace(mark: Mark) -> list[dict[str, Any]]:
    name = escaped(mark.name)
    match mark:
        case Line():
            return _line(mark, name)
        case Points():
            return [_points(mark, name)]
        case Bars():
            bars = {
                "type": "bar",
                "name": name,
                "x": [escaped(category) for category in mark.categories],
                "y": numbers(mark.y),
                "marker": {"color": f"@{mark.colour}"},
                "hovertemplate": "%{x}: %{y:.3~f}",
            }
            if mark.low is not None and mark.high is not None:
                bars["error_y"] = _errors(mark.y, (mark.low, mark.high))
            return [bars]
        case Heat():
            return [
                {
                    "type": "heatmap",
                    "name": name,
                    "x": numbers(mark.x),
                    "y": numbers(mark.y),
                    "z": [numbers(row) for row in np.asarray(mark.z, np.float64)],
                    "zmin": mark.low,
                    "zmax": mark.high,
                    "colorscale": _SCALES[mark.scale],
                    "colorbar": {
                        "title": {"text": name, "side": "right", "font": {"size": 11}},
                        "thickness": 12,
                        "outlinewidth": 0,
                        "tickcolor": "@muted",
                        "tickfont": {"color": "@ink"},
                    },
                    "hovertemplate": "%{x:.3~g}, %{y:.3~g}: %{z:.3~f}<extra></extra>",
                    "showlegend": False,
                }
            ]


def _line(mark: Line, name: str) -> list[dict[str, Any]]:
    x, visible = numbers(mark.x), True if mark.shown else "legendonly"
    line = {"color": f"@{mark.colour}", "width": mark.width, "dash": "dash" if mark.dash else "solid", "shape": "hv" if mark.steps else "linear"}
    traces: list[dict[str, Any]] = []
    if mark.low is not None and mark.high is not None:
        low, high = numbers(mark.low), numbers(mark.high)
        kept = [place for place in range(len(x)) if low[place] is not None and high[place] is not None]
        traces.append(
            {
                "type": "scatter",
                "name": name,
                "x": [x[place] for place in (*kept, *reversed(kept))],
                "y": [high[place] for place in kept] + [low[place] for place in reversed(kept)],
                "fill": "toself",
                "fillcolor": f"@{mark.colour}/0.16",
                "line": {"width": 0},
                "mode": "lines",
                "hoverinfo": "skip",
                "legendgroup": name,
                "showlegend": False,
                "visible": visible,
            }
        )
    traces.append(
        {
            "type": "scatter",
            "mode": "lines+markers" if mark.dots else "lines",
            "marker": {"size": 4, "color": f"@{mark.colour}"},
            "name": name,
            "x": x,
            "y": numbers(mark.y),
            "line": line,
            "legendgroup": name,
            "visible": visible,
            "hovertemplate": "%{y:.3~f}",
        }
    )
    if mark.texts is not None:
        traces[-1] |= {"hovertext": [escaped(text) for text in mark.texts], "hovertemplate": "%{hovertext}: %{x:.3~f}, %{y:.3~f}"}
    return traces


def _points(mark: Points, name: str) -> dict[str, Any]:
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers+text" if mark.labelled else "markers",
        "name": name,
        "x": numbers(mark.x),
        "y": numbers(mark.y),
        "marker": {
            "color": f"@{mark.colour}",
            "size": mark.size,
            "symbol": mark.symbol,
            "line": {"width": 1.2 if mark.labelled else 0.6 if mark.size > 6 else 0, "color": "@surface"},
        },
        "legendgroup": name,
        "visible": True if mark.shown else "legendonly",
        "hovertemplate": "%{x:.3~f}, %{y:.3~f}",
    }
    if mark.texts is not None:
        trace |= {"hovertext": [escaped(text) for text in mark.texts], "hovertemplate": "%{hovertext}"}
    if mark.labelled:
        trace |= {
            "text": [name] * len(trace["x"]),
            "textposition": "top center",
            "textfont": {"color": "@ink"},
            "showlegend": False,
            "cliponaxis": False,
        }
    if mark.x_interval is not None:
        trace["error_x"] = _errors(mark.x, mark.x_interval) | {"color": f"@{mark.colour}/0.5"}
    if mark.y_interval is not None:
        trace["error_y"] = _errors(mark.y, mark.y_interval) | {"color": f"@{mark.colour}/0.5"}
    return trace


def _errors(values: ArrayLike, interval: tuple[ArrayLike, ArrayLike]) -> dict[str, Any]:
    middle, low, high = (np.asarray(part, np.float64) for part in (values, *interval))
    return {"type": "data", "array": numbers(high - middle), "arrayminus": numbers(middle - low), "thickness": 1.2, "width": 3, "color": "@ink/0.7"}


def _layout(panel: Panel) -> dict[str, Any]:
    axis = {
        "gridcolor": "@grid",
        "linecolor": "@grid",
        "zerolinecolor": "@grid",
        "automargin": True,
        "exponentformat": "power",
        "tickfont": {"color": "@muted"},
    }
    layout: dict[str, Any] = {
        "xaxis": axis | {"title": {"text": escaped(panel.x_label), "font": {"size": 12}, "standoff": 8}, "type": _kind(panel.marks, panel.x_log)},
        "yaxis": axis | {"title": {"text": escaped(panel.y_label), "font": {"size": 12}, "standoff": 8}, "type": "log" if panel.y_log else "linear"},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": "@ink", "size": 12, "family": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif"},
        "margin": {"l": 8, "r": 8, "t": 10, "b": 8},
        "hovermode": "closest",
        "hoverlabel": {"bgcolor": "@surface", "bordercolor": "@muted", "font": {"color": "@ink"}},
        "barmode": "stack" if panel.stacked else "group",
        "bargap": 0.3,
    }
    if any(isinstance(mark, Line) for mark in panel.marks) and not any(isinstance(mark, Points | Heat) for mark in panel.marks):
        layout["hovermode"] = "x unified"
    for name, log in (("xaxis", panel.x_log), ("yaxis", panel.y_log)):
        if log:
            layout[name]["dtick"] = 1  # a label each decade
    if panel.bare:
        for name in ("xaxis", "yaxis"):
            layout[name] |= {"showticklabels": False, "showgrid": False, "zeroline": False}
    if panel.rows:
        names = [escaped(shortened(name, MOST_ROW_LETTERS)) for name in panel.rows]
        rows = {"tickmode": "array", "tickvals": list(range(len(names))), "ticktext": names, "range": [len(names) - 0.5, -0.5], "zeroline": False}
        layout["yaxis"] |= rows | {"tickfont": {"color": "@ink", "size": 11}}
        # On top: that is where one begins to read, and the other end may be out of sight.
        layout["xaxis"] |= {"side": "top", "nticks": 8}
    if panel.y_range is not None:
        low, high = np.log10(panel.y_range) if panel.y_log else panel.y_range
        layout["yaxis"]["range"] = [float(low), float(high)]
    return layout


def _kind(marks: Sequence[Mark], log: bool) -> str:
    if any(isinstance(mark, Bars) for mark in marks):
        return "category"
    return "log" if log else "linear"
