"""The plot of positions to measure next, which several reports share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray
from pandas import DataFrame

from tasks.page import figures
from tasks.page.page import Plot

MEASURED, SUGGESTED = "#3a7fd5", "#cf4a4a"
MIN_REDUCTION = 0.1  # of the variance, below which more positions are not worth it
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
    first, plan = figures.panel(5, 4.2)
    plan.plot(*measured[:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*suggested[:, :2].T, "D", color=SUGGESTED, markersize=4, label="to measure next")
    for rank, (x, y) in enumerate(suggested[:MAX_NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(first, plan)
    second, gain = figures.panel(4.6, 3.4)
    gain.plot(range(len(left)), 100 * left, color=SUGGESTED)
    gain.set(xlabel="suggested positions measured", ylabel=ylabel, ylim=(0, None))
    caption = "Left: in plan, numbered by rank. Right: expected variance over the region, averaged."
    data = DataFrame(suggested, columns=["x_m", "y_m", "z_m"]).assign(variance_left=left[1:])
    return Plot(name, [first, second], caption, data)


def worth(left: NDArray[Any]) -> str:
    """Return whether the suggested positions are worth measuring.

    Args:
        left: Relative variance after measuring at 0 to k positions, (1 + k,).

    Example:
        >>> import numpy as np
        >>> worth(np.array([0.11, 0.105]))
        'This is not worth it: the variance hardly falls.'
    """
    if left[-1] > (1 - MIN_REDUCTION) * left[0]:
        return "This is not worth it: the variance hardly falls."
    return "This is worth it where the variance falls most: begin with the first positions."
