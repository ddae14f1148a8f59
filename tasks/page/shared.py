"""Tables and figures that reports of several tasks share: comparison of runs, positions to measure next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame

from swiftwrf.metrics import ErrorSummary
from tasks.page import figures
from tasks.page.figures import MAX_CURVES, Palette
from tasks.page.page import Plot, Table, number

MEASURED, SUGGESTED = "#3a7fd5", "#cf4a4a"
MIN_REDUCTION = 0.1  # of the variance, below which more positions are not worth it
MAX_NUMBERED = 30  # suggestions with their rank beside them; more would hide each other
NONE = (np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Compared:
    """Errors of one run, or of one part of it.

    Args:
        name: Short name, unique among those that are compared.
        errors: Summary of the errors by what is compared.
        numbers: Further cells of its column by their rows.
    """

    name: str
    errors: Mapping[str, ErrorSummary]
    numbers: Mapping[str, str]


def comparison(
    compared: Sequence[Compared], palette: Palette, shown: Sequence[str], unit: str, quantity: str
) -> tuple[Table, Plot]:
    """Return the table of all errors, a column for each run, and the figure of some.

    Args:
        compared: Errors of each run.
        palette: Colours of what is compared.
        shown: What the figure shows. The first `MAX_CURVES` are taken.
        unit: Unit of the errors.
        quantity: Name of the errors.
    """
    columns = list(dict.fromkeys(name for one in compared for name in one.errors))
    further = list(dict.fromkeys(name for one in compared for name in one.numbers))
    rows = [
        [name, *(with_interval(one.errors[name]) if name in one.errors else "" for one in compared)] for name in columns
    ]
    rows += [[name, *(one.numbers.get(name, "") for one in compared)] for name in further]
    caption = f"Median {quantity} [{unit}] with its 95 % interval."
    table = Table(["method", *(one.name for one in compared)], rows, caption)
    names = [one.name for one in compared]
    values = {
        name: [interval(one.errors[name]) if name in one.errors else NONE for one in compared]
        for name in shown[:MAX_CURVES]
    }
    medians = [one.errors[name]["median"] for one in compared for name in values if name in one.errors]
    spread = max(medians, default=1.0) > 10 * min(medians, default=1.0) > 0
    figure = figures.dots(names, values, palette, f"median {quantity} [{unit}]", log=spread)
    caption = f"Median {quantity} of each run; whiskers: 95 % intervals."
    return table, Plot("summary", [figure], caption, figures.dots_data("run", names, values, unit.lower()))


def interval(error: ErrorSummary) -> tuple[float, float, float]:
    """Return the median and its interval."""
    return error["median"], error["low"], error["high"]


def with_interval(error: ErrorSummary) -> str:
    """Return the median and its interval as text.

    Example:
        >>> with_interval({"median": 1.0, "low": 0.5, "high": 2.0})
        '1.00 [0.50, 2.00]'
    """
    return f"{number(error['median'])} [{number(error['low'])}, {number(error['high'])}]"


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
