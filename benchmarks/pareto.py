"""The front of methods that no other one beats in both speed and error, and its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

from tasks.page import figures
from tasks.page.figures import Palette

BESIDE = (((5, 3), "left"), ((5, -9), "left"), ((-5, 3), "right"), ((-5, -9), "right"))  # places of a name [pt]


def pareto(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points (cost, error) that no other one beats or equals in both, by cost."""
    front: list[str] = []
    for name in sorted(points, key=lambda name: points[name]):
        if not front or points[name][1] < points[front[-1]][1]:
            front.append(name)
    return front


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
    axes.plot(*zip(*(points[name] for name in front), strict=True), color=figures.RULE, linewidth=1, zorder=1)
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
    width, height = 0.65 * figures.LABEL * len(name), figures.LABEL
    boxes = [
        Bbox.from_bounds(x + dx - (width if side == "right" else 0), y + dy, width, height) for (dx, dy), side in BESIDE
    ]
    best = next((n for n, box in enumerate(boxes) if not any(box.overlaps(other) for other in taken)), 0)
    offset, side = BESIDE[best]
    axes.annotate(
        name, point, textcoords="offset points", xytext=offset, fontsize=figures.LABEL, horizontalalignment=side
    )
    return boxes[best]
