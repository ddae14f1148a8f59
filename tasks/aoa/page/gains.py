"""Gains by synthetic spectra, with intervals that are paired over test positions."""

from __future__ import annotations

from augment.turbo.condition import headline
from swiftwrf.metrics import ChangeMetrics
from tasks.aoa.page.records import FractionRecords
from tasks.page.page import Table
from tasks.page.provenance import number


def turbo_method(fraction: FractionRecords) -> str:
    """Return the method of the network, or of kernel regression without one, with all spectra of the first field model."""
    return headline(fraction.conditions.values()).method


def learner(fraction: FractionRecords) -> str:
    """Return the estimator of `turbo_method` in words."""
    condition = headline(fraction.conditions.values())
    return "the network" if condition.is_network else condition.estimator


def change_text(change: ChangeMetrics) -> str:
    """Return a change with its 95 % interval.

    Example:
        >>> change_text({"median_deg": 1.0, "change": -0.49, "low": -0.6, "high": -0.3})
        '-49% [-60%, -30%]'
    """
    return f"{change['change']:+.0%} [{change['low']:+.0%}, {change['high']:+.0%}]"


def judgement(change: ChangeMetrics) -> str:
    """Return whether a change is a gain, a loss or not significant, by its interval.

    Example:
        >>> judgement({"median_deg": 1.0, "change": -0.17, "low": -0.4, "high": 0.1})
        'not significant'
    """
    if change["high"] < 0:
        return "a gain"
    return "a loss" if change["low"] > 0 else "not significant"


def gain_sentence(fraction: FractionRecords) -> str:
    """Return the change of the network's error by synthetic spectra, and whether it is significant."""
    method = turbo_method(fraction)
    best = fraction.mix["reference"]
    parts = [
        f"{change_text(change)} against {other}"
        f"{', the best one without synthetic spectra' if other == best else ''} ({judgement(change)})"
        for other, change in fraction.mix["methods"][method]["changes"].items()
    ]
    return (
        f"Synthetic spectra change the median angular error of {learner(fraction)} ({method}) by {' and '.join(parts)}. "
        "Intervals are paired over the test positions."
    )


def gain_table(fraction: FractionRecords) -> list[Table]:
    """Return the changes of all methods with synthetic spectra."""
    best = fraction.mix["reference"]
    rows = []
    for method in fraction.mix["methods"]:
        for other, change in fraction.mix["methods"][method]["changes"].items():
            name = f"{other} (best)" if other == best else other
            rows.append([method, name, number(change["median_deg"]), change_text(change), judgement(change)])
    caption = (
        "Change of the median angular error by synthetic spectra, with its 95 % interval: a paired bootstrap over the test "
        "positions. Medians are over all test spectra and repeats. Best: the smallest test error of all estimators without "
        "synthetic spectra other than matched_field."
    )
    columns = ["method", "compared to", "median [deg]", "change", ""]
    return [Table(columns, rows, caption)] if rows else []
