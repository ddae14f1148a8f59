"""The statistics of tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame, Series

from swiftwrf.metrics import ErrorSummary, paired_difference, summary

MAX_COVERAGE_ERROR = 0.05  # difference from the nominal coverage below which intervals count as calibrated
MIN_RELEVANT = 0.02  # difference of mean errors, relative to them, below which methods are equal in practice
MAX_SPREAD = 0.5  # of labels about their mean direction, relative to the error of the peaks, for a warning
SHORTEST = 1e-5  # seconds: what took less is drawn here, for logarithmic axes have no zero


def summaries(table: DataFrame, by: str, columns: Sequence[str]) -> dict[str, dict[str, ErrorSummary]]:
    """Return a summary of each column over all test rows and repeats, for each value of `by`.

    Args:
        table: A row for each value of `by`, `repeat` and `index`, the test row.
        by: Column of names.
        columns: Columns of errors.
    """
    return {
        str(name): {column: repeated_summary(by_repeat(part, column)) for column in columns}
        for name, part in table.groupby(by, sort=False)
    }


def by_repeat(table: DataFrame, column: str) -> NDArray[np.float64]:
    """Return a column with a row for each test row and a column for each repeat, (n, repeats)."""
    values: NDArray[np.float64] = table.pivot(index="index", columns="repeat", values=column).to_numpy(np.float64)
    return values


def repeated_summary(values: NDArray[np.float64]) -> ErrorSummary:
    """Return the summary of all values (n, repeats), with the number of test rows.

    Repeats of a test row are not independent, so they do not narrow the interval of the median as independent values would
    (quantiles in cluster samples: R. S. Woodruff, JASA 47, 1952).

    Example:
        >>> once = np.arange(100.0)[:, None]
        >>> found = repeated_summary(np.repeat(once, 3, axis=1))
        >>> found["median"], found["n"], (found["low"], found["high"])
        (49.5, 100, (40.0, 59.0))
    """
    found = summary(values.ravel())
    rows = values[np.isfinite(values).any(axis=1)]
    if values.shape[1] > 1 and len(rows):
        below = np.nanmean(np.where(np.isnan(rows), np.nan, rows <= found["median"]), axis=1)
        margin = 1.96 * below.std() / math.sqrt(len(rows))
        low, high = np.nanquantile(rows, (max(0.0, 0.5 - margin), min(1.0, 0.5 + margin))).tolist()
        found = {**found, "low": low, "high": high}
    return {**found, "n": len(rows)}


def averaged(table: DataFrame, by: str, columns: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each column for each value of `by`."""
    means: dict[str, dict[str, float]] = table.groupby(by, sort=False)[list(columns)].mean().to_dict("index")
    return means


def comparison_sentence(
    errors: DataFrame, method: str, other: str, *, name: str, unit: str, rows: str, n_test: int
) -> str:
    """Return one sentence that compares the mean errors of two methods.

    Args:
        errors: As in `paired_difference`.
        method: Method that the sentence is about.
        other: Method it is compared with.
        name: Name of the first method in the sentence.
        unit: Unit of the errors.
        rows: Word for the rows of the errors, e.g. pairs.
        n_test: Number of test rows.
    """
    mean, low, high = paired_difference(errors, method, other)
    if math.isnan(low):
        return f"{n_test} test rows are too few to compare {name} with {other}."
    interval = f"{mean:+.2f} {unit} [{low:+.2f}, {high:+.2f}]"
    if max(abs(low), abs(high)) < MIN_RELEVANT * float(errors[other].mean()):
        return f"On the same {rows} {name} and {other} are equal in practice: mean errors differ by {interval}."
    if high < 0:
        return f"On the same {rows} {name}'s mean error is lower than that of {other}: {interval}."
    if low > 0:
        return (
            f"On the same {rows} {other} has the lower mean error: {name}'s differs by {interval}. {other} is the best of "
            "several on these rows, which favours it."
        )
    return f"On the same {rows} the errors of {name} and {other} do not differ significantly: {interval}."


def coverage_warning(name: str, coverage: float, nominal: float, n_test: int) -> str:
    """Return a warning if intervals or regions cover significantly more or less than they should, else nothing.

    Args:
        name: Name of the intervals in the sentence.
        coverage: Fraction of the test values that they contain.
        nominal: Probability that they are made for.
        n_test: Number of independent test rows.

    Example:
        >>> coverage_warning("intervals", 0.87, 0.8, n_test=100)
        ''
        >>> coverage_warning("intervals", 0.6, 0.8, n_test=100)
        'The 80 % intervals contain 60 % of the test values: they are too narrow here.'
    """
    two_deviations = 2 * math.sqrt(nominal * (1 - nominal) / n_test)
    if abs(coverage - nominal) <= max(MAX_COVERAGE_ERROR, two_deviations):
        return ""
    size = "narrow" if coverage < nominal else "wide"
    return (
        f"The {100 * nominal:.0f} % {name} contain {100 * coverage:.0f} % of the test values: they are too {size} here."
    )


def fingerprinting(constant_deg: float, peak_deg: float) -> str:
    """Return a warning if spectra are labels of positions rather than of directions, else nothing.

    Args:
        constant_deg: Median error of the mean direction of the labels [deg], their spread.
        peak_deg: Median error of the strongest direction [deg].

    Example:
        >>> fingerprinting(26.0, 2.4)
        ''
    """
    if not constant_deg < MAX_SPREAD * peak_deg:
        return ""
    return (
        f"This is fingerprinting along a path rather than estimation of angles: directions lie within {constant_deg:.1f} "
        f"degrees of their mean (median), and peaks are {peak_deg:.0f} degrees off."
    )


def running_median(values: Series) -> Series:
    """Median of the values around each, in a window of a fifth of them."""
    return values.rolling(max(len(values) // 5, 1), center=True).median()


def rms_of_psnr(psnr_db: float) -> float:
    """Root of the mean square error of a spectrum with this PSNR."""
    return float(10 ** (-psnr_db / 20))


def pareto(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points (cost, error) that no other one beats or equals in both, by cost."""
    front: list[str] = []
    for name in sorted(points, key=lambda name: points[name]):
        if not front or points[name][1] < points[front[-1]][1]:
            front.append(name)
    return front
