"""A figure's description as PNG and SVG."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from osel_sim.reporting.description import LIGHT, MOST_ROW_LETTERS, Bars, Figure, Heat, Line, Panel, Points, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_SYMBOLS = {"circle": "o", "diamond": "D", "x": "x", "star": "*"}
_COLUMNS = 2
_WIDTH, _HEIGHT, _ROW, _TITLE = 5.6, 3.2, 0.2, 0.45
"""Inches: of a panel, of what is drawn in it, of each of its named rows, and of the figure's title."""


def to_images(figure: Figure, dpi: int = 130) -> dict[str, bytes]:
    """Its PNG and SVG, by the file's ending; the same description is the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    columns = min(_COLUMNS, len(figure.panels))
    rows = -(-len(figure.panels) // columns)
    heights = [max(_height(panel) for panel in figure.panels[row * columns : (row + 1) * columns]) for row in range(rows)]
    canvas = Canvas(figsize=(_WIDTH * columns + (2.4 if columns == 1 else 0), sum(heights) + rows + _TITLE), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots(rows, columns, squeeze=False, height_ratios=heights)
    for place, axis in enumerate(axes.flat):
        if place < len(figure.panels):
            _draw(axis, figure.panels[place])
        else:
            axis.set_axis_off()
    _make_room(canvas, axes, heights)
    canvas.suptitle(_plain(figure.title), fontsize=12, color=LIGHT["ink"])
    images: dict[str, bytes] = {}
    # Without a date and with ids of its own the SVG depends on nothing but the figure.
    with matplotlib.rc_context({"svg.hashsalt": figure.name}):
        for ending, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
            buffer = io.BytesIO()
            canvas.savefig(buffer, format=ending, dpi=dpi, metadata=metadata)
            images[ending] = buffer.getvalue()
    return images


def _height(panel: Panel) -> float:
    return max(_HEIGHT, _ROW * len(panel.rows))


def _make_room(canvas: "Canvas", axes: Any, heights: list[float]) -> None:
    """Put the legends below the labels, and make the figure as high as all of it needs, so that nothing is squeezed or lies on another."""
    from matplotlib.transforms import ScaledTranslation

    around = np.zeros(axes.shape)
    for place, axis in np.ndenumerate(axes):
        box = axis.get_window_extent()
        labels = axis.xaxis.get_tightbbox()  # None where the axis is off or bare
        below = max(0.0, (box.y0 - labels.y0) / canvas.dpi) if labels is not None else 0.0
        handles, names = axis.get_legend_handles_labels()
        unique = dict(zip(names, handles, strict=True))
        if len(unique) > 1:
            fit = int((_WIDTH - 0.2) / (0.45 + 0.06 * max(map(len, unique))))
            down = axis.transAxes + ScaledTranslation(0.0, -below - 0.04, canvas.dpi_scale_trans)
            form = {"fontsize": 7, "frameon": False, "loc": "upper center", "borderaxespad": 0.3}
            axis.legend(
                list(unique.values()),
                list(unique),
                ncols=min(len(unique), max(1, fit), 5),
                bbox_to_anchor=(0.5, 0.0),
                bbox_transform=down,
                **form,
            )
        whole = axis.get_tightbbox()
        around[place] = 0.0 if whole is None else (whole.height - box.height) / canvas.dpi
    canvas.set_figheight(sum(heights) + float(around.max(axis=1).sum()) + 0.12 * len(heights) + _TITLE)


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
    if panel.rows:
        axis.set_yticks(range(len(panel.rows)), [_plain(shortened(name, MOST_ROW_LETTERS)) for name in panel.rows], fontsize=8)
        axis.set_ylim(len(panel.rows) - 0.5, -0.5)
        axis.xaxis.tick_top()
        axis.xaxis.set_label_position("top")
    if panel.bare:
        axis.set_xticks([])
        axis.set_yticks([])
    if not panel.bare and not any(isinstance(mark, Heat) for mark in panel.marks):
        axis.grid(color=LIGHT["grid"], linewidth=0.7)
    axis.set_axisbelow(True)
    for side in ("bottom" if panel.rows else "top", "right"):
        axis.spines[side].set_visible(False)


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
    edge, named = (LIGHT["surface"], None) if mark.labelled else (None, label)
    axis.scatter(x, y, s=mark.size**2 / 2.5, color=colour, marker=_SYMBOLS[mark.symbol], label=named, linewidths=0.8, edgecolors=edge)
    if mark.labelled:
        from matplotlib.patheffects import withStroke

        around = [withStroke(linewidth=2.2, foreground=LIGHT["surface"])]  # so that it can be read on any colour of a map
        for place in zip(x, y, strict=True):
            axis.annotate(label, place, xytext=(0, 6), textcoords="offset points", ha="center", fontsize=7, color=LIGHT["ink"], path_effects=around)


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
        range(len(categories)),
        [_plain(shortened(name, MOST_ROW_LETTERS)) for name in categories],
        rotation=35 if steep else 0,
        ha="right" if steep else "center",
        fontsize=8,
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
