"""Errors of several methods at equal test rows: summaries, and differences with intervals over places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pandas import DataFrame

from swiftwrf.metrics import ErrorSummary, bootstrap_interval, summary


class ChangeMetrics(TypedDict):
    """Median error with synthetic spectra, its relative change (-0.3 is 30 % lower), and the change's 95 % interval."""

    median_deg: float
    change: float
    low: float
    high: float


def paired_change(
    before: ArrayLike, after: ArrayLike, group: ArrayLike | None = None, n: int = 2000, least_deg: float = 1e-9
) -> ChangeMetrics:
    """Return the median of `after`, its change relative to the median of `before`, and the change's 95 % interval.

    The interval is a bootstrap over groups of test rows. All errors of a group are resampled together, so that differences
    between rows do not widen it, and repeats do not narrow it.

    Args:
        before: Errors (n,) of test rows, or (n, repeats).
        after: Errors of the same rows and repeats.
        group: Group of each row, e.g. its place, (n,). Defaults to independent rows.
        n: Number of bootstrap samples. A change has long tails, so it needs more of them than a median.
        least_deg: The change is relative to at least this median.

    Example:
        >>> change = paired_change([1.0, 2.0, 3.0], [0.5, 1.0, 1.5])
        >>> change["change"], change["low"], change["high"]
        (-0.5, -0.5, -0.5)
    """
    first, second = np.asarray(before, dtype=float), np.asarray(after, dtype=float)

    def change(rows: NDArray[np.int64]) -> float:
        return float(np.median(second[rows]) / max(np.median(first[rows]), least_deg) - 1)

    every = np.arange(len(first))
    low, high = bootstrap_interval(change, every if group is None else group, n)
    return {"median_deg": float(np.median(second)), "change": change(every), "low": low, "high": high}


def paired_difference(errors: DataFrame, method: str, other: str, min_groups: int = 10) -> tuple[float, float, float]:
    """Return the mean of one method's errors minus another's on equal pairs, and its 95 % interval.

    The interval is a bootstrap over the places of test rows, or over test rows if places are unknown, because the receivers
    of one row are not independent. With few of them a bootstrap finds false differences, so the interval is nan. Without any
    pair all three are nan.

    Args:
        errors: Errors with a column for each method and a row for each pair, indexed by `index` (the test row), and
            `receiver` and `place` if they exist.
        method: Column of the method.
        other: Column of the method that it is compared to.
        min_groups: Number of places, or of test rows, from which on there is an interval.
    """
    level = "place" if "place" in errors.index.names else "index"
    found = (errors[method] - errors[other]).dropna()
    group, values = found.index.get_level_values(level), found.to_numpy()
    low = high = math.nan
    if group.nunique() >= min_groups:
        low, high = bootstrap_interval(lambda rows: float(values[rows].mean()), group)
    return float(found.mean()), low, high


def summaries(errors: DataFrame, by: str | list[str], columns: Sequence[str]) -> dict[Any, dict[str, ErrorSummary]]:
    """Return a summary of columns of errors for each value of a column, or for each combination of values of columns.

    Args:
        errors: Errors, with the test row `index`, `receiver` where a row has several errors, and `place` of the row if it is
            known. Repeats of a test row count once in `n`.
        by: Column, e.g. "method", or columns.
        columns: Columns of errors.

    Example:
        >>> errors = DataFrame({"method": ["a", "a", "b"], "index": [0, 1, 0], "place": [0, 1, 0], "m": [1.0, 3.0, 5.0]})
        >>> {name: found["m"]["median"] for name, found in summaries(errors, "method", ["m"]).items()}
        {'a': 2.0, 'b': 5.0}
    """
    keys = [name for name in ("index", "receiver") if name in errors]

    def of(part: DataFrame, column: str) -> ErrorSummary:
        found = summary(part[column], part.get("place", part["index"]))
        return {**found, "n": len(part.dropna(subset=column).drop_duplicates(keys))}

    return {name: {column: of(part, column) for column in columns} for name, part in errors.groupby(by, sort=False)}


def method_summary(errors: DataFrame, column: str, reference: str) -> DataFrame:
    """Return a summary of the errors of each method, and their mean difference to those of a reference.

    Args:
        errors: A row for each `method` and test row `index`, `receiver` where a row has several errors, and `place` of the
            row if it is known.
        column: Column of errors.
        reference: Method of the differences, which are paired over test rows.

    Returns:
        A row for each method: the keys of `ErrorSummary`, `difference` and its 95 % interval `difference_low`,
        `difference_high`.
    """
    keys = [name for name in ("index", "receiver", "place") if name in errors]
    pairs = errors.groupby([*keys, "method"])[column].mean().unstack("method")
    columns = ("difference", "difference_low", "difference_high")
    rows = {
        name: {**found[column], **dict(zip(columns, paired_difference(pairs, name, reference), strict=True))}
        for name, found in summaries(errors, "method", [column]).items()
    }
    return DataFrame.from_dict(rows, orient="index").rename_axis("method")
