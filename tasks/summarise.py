"""The statistics of tables and figures."""

from __future__ import annotations

import math

from pandas import DataFrame

from swiftwrf.metrics import paired_difference

MAX_COVERAGE_ERROR = 0.05  # difference from the nominal coverage below which intervals count as calibrated
MIN_RELEVANT = 0.02  # difference of mean errors, relative to them, below which methods are equal in practice
MAX_SPREAD = 0.5  # of labels about their mean direction, relative to the error of the peaks, for a warning


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
