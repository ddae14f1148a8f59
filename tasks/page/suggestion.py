"""The plot of positions to measure next, which several reports share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray
from pandas import DataFrame

from tasks.page import figures
from tasks.page.page import Plot

MEASURED, SUGGESTED = "#4477aa", "#cc3311"
MAX_NUMBERED = 30  # suggestions with their rank beside them; more would hide each other


def suggestion_plot(name: str, arrays: Mapping[str, NDArray[Any]], ylabel: str) -> Plot:
    """Return a plan of the suggested positions, and the expected variance after measuring there.

    Args:
        name: Name of the plot.
        arrays: `measured` (n, 3) and `suggested` (k, 3) positions [m], and `left`, the relative variance after measuring at
            0 to k positions, (1 + k,).
        ylabel: Label of the variance in percent.
    """
    measured, suggested, left = (arrays[key] for key in ("measured", "suggested", "left"))
    figure, (plan, gain) = figures.new_figure(1, 2, 11, 4.2)
    plan.plot(*measured[:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*suggested[:, :2].T, "o", color=SUGGESTED, markersize=4, label="to measure next")
    for rank, (x, y) in enumerate(suggested[:MAX_NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(figure, plan)
    gain.plot(range(len(left)), 100 * left, color=SUGGESTED)
    gain.set(xlabel="suggested positions measured", ylabel=ylabel, ylim=(0, None))
    caption = "Left: in plan, numbered by rank. Right: expected variance over the region, averaged."
    data = DataFrame(suggested, columns=["x_m", "y_m", "z_m"]).assign(variance_left=left[1:])
    return Plot(name, figure, caption, data)
