"""Errors of the conditions: tables, distributions, the choice of the estimator."""

from __future__ import annotations

from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK
from augment.turbo.results import Angle
from swiftwrf.metrics import ChangeMetrics
from tasks.aoa.page.overview import BASELINES
from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.figures import MAX_CURVES
from tasks.page.page import Plot, Section, Table, number
from tasks.page.records import notes
from tasks.page.shared import with_interval

ERRORS: dict[Angle, str] = {
    "azimuth_deg": "azimuth",
    "elevation_deg": "elevation",
    "great_circle_deg": "angle",
}
# median elevation and azimuth errors in degrees by measured fraction (paper, table of the AoA case study)
PAPER = {"0.1": (0.592, 1.769), "0.3": (0.5527, 1.7369), "0.5": (0.410, 1.498), "0.7": (0.370, 1.173)}


def results_section(fraction: FractionRecords) -> Section:
    """Return the errors of all conditions, their training sets, and the distributions of the errors."""
    methods = sorted(fraction.mix["methods"].items(), key=lambda item: item[1]["great_circle_deg"]["median"])
    rows = [
        [
            name,
            *(with_interval(method[column]) for column in ERRORS),
            number(method["great_circle_deg"]["p90"]),
            fraction.conditions[name].training if name in fraction.conditions else "",
        ]
        for name, method in methods
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "angle, 90 %", "training spectra"]
    paragraphs = notes(fraction.run)
    if fraction.key in PAPER:
        elevation, azimuth = PAPER[fraction.key]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "fraction, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    count = fraction.run.metrics["repeats"]
    repeats = f" and {count} repeats" if count > 1 else ""
    caption = (
        f"Median error over the test spectra{repeats}, with its 95 % interval. `peak` and `constant` need no training: "
        "others must beat them. Near the zenith azimuth errors are large without meaning; the angle is the angular error."
    )
    table = Table(columns, rows, caption, frozenset(BASELINES))
    parts = [[name, *(str(n) for n in counts.values())] for name, counts in fraction.mix["counts"].items()]
    origin = Table(["training set", "measured", "withheld positions", "extra positions"], parts, "Spectra by origin.")
    part = estimator_section(fraction)
    return Section(
        "", paragraphs, [table, *gain_table(fraction), origin], [_cdf(fraction)], parts=[part] if part else []
    )


def estimator_section(fraction: FractionRecords) -> Section | None:
    """Return the comparison of the estimators on held-out measured spectra; None if the run has none."""
    choice = fraction.mix["estimator_choice"]
    if choice is None:
        return None
    held_out = sorted(choice["held_out_deg"].items(), key=lambda item: item[1])
    rows = [[name, number(error), number(fraction.medians.get(name))] for name, error in held_out]
    others = [name for name in BASELINES if name in fraction.medians and name not in choice["held_out_deg"]]
    rows += [[name, "", number(fraction.medians[name])] for name in others]
    caption = (
        f"Median angular error over {choice['n_held_out']} held-out measured spectra, and over the test spectra, which "
        "take no part in the choice. Estimators without a held-out error are no candidates."
    )
    table = Table(["method", "held out [deg]", "test [deg]"], rows, caption, frozenset({choice["name"]}))
    return Section("Which estimator?", [choice_sentence(fraction)], [table])


def choice_sentence(fraction: FractionRecords) -> str:
    """Return which estimator cross-validation chose, and by which errors; empty if the run has no choice."""
    choice = fraction.mix["estimator_choice"]
    if choice is None:
        return ""
    errors = ", ".join(f"{name} {error:.2f}" for name, error in choice["held_out_deg"].items())
    text = (
        f"Cross-validation inside the measured fraction chooses {choice['name']} (median error in degrees on "
        f"{choice['n_held_out']} held-out spectra: {errors})."
    )
    if LOCATED not in choice["held_out_deg"]:
        text += f" {LOCATED} is not a candidate: no planes were found without the held-out spectra."
    return text


def _cdf(fraction: FractionRecords) -> Plot:
    """Return the distributions of the errors of the baseline, the best one on measured spectra, and the networks."""
    table = fraction.table("errors")
    wanted = ("peak", fraction.mix["reference"], fraction.turbo_method, LOCATED, FULL_NETWORK)
    names = [name for name in dict.fromkeys(wanted) if name in fraction.mix["methods"]][:MAX_CURVES]
    panels = []
    for column, name in ERRORS.items():
        figure, ax = figures.panel(4.6, 3.2)
        groups = {method: table[table["method"] == method][column] for method in names}
        limit = max(float(part.quantile(0.9)) for part in groups.values())
        figures.cdf(ax, fraction.palette, groups, f"{name} error [deg]", limit=max(limit, 1e-3))
        panels.append(figure)
    caption = "Distribution of the errors on the test spectra; the thin line is at the median."
    return Plot(f"cdf-{fraction.file_name}", panels, caption, table[["repeat", "index", "method", *ERRORS]])


def turbo_distribution(fraction: FractionRecords) -> list[Plot]:
    """Return the figures of the paper if there are several field models: the network with spectra of each, in panels."""
    shown = [name for name, condition in fraction.conditions.items() if condition.is_network]
    turbo = [name for name in shown if fraction.conditions[name].is_turbo]
    if len(turbo) < 2:
        return []
    own = fraction.table("errors")
    own = own[own["method"].isin(shown)]
    panels = []
    for start in range(0, len(turbo), MAX_CURVES - 2):
        names = [MEASURED_NETWORK, *turbo[start : start + MAX_CURVES - 2], FULL_NETWORK]
        groups = {name: own[own["method"] == name]["great_circle_deg"] for name in names if name in shown}
        figure, ax = figures.panel(5, 3.4)
        limit = max(*(float(part.quantile(0.95)) for part in groups.values()), 1e-3)
        figures.cdf(ax, fraction.palette, groups, "angular error [deg]", limit=limit)
        panels.append(figure)
    caption = "The network with spectra of each field model, between its references."
    return [Plot(f"turbo-{fraction.file_name}", panels, caption, own[["repeat", "index", "method", *ERRORS]])]


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
    method = fraction.turbo_method
    best = fraction.mix["reference"]
    parts = [
        f"{change_text(change)} against {other}"
        f"{', the best one without synthetic spectra' if other == best else ''} ({judgement(change)})"
        for other, change in fraction.mix["methods"][method]["changes"].items()
    ]
    return (
        f"Synthetic spectra change the median angular error of {fraction.learner} ({method}) by {' and '.join(parts)}. "
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
