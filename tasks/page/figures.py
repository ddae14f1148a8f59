"""The figures of the reports. Same records, same bytes."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike, NDArray
from pandas import DataFrame

from tasks.page.palette import Palette
from tasks.summarise import pareto

RULE, LINES, PAPER = "#aeb7c6", "#e4e8ef", "#fffffe"  # marks of reference, grid, background
THEMED = {"#000000": "currentColor", LINES: "var(--lines)", PAPER: "none"}  # what the page's own colours replace
LONGEST = 100  # characters of a line of text
NAME = 24  # characters of a name among others
LABEL = 7  # size of a point's name [pt]
BESIDE = (((5, 3), "left"), ((5, -9), "left"), ((-5, 3), "right"), ((-5, -9), "right"))  # where it may stand [pt]
STYLE: dict[str, Any] = {
    "svg.hashsalt": "swiftwrf-tasks",
    "svg.fonttype": "path",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINES,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    **{f"axes3d.{axis}axis.panecolor": PAPER for axis in "xyz"},
}


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of width x height inches in the style of the reports, and its axes row by row."""
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


def in_space(figure: Figure, axes: Axes) -> Any:
    """Axes with three dimensions in the place of others."""
    place = axes.get_subplotspec()
    axes.remove()
    with matplotlib.style.context(STYLE):
        return figure.add_subplot(place, projection="3d")


def plain(text: str, most: int = LONGEST) -> str:
    """Text of a figure: dollars in it begin no formula, and a line of it leaves room for the figure."""
    lines = (line if len(line) <= most else f"{line[: most - 1]}…" for line in text.split("\n"))
    return "\n".join(lines).replace("$", r"\$")


def short(name: str) -> str:
    """A name that stands among others: on an axis, in a legend, over one of several maps."""
    return plain(name, NAME)


def as_svg(figure: Figure) -> str:
    """The figure as SVG without date or random names."""
    stream = io.StringIO()
    canvas = FigureCanvasSVG(figure)
    with matplotlib.style.context(STYLE):
        if (engine := figure.get_layout_engine()) is not None:  # savefig would draw the figure twice to place its parts
            engine.execute(figure)
            figure.set_layout_engine("none")
        canvas.print_figure(stream, format="svg", metadata={"Date": None, "Creator": None})
    return stream.getvalue()


def for_page(svg: str, name: str) -> str:
    """The same drawing as an element of a page: in the page's colours, light or dark, its identifiers its own."""
    element = svg[svg.index("<svg") :]
    for colour, themed in THEMED.items():
        element = element.replace(colour, themed)
    return re.sub(r'((?:id="|href="#|url\(#))', rf"\g<1>{name}-", element)


def legend_below(figure: Figure, axes: Axes) -> None:
    """One legend for all axes, from the entries of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=_columns(figure, labels), frameon=False)


def legend_of(figure: Figure, palette: Palette, names: Sequence[str]) -> None:
    """A legend of dots in the colours of methods."""
    dots = [Line2D([], [], marker="o", linestyle="", color=palette.colour(name), label=name) for name in names]
    figure.legend(handles=dots, loc="outside lower center", ncols=_columns(figure, names), frameon=False)


def _columns(figure: Figure, labels: Sequence[str]) -> int:
    """Of a legend that is no wider than its figure: a line, and 0.08 inches a letter."""
    widest = max((len(label) for label in labels), default=0)
    return max(1, int(figure.get_figwidth() / (0.6 + 0.08 * widest)))


def cdf(axes: Axes, palette: Palette, errors: Mapping[str, ArrayLike], label: str, limit: float | None = None) -> None:
    """Empirical distribution of each method's errors, with the median marked by the line at 0.5; one that a later one would
    cover is drawn wider."""
    curves = [np.quantile(np.asarray(values), np.linspace(0, 1, 21)) for values in errors.values()]
    near = 0.005 * (limit or max(curve[-1] for curve in curves))
    for number, (name, values) in enumerate(errors.items()):
        covered = any(np.allclose(curves[number], later, rtol=0, atol=near) for later in curves[number + 1 :])
        style: dict[str, Any] = {"color": palette.colour(name), "linestyle": palette.line(name)}
        axes.ecdf(np.asarray(values), label=name, linewidth=4 if covered else 1.4, **style)
    axes.axhline(0.5, color=RULE, linewidth=0.8)
    axes.set(xlabel=label, ylabel="share of test spectra", ylim=(0, 1), xlim=(0, limit))


def bars(
    axes: Axes,
    palette: Palette,
    groups: Sequence[str],
    heights: Mapping[str, Sequence[tuple[float, float, float]]],
    label: str,
) -> None:
    """Bars with whiskers: for each method one (value, low, high) a group."""
    width = 0.8 / max(len(heights), 1)
    for i, (name, values) in enumerate(heights.items()):
        value, low, high = np.array(values, dtype=float).reshape(-1, 3).T
        at = np.arange(len(groups)) + (i - (len(heights) - 1) / 2) * width
        error = np.clip([value - low, high - value], 0, None)
        style: dict[str, Any] = {"color": palette.colour(name), "error_kw": {"elinewidth": 0.8}}
        axes.bar(at, value, width * 0.92, yerr=error, label=name, **style)
    axes.set(xticks=range(len(groups)), xticklabels=groups, ylabel=label)
    axes.grid(axis="x", visible=False)


def bars_data(
    group: str, groups: Sequence[str], heights: Mapping[str, Sequence[tuple[float, float, float]]], unit: str
) -> DataFrame:
    """The numbers of such bars, a row each."""
    rows = [(of, name, *value) for name, values in heights.items() for of, value in zip(groups, values, strict=True)]
    return DataFrame(rows, columns=[group, "method", f"median_{unit}", f"low_{unit}", f"high_{unit}"])


def spectra(
    measured: NDArray[Any],
    synthetic: NDArray[Any],
    captions: Sequence[str],
    deviation: NDArray[Any] | None = None,
) -> Figure:
    """Measured, synthesized, their difference and, where it is known, the deviation that was expected, one row a spectrum;
    azimuth to the right, elevation upwards [deg]."""
    missed = synthetic - measured
    most = float(np.abs(missed).max()) or 1.0  # a scale from -1 to 1 would show a good spectrum's misses as nothing
    columns = [
        ("measured", measured, "viridis", (0.0, 1.0)),
        ("synthesized", synthetic, "viridis", (0.0, 1.0)),
        ("synthesized - measured", missed, "RdBu_r", (-most, most)),
        *([("expected deviation", deviation, "magma", (0.0, float(deviation.max())))] if deviation is not None else []),
    ]
    n = len(columns)
    figure, axes = new_figure(len(measured), n, 3 * n, 0.95 * len(measured) + 0.6)
    for column, (title, images, colours, (low, high)) in enumerate(columns):
        for row, image in enumerate(images):
            ax = axes[n * row + column]
            drawn = ax.imshow(
                image,
                origin="lower",
                extent=(0, 360, 0, 90),
                aspect="auto",
                interpolation="nearest",
                cmap=colours,
                vmin=low,
                vmax=high,
            )
            ax.set(yticks=(0, 90), xticks=(0, 180, 360) if row == len(captions) - 1 else ())
            ax.grid(visible=False)
        axes[column].set_title(title, fontsize=9)
        if column:
            figure.colorbar(drawn, ax=axes[column::n], fraction=0.04, pad=0.02)
    for row, caption in enumerate(captions):
        axes[n * row].set_ylabel(caption, rotation=0, ha="right", va="center")
    axes[n * (len(captions) - 1) + 1].set_xlabel("azimuth [deg]")
    return figure


def curves(axes: Axes, palette: Palette, lines: Mapping[str, tuple[ArrayLike, ArrayLike]], x: str, y: str) -> None:
    """One line a name, y logarithmic."""
    for name, (xs, ys) in lines.items():
        axes.plot(np.asarray(xs), np.asarray(ys), label=name, color=palette.colour(name), linewidth=1.2)
    axes.set(xlabel=x, ylabel=y, yscale="log")
    axes.legend(fontsize=7, frameon=False)


def speed(
    axes: Axes,
    palette: Palette,
    points: Mapping[str, tuple[float, float]],
    x: str,
    y: str,
    also: Sequence[str] = (),
) -> None:
    """Cost against error, both logarithmic: the Pareto front is drawn, its members and those in `also` are named. Names
    are coloured as methods by what stands before their first comma."""
    front = pareto(points)
    axes.plot(*zip(*(points[name] for name in front), strict=True), color=RULE, linewidth=1, zorder=1)
    for name, (cost, error) in points.items():
        colour = palette.colour(name.split(",")[0])
        axes.plot(cost, error, "o", color=colour, markersize=5 if name in front else 3.5, zorder=2)
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.margins(x=0.25, y=0.1)
    taken: list[Bbox] = []
    for name, point in points.items():
        if name in front or name in also:
            taken.append(_annotated(axes, name, point, taken))
    low, high = axes.get_ylim()
    if high < 30 * low:  # plain numbers where powers of ten would be few
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")


def _annotated(axes: Axes, name: str, point: tuple[float, float], taken: Sequence[Bbox]) -> Bbox:
    """Names a point where that covers none of the boxes taken, if there is such a place, and returns its own box."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # an axes outside of a figure has no places
    x, y = axes.transData.transform(point) * 72 / figure.dpi
    width, height = 0.65 * LABEL * len(name), LABEL
    boxes = [
        Bbox.from_bounds(x + dx - (width if side == "right" else 0), y + dy, width, height) for (dx, dy), side in BESIDE
    ]
    best = next((n for n, box in enumerate(boxes) if not any(box.overlaps(other) for other in taken)), 0)
    offset, side = BESIDE[best]
    axes.annotate(name, point, textcoords="offset points", xytext=offset, fontsize=LABEL, horizontalalignment=side)
    return boxes[best]
