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


Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Function of the numbers of times (samples, groups) that samples contain each group; it returns a value for each sample."""
MAX_DRAWN = 2**22  # groups of samples that are held at once


def group_numbers(group: ArrayLike) -> NDArray[np.int64]:
    """Return the number (rows,) of the group of each row, from its names, places or numbers (rows,) or (rows, k).

    Example:
        >>> group_numbers(["b", "a", "b"]).tolist()
        [1, 0, 1]
    """
    return np.asarray(np.unique(np.asarray(group), return_inverse=True, axis=0)[1])


def resampled_median(values: ArrayLike, number: NDArray[np.int64]) -> Statistic:
    """Return the median of values (rows,) or (rows, k) as a statistic of groups, whose numbers are those of the rows.

    The search is in two steps, first over blocks of ordered values, so that a sample takes the square root of their number.

    Example:
        >>> resampled_median([3.0, 1.0, 2.0], np.array([0, 0, 1]))(np.array([[1.0, 1.0], [1.0, 3.0]])).tolist()
        [2.0, 2.0]
    """
    array = np.asarray(values, dtype=float)
    order = np.argsort(array, axis=None)
    ordered, of_value = array.ravel()[order], number[order // (array.size // len(array))]
    n_groups, size = int(number.max()) + 1, math.isqrt(len(ordered) - 1) + 1
    filled = np.full(size * -(-len(ordered) // size), n_groups)  # filled up with a group that no sample contains
    filled[: len(ordered)] = of_value
    blocks = filled.reshape(-1, size)
    at = blocks + (n_groups + 1) * np.arange(len(blocks))[:, None]
    in_block = np.bincount(at.ravel(), minlength=len(blocks) * (n_groups + 1)).reshape(len(blocks), -1)[:, :-1]

    def of(times: NDArray[np.float64]) -> NDArray[np.float64]:
        up_to = (times @ in_block.T).cumsum(axis=1)  # values of a sample up to the end of each block
        padded, n = np.pad(times, ((0, 0), (0, 1))), up_to[:, -1]

        def value(rank: NDArray[np.float64]) -> NDArray[np.float64]:
            block = (up_to <= rank[:, None]).sum(axis=1)
            before = np.take_along_axis(np.pad(up_to, ((0, 0), (1, 0))), block[:, None], axis=1)
            within = before + np.take_along_axis(padded, blocks[block], axis=1).cumsum(axis=1)
            found: NDArray[np.float64] = ordered[block * size + (within <= rank[:, None]).sum(axis=1)]
            return found

        return (value((n - 1) // 2) + value(n // 2)) / 2

    return of


def bootstrap_interval(statistic: Statistic, number: NDArray[np.int64], n: int = 1000) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of rows, by a bootstrap over groups of rows that are not independent.

    Args:
        statistic: Function of the numbers of times (samples, groups) that samples contain each group, e.g.
            `resampled_median`.
        number: Number of the group of each row, (rows,); see `group_numbers`.
        n: Number of bootstrap samples.

    Example:
        >>> error, place = np.array([1.0, 1.0, 1.0, 4.0, 4.0, 4.0]), np.array([0, 0, 0, 1, 1, 1])
        >>> bootstrap_interval(resampled_median(error, place), place)
        (1.0, 4.0)
    """
    n_groups, draw, values = int(number.max()) + 1, np.random.default_rng(0), []
    batch = max(1, MAX_DRAWN // n_groups)
    for start in range(0, n, batch):
        size = min(batch, n - start)
        drawn = draw.integers(n_groups, size=(size, n_groups)) + n_groups * np.arange(size)[:, None]
        times = np.bincount(drawn.ravel(), minlength=size * n_groups).reshape(size, n_groups)
        values.append(statistic(times.astype(float)))
    low, high = np.percentile(np.concatenate(values), (2.5, 97.5)).tolist()
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
    if group is not None and (n_groups := int((number := group_numbers(group)).max()) + 1) < len(values):
        low, high = float(values.min()), float(values.max())
        if n_groups > 1:
            low, high = bootstrap_interval(resampled_median(values, number), number)
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

    def change(medians: NDArray[np.float64]) -> Any:
        return medians[1] / np.maximum(medians[0], least_deg) - 1

    number = np.arange(len(first)) if group is None else group_numbers(group)
    both = [resampled_median(errors, number) for errors in (first, second)]
    low, high = bootstrap_interval(lambda times: change(np.stack([of(times) for of in both])), number, n)
    medians = np.array([np.median(first), np.median(second)])
    return {"median_deg": float(medians[1]), "change": float(change(medians)), "low": low, "high": high}


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
    number = group_numbers(found.index.get_level_values(level))
    low = high = math.nan
    if len(found) and number.max() + 1 >= min_groups:
        rows, total = np.bincount(number), np.bincount(number, weights=found)
        low, high = bootstrap_interval(lambda times: times @ total / (times @ rows), number)
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
