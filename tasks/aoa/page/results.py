"""Errors of the conditions: tables, distributions, over measured fractions and over estimators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tasks.aoa.condition import LOCATOR, terms
from tasks.aoa.page.gains import gain_table
from tasks.aoa.page.records import FractionRecords, palette
from tasks.metrics import Angle, ErrorSummary
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.provenance import number
from tasks.page.records import notes

ERRORS: dict[Angle, str] = {
    "azimuth_deg": "azimuth",
    "elevation_deg": "elevation",
    "great_circle_deg": "great circle",
}
# median elevation and azimuth errors in degrees by measured fraction (paper, table of the AoA case study)
PAPER = {"0.1": (0.592, 1.769), "0.3": (0.5527, 1.7369), "0.5": (0.410, 1.498), "0.7": (0.370, 1.173)}
MUST_BEAT = ("peak", "constant")  # estimators that others must beat; their errors may leave the axes


def results_section(fraction: FractionRecords, several: bool) -> Section:
    """Return the errors of all conditions, their training sets, and the distributions of the errors."""
    title = f"{fraction.percent} measured" + (
        f" - {fraction.run.scene}, seed {fraction.run.metrics['seed']}" if several else ""
    )
    rows = [
        [name, *(_with_interval(method[column]) for column in ERRORS), number(method["great_circle_deg"]["p90"])]
        for name, method in fraction.mix["methods"].items()
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "great circle, 90 %"]
    strong = frozenset(name for name, condition in fraction.conditions.items() if condition.is_turbo)
    paragraphs = notes(fraction.run)
    if fraction.key in PAPER:
        elevation, azimuth = PAPER[fraction.key]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "fraction, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    table = Table(columns, rows, "Median error with its 95 % interval over the test spectra.", strong)
    parts = [[name, *(str(n) for n in counts.values())] for name, counts in fraction.mix["counts"].items()]
    origin = Table(["training set", "measured", "withheld positions", "further positions"], parts, "Spectra by origin.")
    return Section(
        title, paragraphs, [table, *gain_table(fraction), origin], [_cdf(fraction), *_turbo_cdf(fraction)], terms()
    )


def estimator_section(fraction: FractionRecords) -> Section | None:
    """Return the comparison of the estimators on held-out measured spectra; None if the run has none."""
    choice = fraction.mix.get("estimator_choice")
    if choice is None:
        return None
    held_out = sorted(choice["held_out_deg"].items(), key=lambda item: item[1])
    rows = [[name, number(error), number(fraction.medians.get(name))] for name, error in held_out]
    rows += [[name, "", number(fraction.medians[name])] for name in MUST_BEAT if name in fraction.medians]
    caption = (
        f"Median angular error over {choice['n_held_out']} held-out measured spectra, and over the test spectra, which "
        "take no part in the choice. Estimators without a held-out error are no candidates."
    )
    table = Table(["method", "held out [deg]", "test [deg]"], rows, caption, frozenset({choice["name"]}))
    return Section(f"Which estimator? ({fraction.percent} measured)", [choice_sentence(fraction)], [table])


def choice_sentence(fraction: FractionRecords) -> str:
    """Return which estimator cross-validation chose, and by which errors; empty if the run has no choice."""
    choice = fraction.mix.get("estimator_choice")
    if choice is None:
        return ""
    errors = ", ".join(f"{name} {error:.2f}" for name, error in choice["held_out_deg"].items())
    text = (
        f"Cross-validation inside the measured fraction chooses {choice['name']} (median error in degrees on "
        f"{choice['n_held_out']} held-out spectra: {errors})."
    )
    if LOCATOR not in choice["held_out_deg"]:
        text += f" {LOCATOR} is not a candidate: no compared field model found planes without the held-out spectra."
    return text


def _with_interval(summary: ErrorSummary) -> str:
    return f"{number(summary['median'])} [{number(summary['low'])}, {number(summary['high'])}]"


def _cdf(fraction: FractionRecords) -> Plot:
    table = fraction.table("errors")
    own = table[table["method"].isin(fraction.in_overviews)]
    figure, axes = figures.new_figure(1, 3, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=True):
        groups = {str(method): part[column] for method, part in own.groupby("method", sort=False)}
        shown = [float(part.quantile(0.95)) for method, part in groups.items() if method not in MUST_BEAT]
        figures.cdf(ax, fraction.palette, groups, f"{name} error [deg]", limit=max(*shown, 1e-3))
    axes[1].set_ylabel("")
    axes[2].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = (
        "Distribution of the errors; full lines are networks, dashed ones other estimators, which may leave the axes."
    )
    return Plot(f"cdf-{fraction.file_name}", figure, caption, own[["repeat", "index", "method", *ERRORS]])


def _turbo_cdf(fraction: FractionRecords) -> list[Plot]:
    """Return the paper's figure if there are several field models: the network between its references, one curve a model."""
    shown = [name for name, condition in fraction.conditions.items() if condition.is_network]
    if sum(fraction.conditions[name].is_turbo for name in shown) < 2:
        return []
    own = fraction.table("errors")
    own = own[own["method"].isin(shown)]
    figure, axes = figures.new_figure(1, 2, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=False):  # azimuth and elevation
        groups = {method: own[own["method"] == method][column] for method in shown}
        limit = max(*(float(part.quantile(0.95)) for part in groups.values()), 1e-3)
        figures.cdf(ax, fraction.palette, groups, f"{name} error [deg]", limit=limit)
    axes[1].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "The network with spectra of each synthesizer, between its references."
    return [Plot(f"turbo-{fraction.file_name}", figure, caption, own[["repeat", "index", "method", *ERRORS]])]


def over_fractions(fractions: list[FractionRecords], name: str) -> Plot:
    """Return the median error of each condition against the measured fraction."""
    conditions = {name: fraction.conditions[name] for fraction in fractions for name in fraction.in_overviews}
    labels = [fraction.percent for fraction in fractions]
    if len({fraction.run.place for fraction in fractions}) > 1:
        labels = [figures.short(f"{s.percent}\n{s.run.metrics['data']}\n{s.run.metrics['split']}") for s in fractions]
    heights = {method: [_median_and_interval(fraction, method) for fraction in fractions] for method in conditions}
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    figures.bars(axes[0], palette(conditions.values()), labels, heights, "median angular error [deg]")
    axes[0].set_yscale("log")
    figures.legend_below(figure, axes[0])
    caption = "Median error of each condition against the measured fraction; whiskers: 95 % intervals."
    return Plot(name, figure, caption, figures.bars_data("measured_fraction", labels, heights, "deg"))


def over_estimators(fraction: FractionRecords) -> Plot:
    """Return the errors of each estimator on the measured spectra, with synthetic ones, and on all spectra."""
    networks = [condition.estimator for condition in fraction.conditions.values() if condition.is_network]
    trained = {c.estimator for c in fraction.conditions.values() if c.training == "all"} - {LOCATOR}
    located = any(condition.estimator == LOCATOR for condition in fraction.conditions.values())
    estimators, heights = sorted(trained, key=lambda name: (name not in networks, name)), {}
    estimators += [*([LOCATOR] if located else []), *(name for name in MUST_BEAT if name in fraction.conditions)]
    trainings = {condition.training_set: condition for condition in fraction.conditions.values()}
    for name, condition in trainings.items():
        methods = [replace(condition, estimator=estimator).method for estimator in estimators]
        heights[name] = [_median_and_interval(fraction, method) for method in methods]
    colours = palette(replace(condition, estimator=networks[0]) for condition in trainings.values())
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    labels = [f"network ({name})" if name in networks else name.replace("_", " ") for name in estimators]
    figures.bars(axes[0], colours, labels, heights, "median angular error [deg]")
    axes[0].set_yscale("log")
    figures.legend_below(figure, axes[0])
    caption = f"Median error of each estimator on each training set, {fraction.title}; whiskers: 95 % intervals."
    return Plot("summary", figure, caption, figures.bars_data("estimator", estimators, heights, "deg"))


def _median_and_interval(fraction: FractionRecords, method: str) -> tuple[float, float, float]:
    """Return median and interval of the angular errors, nan if the run does not have the method."""
    if method not in fraction.mix["methods"]:
        return np.nan, np.nan, np.nan
    error = fraction.mix["methods"][method]["great_circle_deg"]
    return error["median"], error["low"], error["high"]
