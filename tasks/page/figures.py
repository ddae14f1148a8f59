"""The figures of the reports. Same records, same bytes."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike
from pandas import DataFrame

from tasks.labels import OTHER_COLOURS, Label
from tasks.summarise import pareto

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))
"""Line styles of the curves of one panel, in their order."""
MAX_CURVES = len(DASHES)  # of one panel
RULE, LINES, PAPER = "#7f8794", "#e4e8ef", "#fffffe"  # marks of reference, grid, background
THEMED = {"#000000": "currentColor", LINES: "var(--lines)", PAPER: "var(--paper)"}  # colours that follow the page's
MARKERS = "osD^"  # of the series of a dot plot
MAX_LINE_LENGTH = 100  # characters of a line of text
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


@dataclass(frozen=True)
class Palette:
    """Colours of methods.

    Args:
        colours: Colours `#rrggbb` by name.

    Example:
        >>> Palette({"gp": "#d1620f"}).colour("gp")
        '#d1620f'
    """

    colours: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, labels: Mapping[str, Label]) -> Palette:
        """Return the palette of labelled methods."""
        return cls({name: label.colour for name, label in labels.items() if label.colour})

    def colour(self, name: str) -> str:
        """Return the colour of a method. A method without a label has a colour that follows from its name."""
        return self.colours.get(name) or OTHER_COLOURS[sum(name.encode()) % len(OTHER_COLOURS)]


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of width x height inches in the style of the reports, and its axes row by row."""
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


def panel(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of width x height inches in the style of the reports, and its only axes."""
    figure, (axes,) = new_figure(1, 1, width, height)
    return figure, axes


def in_space(figure: Figure, axes: Axes) -> Any:
    """Axes with three dimensions in the place of others."""
    place = axes.get_subplotspec()
    axes.remove()
    with matplotlib.style.context(STYLE):
        return figure.add_subplot(place, projection="3d")


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


def as_svg(figure: Figure, title: str | None = None) -> str:
    """Return the figure as SVG without date or random names, with a title for readers who do not see it."""
    stream = io.StringIO()
    canvas, dpi = FigureCanvasSVG(figure), figure.dpi
    with matplotlib.style.context(STYLE):
        if (engine := figure.get_layout_engine()) is not None:  # savefig would draw the figure twice to place its parts
            engine.execute(figure)
            figure.set_layout_engine("none")
            figure.dpi = dpi  # the layout changed it
        metadata: dict[str, str | None] = {"Date": None, "Creator": None}
        if title is not None:
            metadata["Title"] = title
        # print_figure would draw it twice
        canvas.print_svg(stream, metadata=metadata)  # type: ignore[no-untyped-call]
    return stream.getvalue()


def for_page(svg: str, name: str) -> str:
    """Return the SVG as an element of a page, in the page's colours (light or dark), with unique identifiers."""
    element = svg[svg.index("<svg") :]
    for colour, themed in THEMED.items():
        element = element.replace(colour, themed)
    element = element.replace("<svg", '<svg role="img"', 1)
    return re.sub(r'((?:id="|href="#|url\(#))', rf"\g<1>{name}-", element)


def legend_below(figure: Figure, axes: Axes) -> None:
    """One legend for all axes, from the entries of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=_columns(figure, labels), frameon=False)


def _columns(figure: Figure, labels: Sequence[str]) -> int:
    """Return the number of columns of a legend no wider than its figure: a line, and 0.08 inches a letter."""
    widest = max((len(label) for label in labels), default=0)
    return max(1, int(figure.get_figwidth() / (0.6 + 0.08 * widest)))


def cdf(axes: Axes, palette: Palette, errors: Mapping[str, ArrayLike], label: str, limit: float | None = None) -> None:
    """Draw the empirical distribution of the errors of at most `MAX_CURVES` methods; the thin line is at the median."""
    _expect_few(errors)
    for dashes, (name, values) in zip(DASHES, errors.items(), strict=False):
        style: dict[str, Any] = {"color": palette.colour(name), "linestyle": dashes, "linewidth": 1.6}
        if np.size(values):
            axes.ecdf(np.asarray(values), label=name, **style)
    axes.axhline(0.5, color=RULE, linewidth=0.8)
    axes.set(xlabel=label, ylabel="fraction of test spectra", ylim=(0, 1.02), xlim=(0, limit))
    end_labels(axes)


def curves(axes: Axes, palette: Palette, lines: Mapping[str, tuple[ArrayLike, ArrayLike]], x: str, y: str) -> None:
    """Draw one line for each of at most `MAX_CURVES` names."""
    _expect_few(lines)
    for dashes, (name, (xs, ys)) in zip(DASHES, lines.items(), strict=False):
        axes.plot(
            np.asarray(xs), np.asarray(ys), label=name, color=palette.colour(name), linestyle=dashes, linewidth=1.6
        )
    axes.set(xlabel=x, ylabel=y)
    end_labels(axes)


def _expect_few(lines: Mapping[str, Any]) -> None:
    if len(lines) > MAX_CURVES:
        raise ValueError(f"a panel has at most {MAX_CURVES} curves, got {len(lines)}: {', '.join(lines)}")


def end_labels(axes: Axes) -> None:
    """Write the name of each labelled line at its right end, in its colour, such that no name covers another."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # an axes outside of a figure has no size
    lines = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_") and len(line.get_path())]
    ends = []
    for line in lines:
        x, y = np.asarray(line.get_xdata(), dtype=float), np.asarray(line.get_ydata(), dtype=float)
        inside = x <= axes.get_xlim()[1]
        last = np.flatnonzero(inside)[-1] if inside.any() else 0
        at = axes.transAxes.inverted().transform(axes.transData.transform((x[last], y[last])))
        stays = line.get_drawstyle() == "steps-post"  # up to the right edge
        ends.append((1.0 if stays else float(np.clip(at[0], 0, 1)), float(np.clip(at[1], 0, 1))))
    order = np.argsort([y for _, y in ends], kind="stable")
    spacing = 1.5 * LABEL / 72 / (0.75 * figure.get_figheight())
    places = np.array([ends[i][1] for i in order])
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + spacing)
    for i in reversed(range(len(places))):
        places[i] = min(places[i], 1 - spacing * (len(places) - 1 - i))
    for i, place in zip(order, places, strict=True):
        colour = lines[i].get_color()
        axes.annotate(
            short(str(lines[i].get_label())),
            ends[i],
            xytext=(1.05, place),
            xycoords="axes fraction",
            color=colour,
            fontsize=LABEL + 1,
            verticalalignment="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "linewidth": 0.8,
                "shrinkA": 1,
                "shrinkB": 0,
                "relpos": (0.0, 0.5),
            },
        )


def dots(
    rows: Sequence[str],
    values: Mapping[str, Sequence[tuple[float, float, float]]],
    palette: Palette,
    label: str,
    zero: bool = False,
    log: bool = False,
) -> Figure:
    """Return a dot plot with whiskers, a row for each name, the first on top.

    Args:
        rows: Names of the rows.
        values: Value, low and high of each row for at most `MAX_CURVES` series. nan is left out.
        palette: Colours of the series. A single series has one colour and no legend.
        label: Label of the values.
        zero: Whether the line of zero is drawn.
        log: Whether the axis is logarithmic.
    """
    _expect_few(values)
    figure, axes = panel(5.6, 0.7 + 0.27 * len(rows) * max(1.0, 0.55 * len(values)) + (0.3 if len(values) > 1 else 0))
    for number, (marker, (name, of_rows)) in enumerate(zip(MARKERS, values.items(), strict=False)):
        value, low, high = np.array(of_rows, dtype=float).reshape(-1, 3).T
        at = np.arange(len(rows)) + 0.2 * (number - (len(values) - 1) / 2)
        error = np.clip(np.nan_to_num([value - low, high - value]), 0, None)
        style: dict[str, Any] = {"color": palette.colour(name), "fmt": marker, "markersize": 5, "elinewidth": 1.4}
        axes.errorbar(value, at, xerr=error, label=short(name), **style)
    if zero:
        axes.axvline(0, color=RULE, linewidth=1)
    axes.set(yticks=range(len(rows)), yticklabels=[plain(textwrap.fill(name, NAME)) for name in rows], xlabel=label)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if log and any(value > 0 for of_rows in values.values() for value, *_ in of_rows):
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    axes.grid(axis="y", visible=False)
    if len(values) > 1:
        figure.legend(loc="outside upper left", ncols=len(values), frameon=False, fontsize=LABEL + 1)
    return figure


def dots_data(
    row: str, rows: Sequence[str], values: Mapping[str, Sequence[tuple[float, float, float]]], unit: str
) -> DataFrame:
    """Return the numbers of `dots`, a row for each value."""
    cells = [(of, name, *value) for name, each in values.items() for of, value in zip(rows, each, strict=True)]
    return DataFrame(cells, columns=[row, "series", f"value_{unit}", f"low_{unit}", f"high_{unit}"])


def speed(
    axes: Axes,
    palette: Palette,
    points: Mapping[str, tuple[float, float]],
    x: str,
    y: str,
    also: Sequence[str] = (),
) -> None:
    """Draw cost against error, both logarithmic, with the Pareto front and the names of its members and of `also`.

    The part of a name before its first comma determines its colour.
    """
    front = pareto(points)
    axes.plot(*zip(*(points[name] for name in front), strict=True), color=RULE, linewidth=1, zorder=1)
    for name, (cost, error) in points.items():
        colour = palette.colour(name.split(",")[0])
        axes.plot(cost, error, "o", color=colour, markersize=5 if name in front else 3.5, zorder=2)
    scale = "log" if any(min(point) > 0 for point in points.values()) else "linear"
    axes.set(xscale=scale, yscale=scale, xlabel=x, ylabel=y)
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
