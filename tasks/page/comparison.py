"""Comparison of several runs on the first screen of their report: one table, one figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swiftwrf.metrics import ErrorSummary
from tasks.page import figures
from tasks.page.figures import MAX_CURVES, Palette
from tasks.page.page import Plot, Table, number

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
