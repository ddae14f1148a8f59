"""The figures of the reports. Same records, same bytes."""

from __future__ import annotations

import base64
import io
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from warnings import catch_warnings, filterwarnings

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike, NDArray
from pandas import DataFrame
from PIL import Image

from tasks.labels import colour

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))
"""Line styles of the curves of one panel, in their order."""
MAX_CURVES = len(DASHES)  # of one panel
Colours = Mapping[str, str]  # by name, those of `tasks.labels.colour` for other names
RULE, LINES, PAPER = "#7f8794", "#e4e8ef", "#fffffe"  # marks of reference, grid, background
THEMED = {"#000000": "currentColor", LINES: "var(--lines)", PAPER: "var(--paper)"}  # colours that follow the page's
MARKERS = "osD^"  # of the series of a dot plot
MAX_VECTOR_MARKS = 300  # of a panel; more become an image, so that the page stays small
MAX_LINE_LENGTH = 100  # characters of a line of text
NAME = 24  # characters of a name among others
LABEL = 7  # size of a point's name [pt]
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


def panel(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of width x height inches in the style of the reports, and its axes."""
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(width, height), layout="compressed")
        return figure, figure.subplots()


def colour_bar(axes: Axes, drawn: Any, label: str = "", extend: str = "neither", pad: float = 0.03) -> None:
    """Draw a colour bar beside axes, in the style of the reports."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # axes outside of a figure have no place beside them
    with matplotlib.style.context(STYLE):
        figure.colorbar(drawn, ax=axes, label=label, fraction=0.045, pad=pad, extend=extend)


def plain(text: str, most: int = MAX_LINE_LENGTH) -> str:
    """Text of a figure: dollars in it begin no formula, and a line of it leaves room for the figure."""
    lines = (line if len(line) <= most else f"{line[: most - 1]}…" for line in text.split("\n"))
    return "\n".join(lines).replace("$", r"\$")


def short(name: str) -> str:
    """A name that stands among others: on an axis, in a legend, over one of several maps."""
    return plain(name, NAME)


def align(panels: Sequence[Figure]) -> None:
    """Give panels with the same axes, labels and scales the places of the first one's axes, which are computed once."""
    first, *others = panels
    with _drawing():
        _lay_out(first)
    for figure in others:
        figure.set_layout_engine("none")
        for axes, placed in zip(figure.axes, first.axes, strict=True):
            for which in ("original", "active"):
                axes.set_position(placed.get_position(which == "original"), which)


def as_svg(figure: Figure, title: str | None = None) -> str:
    """Return the figure as SVG without date or random names, with a title for readers who do not see it."""
    stream = io.StringIO()
    with _drawing():
        canvas = _lay_out(figure)
        metadata: dict[str, str | None] = {"Date": None, "Creator": None}
        if title is not None:
            metadata["Title"] = title
        # print_figure would draw it twice
        canvas.print_svg(stream, metadata=metadata)  # type: ignore[no-untyped-call]
    svg = re.sub(r'(data:image/png;base64,\s*)([^"]+)', _with_palette, stream.getvalue())
    return re.sub(r' d="[^"]+"', lambda path: re.sub(r"(\.\d)\d+", r"\1", path[0]), svg)  # tenths of a point


@contextmanager
def _drawing() -> Iterator[None]:
    """Draw in the style of the reports."""
    with matplotlib.style.context(STYLE), catch_warnings():
        filterwarnings("ignore", "Glyph .* missing")  # of names in scripts that the font lacks
        yield


def _lay_out(figure: Figure) -> FigureCanvasSVG:
    """Place the parts of a figure, and return its canvas, which would draw it twice for that."""
    canvas, dpi = FigureCanvasSVG(figure), figure.dpi
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
        figure.dpi = dpi  # the layout changed it
    return canvas


def _with_palette(image: re.Match[str]) -> str:
    """Return an image of an SVG in 256 colours, a third of the bytes."""
    written = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(image[2]))) as pixels:
        pixels.convert("RGBA").quantize(256, Image.Quantize.FASTOCTREE).save(written, "PNG", optimize=True)
    return f"{image[1]}{base64.b64encode(written.getvalue()).decode()}"


def for_page(svg: str, name: str) -> str:
    """Return the SVG as an element of a page, in the page's colours (light or dark), with unique identifiers."""
    element = svg[svg.index("<svg") :]
    for own, themed in THEMED.items():
        element = element.replace(own, themed)
    element = element.replace("<svg", '<svg role="img"', 1)
    return re.sub(r'((?:id="|href="#|url\(#))', rf"\g<1>{name}-", element)


def legend_below(axes: Axes) -> None:
    """Draw one legend below a figure, no wider than it, from the entries of one of its axes."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # axes outside of a figure have no legend
    handles, labels = axes.get_legend_handles_labels()
    widest = max(map(len, labels), default=0)
    columns = max(1, int(figure.get_figwidth() / (0.6 + 0.08 * widest)))  # inches of a line, and of a letter
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)


def cdf(axes: Axes, colours: Colours, errors: Mapping[str, ArrayLike], label: str, limit: float | None = None) -> None:
    """Draw the empirical distribution of the errors of at most `MAX_CURVES` methods; the thin line is at the median."""
    _expect_few(errors)
    for dashes, (name, values) in zip(DASHES, errors.items(), strict=False):
        if np.size(values):
            style: dict[str, Any] = {"color": colour(colours, name), "linestyle": dashes, "linewidth": 1.6}
            axes.ecdf(np.asarray(values), label=name, **style)
    axes.axhline(0.5, color=RULE, linewidth=0.8)
    axes.set(xlabel=label, ylabel="fraction of test rows", ylim=(0, 1.02), xlim=(0, limit))
    legend_below(axes)


def curves(axes: Axes, colours: Colours, lines: Mapping[str, tuple[ArrayLike, ArrayLike]], x: str, y: str) -> None:
    """Draw one line for each of at most `MAX_CURVES` names."""
    _expect_few(lines)
    for dashes, (name, (xs, ys)) in zip(DASHES, lines.items(), strict=False):
        style: dict[str, Any] = {"color": colour(colours, name), "linestyle": dashes, "linewidth": 1.6}
        axes.plot(np.asarray(xs), np.asarray(ys), label=name, **style)
    axes.set(xlabel=x, ylabel=y)
    legend_below(axes)


def speed(axes: Axes, colours: Colours, points: Mapping[str, tuple[float, float]], x: str, y: str) -> None:
    """Draw the cost and the error of each method, costs on a logarithmic scale."""
    for marker, (name, (cost, error)) in zip("osD^vP", points.items(), strict=False):
        axes.plot(max(cost, 1e-4), error, marker, color=colour(colours, name), label=name)
    axes.set(xlabel=x, ylabel=y, ylim=(0, None))
    log_scale(axes)
    legend_below(axes)


def errors_in_plan(axes: Axes, truth: NDArray[Any], estimate: NDArray[Any], error: NDArray[Any], label: str) -> None:
    """Draw a line from each true position (n, 2) to its estimate (n, 2) [m], coloured by the error (n,)."""
    style: dict[str, Any] = {"cmap": "viridis", "rasterized": len(error) >= MAX_VECTOR_MARKS}
    lines = LineCollection(np.stack([truth, estimate], axis=1).tolist(), linewidths=1, **style)
    lines.set_array(error)
    axes.add_collection(lines)
    dots = axes.scatter(truth[:, 0], truth[:, 1], c=error, s=8, zorder=3, **style)
    for drawn in (lines, dots):
        drawn.set_clim(0, float(np.quantile(error, 0.95)) or 1.0)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.autoscale()
    colour_bar(axes, lines, label, extend="max")


def log_scale(axes: Axes) -> None:
    """Give the axis of x a logarithmic scale with plain numbers, of which a range of several decades has fewer a decade."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(
        LogLocator(subs=(1, 2, 5) if high < 50 * low else (1, 3) if high < 2000 * low else (1,))
    )
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")


def _expect_few(lines: Mapping[str, Any]) -> None:
    if len(lines) > MAX_CURVES:
        raise ValueError(f"a panel has at most {MAX_CURVES} curves, got {len(lines)}: {', '.join(lines)}")


def dots(
    rows: Sequence[str],
    values: Mapping[str, Sequence[tuple[float, float, float]]],
    colours: Colours,
    label: str,
    zero: bool = False,
    log: bool = False,
) -> Figure:
    """Return a dot plot with whiskers, a row for each name, the first on top.

    Args:
        rows: Names of the rows.
        values: Value, low and high of each row for at most `MAX_CURVES` series. nan is left out.
        colours: Colours of the series. A single series has one colour and no legend.
        label: Label of the values.
        zero: Whether the line of zero is drawn.
        log: Whether the axis is logarithmic if all values are positive and the largest is more than ten times the smallest.
    """
    _expect_few(values)
    names = [plain(textwrap.fill(name, NAME)) for name in rows]
    lines = max((name.count("\n") + 1 for name in names), default=1)
    height = 0.27 * max(1.0, 0.55 * len(values), 0.6 * lines)
    figure, axes = panel(5.1, 0.7 + height * len(rows) + (0.2 * len(values) if len(values) > 1 else 0))
    known = []
    for number, (marker, (name, of_rows)) in enumerate(zip(MARKERS, values.items(), strict=False)):
        value, low, high = np.array(of_rows, dtype=float).reshape(-1, 3).T
        known += value[np.isfinite(value)].tolist()
        at = np.arange(len(rows)) + 0.2 * (number - (len(values) - 1) / 2)
        error = np.clip(np.nan_to_num([value - low, high - value]), 0, None)
        style: dict[str, Any] = {"color": colour(colours, name), "fmt": marker, "markersize": 5, "elinewidth": 1.4}
        axes.errorbar(value, at, xerr=error, label=plain(name), **style)
    if zero:
        axes.axvline(0, color=RULE, linewidth=1)
    axes.set(yticks=range(len(rows)), yticklabels=names, xlabel=label)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if log and known and max(known) > 10 * min(known) > 0:
        log_scale(axes)
    axes.grid(axis="y", visible=False)
    if len(values) > 1:
        legend_below(axes)
    return figure


def dots_data(
    row: str, rows: Sequence[str], values: Mapping[str, Sequence[tuple[float, float, float]]], unit: str
) -> DataFrame:
    """Return the numbers of `dots`, a row for each value."""
    cells = [(of, name, *value) for name, each in values.items() for of, value in zip(rows, each, strict=True)]
    return DataFrame(cells, columns=[row, "series", f"value_{unit}", f"low_{unit}", f"high_{unit}"])
