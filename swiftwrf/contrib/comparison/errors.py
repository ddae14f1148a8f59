"""Summaries of errors, and of differences between methods at equal test rows, with intervals over places."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pandas import DataFrame
from scipy import stats


def median_interval(values: ArrayLike) -> tuple[float, float]:
    """Return the 95 % confidence interval of the median of independent values (n,), from order statistics.

    With too few values for the confidence it is their range, without values nan.

    Example:
        >>> median_interval(range(100))
        (39.0, 60.0)
    """
    ordered = np.sort(np.asarray(values, dtype=float))
    n = len(ordered)
    if n == 0:
        return float("nan"), float("nan")
    low = max(int(stats.binom.ppf(0.025, n, 0.5)) - 1, 0)
    return float(ordered[low]), float(ordered[n - 1 - low])


class ErrorSummary(TypedDict):
    """Summary of `n` errors or scores; `low` and `high` are the 95 % interval of the median."""

    median: float
    p90: float
    mean: float
    low: float
    high: float
    n: int


def bootstrap_interval(
    statistic: Callable[[NDArray[np.int64]], float], group: ArrayLike, n: int = 1000
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of rows, by a bootstrap over groups of rows that are not independent.

    Args:
        statistic: Function of row numbers (k,), ascending, which may repeat.
        group: Group of each row, e.g. its place, (rows,) or (rows, k).
        n: Number of bootstrap samples.

    Example:
        >>> error, place = np.array([1.0, 1.0, 1.0, 4.0, 4.0, 4.0]), [0, 0, 0, 1, 1, 1]
        >>> bootstrap_interval(lambda rows: float(np.median(error[rows])), place)
        (1.0, 4.0)
    """
    number = np.unique(np.asarray(group), return_inverse=True, axis=0)[1]
    n_groups, draw, values = int(number.max()) + 1, np.random.default_rng(0), []
    for _ in range(n):
        times = np.bincount(draw.integers(n_groups, size=n_groups), minlength=n_groups)
        values.append(statistic(np.repeat(np.arange(len(number)), times[number])))
    low, high = np.percentile(values, (2.5, 97.5)).tolist()
    return low, high


def summary(errors: ArrayLike, group: ArrayLike | None = None) -> ErrorSummary:
    """Return `median`, `p90`, `mean`, `n` and the 95 % interval of the median (`low`, `high`) of finite errors (n,).

    Args:
        errors: Errors (n,).
        group: Group of each error, e.g. its place, (n,) or (n, k). Errors of one group are not independent, so the interval
            is a bootstrap over groups, and that of a single group the range of its errors. Defaults to independent errors.

    Example:
        >>> found = summary([1.0, 2.0, 3.0, float("nan")])
        >>> found["median"], found["n"]
        (2.0, 3)
    """
    values = np.asarray(errors, dtype=float)
    finite = np.isfinite(values)
    values = values[finite]
    if len(values) == 0:
        nan = float("nan")
        return ErrorSummary(median=nan, p90=nan, mean=nan, low=nan, high=nan, n=0)
    low, high = median_interval(values)
    group = None if group is None else np.asarray(group)[finite]
    if group is not None and (n_groups := len(np.unique(group, axis=0))) < len(values):
        low, high = float(values.min()), float(values.max())
        if n_groups > 1:
            low, high = bootstrap_interval(lambda rows: float(np.median(values[rows])), group)
    return {
        "median": float(np.median(values)),
        "p90": float(np.percentile(values, 90)),
        "mean": float(values.mean()),
        "low": low,
        "high": high,
        "n": len(values),
    }


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
