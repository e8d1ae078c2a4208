"""A figure's description as PNG and SVG."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from osel_sim.reporting.description import LIGHT, Bars, Figure, Heat, Line, Panel, Points

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SYMBOLS = {"circle": "o", "diamond": "D", "x": "x", "star": "*"}
_COLUMNS = 2


def to_images(figure: Figure, dpi: int = 130) -> dict[str, bytes]:
    """Its PNG and SVG, by the file's ending; the same description is the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    columns = min(_COLUMNS, len(figure.panels))
    rows = -(-len(figure.panels) // columns)
    canvas = Canvas(figsize=(5.6 * columns + (2.4 if columns == 1 else 0), 4.2 * rows), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots(rows, columns, squeeze=False)
    for place, axis in enumerate(axes.flat):
        if place < len(figure.panels):
            _draw(axis, figure.panels[place])
        else:
            axis.set_axis_off()
    canvas.suptitle(_plain(figure.title), fontsize=12, color=LIGHT["ink"])
    images: dict[str, bytes] = {}
    # Without a date and with ids of its own the SVG depends on nothing but the figure.
    with matplotlib.rc_context({"svg.hashsalt": figure.name}):
        for ending, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
            buffer = io.BytesIO()
            canvas.savefig(buffer, format=ending, dpi=dpi, metadata=metadata)
            images[ending] = buffer.getvalue()
    return images


def _draw(axis: "Axes", panel: Panel) -> None:
    bars = [mark for mark in panel.marks if isinstance(mark, Bars)]
    categories = list(dict.fromkeys(category for mark in bars for category in mark.categories))
    base = np.zeros(len(categories))
    for mark in panel.marks:
        label = _plain(mark.name)
        match mark:
            case Line():
                if mark.shown:
                    _line(axis, mark, label)
            case Points():
                if mark.shown:
                    _points(axis, mark, label)
            case Bars():
                _bars(axis, mark, label, bars.index(mark), len(bars), categories, base if panel.stacked else None)
            case Heat():
                _heat(axis, mark, label)
    if bars:
        _name_categories(axis, categories)
    axis.set_title(_plain(panel.title), fontsize=10, loc="left", color=LIGHT["ink"])
    axis.set_xlabel(_plain(panel.x_label), fontsize=9)
    axis.set_ylabel(_plain(panel.y_label), fontsize=9)
    axis.tick_params(labelsize=8)
    if panel.x_log:
        axis.set_xscale("log")
    if panel.y_log:
        axis.set_yscale("log")
    if panel.y_range is not None:
        axis.set_ylim(*panel.y_range)
    if panel.bare:
        axis.set_xticks([])
        axis.set_yticks([])
    if not panel.bare and not any(isinstance(mark, Heat) for mark in panel.marks):
        axis.grid(color=LIGHT["grid"], linewidth=0.7)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if len(unique) > 1:
        # Below the axes, as in the page: there it hides nothing, and no place for it has to be searched.
        below = -0.04 if panel.bare else -0.17 if not bars else -0.3
        columns = min(len(unique), 3 if max(map(len, unique)) > 16 else 4)
        axis.legend(list(unique.values()), list(unique), fontsize=7, frameon=False, ncols=columns, loc="upper center", bbox_to_anchor=(0.5, below))


def _line(axis: "Axes", mark: Line, label: str) -> None:
    colour, x = LIGHT[mark.colour], np.asarray(mark.x, np.float64)
    if mark.low is not None and mark.high is not None:
        axis.fill_between(x, np.asarray(mark.low), np.asarray(mark.high), color=colour, alpha=0.16, linewidth=0, step="post" if mark.steps else None)
    axis.plot(
        x,
        np.asarray(mark.y, np.float64),
        "--" if mark.dash else "-",
        color=colour,
        linewidth=0.8 * mark.width,
        marker="." if mark.dots else None,
        markersize=4,
        label=label,
        drawstyle="steps-post" if mark.steps else "default",
    )


def _points(axis: "Axes", mark: Points, label: str) -> None:
    colour, x, y = LIGHT[mark.colour], np.asarray(mark.x, np.float64), np.asarray(mark.y, np.float64)
    if mark.x_interval is not None or mark.y_interval is not None:
        axis.errorbar(x, y, xerr=_errors(x, mark.x_interval), yerr=_errors(y, mark.y_interval), fmt="none", ecolor=colour, alpha=0.5, capsize=2)
    axis.scatter(x, y, s=mark.size**2 / 2.5, color=colour, marker=_SYMBOLS[mark.symbol], label=None if mark.labelled else label, linewidths=0.8)
    if mark.labelled:
        for place in zip(x, y, strict=True):
            axis.annotate(label, place, xytext=(0, 6), textcoords="offset points", ha="center", fontsize=7, color=colour)


def _bars(axis: "Axes", mark: Bars, label: str, number: int, count: int, categories: list[str], base: Any) -> None:
    places = np.array([categories.index(category) for category in mark.categories])
    heights = np.asarray(mark.y, np.float64)
    if base is None:
        width = 0.75 / count
        axis.bar(places + (number - (count - 1) / 2) * width, heights, width * 0.94, color=LIGHT[mark.colour], label=label)
        if mark.low is not None and mark.high is not None:
            middles = places + (number - (count - 1) / 2) * width
            axis.errorbar(middles, heights, yerr=_errors(heights, (mark.low, mark.high)), fmt="none", ecolor=LIGHT["ink"], capsize=2, linewidth=0.9)
    else:
        axis.bar(places, heights, 0.7, bottom=base[places], color=LIGHT[mark.colour], label=label)
        base[places] += np.nan_to_num(heights)


def _name_categories(axis: "Axes", categories: list[str]) -> None:
    steep = len(categories) > 4 or max((len(name) for name in categories), default=0) > 14
    axis.set_xticks(
        range(len(categories)), [_plain(name) for name in categories], rotation=35 if steep else 0, ha="right" if steep else "center", fontsize=8
    )


def _heat(axis: "Axes", mark: Heat, label: str) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    ends = {"sequential": ("surface", "c0"), "diverging": ("c0", "surface", "c1")}[mark.scale]
    colours = LinearSegmentedColormap.from_list(mark.scale, [LIGHT[name] for name in ends])
    x, y, z = (np.asarray(part, np.float64) for part in (mark.x, mark.y, mark.z))
    picture = axis.pcolormesh(x, y, z, cmap=colours, vmin=mark.low, vmax=mark.high, shading="nearest", rasterized=True)
    bar = axis.figure.colorbar(picture, ax=axis)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _errors(values: np.ndarray[Any, np.dtype[np.float64]], interval: tuple[ArrayLike, ArrayLike] | None) -> Any:
    if interval is None:
        return None
    low, high = (np.asarray(end, np.float64) for end in interval)
    return np.maximum(np.stack([values - low, high - values]), 0.0)


def _plain(text: str) -> str:
    """Text that matplotlib takes for no formula."""
    return text.replace("$", r"\$")
