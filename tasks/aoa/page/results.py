"""Errors of the arms: tables, distributions, over shares and over estimators."""

from __future__ import annotations

import numpy as np

from augment import SYNTHESIZERS
from tasks.aoa import arms
from tasks.aoa.estimators import learners
from tasks.aoa.share import Share
from tasks.metrics import Angle, ErrorSummary
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.provenance import number

ERRORS: dict[Angle, str] = {
    "azimuth_deg": "azimuth",
    "elevation_deg": "elevation",
    "great_circle_deg": "great circle",
}
# median elevation and azimuth errors in degrees by measured share (paper, table of the AoA case study)
PAPER = {"0.1": (0.592, 1.769), "0.3": (0.5527, 1.7369), "0.5": (0.410, 1.498), "0.7": (0.370, 1.173)}
OFF_SCALE = ("peak", "constant")  # so far off, as a rule, that they would hide the differences of the others


def results_section(share: Share, several: bool) -> Section:
    """Errors of all arms of a share, the training sets behind them, and their distributions."""
    title = f"{share.percent} measured" + (f" - {share.run.scene}, seed {share.run.metrics['seed']}" if several else "")
    rows = [
        [name, *(_with_interval(arm[column]) for column in ERRORS), number(arm["great_circle_deg"]["p90"])]
        for name, arm in share.mix["methods"].items()
    ]
    columns = ["method", *(f"{name} [deg]" for name in ERRORS.values()), "great circle, 90 %"]
    strong = frozenset(name for name in share.mix["methods"] if arms.is_turbo(name))
    paragraphs = []
    if share.key in PAPER:
        elevation, azimuth = PAPER[share.key]
        paragraphs.append(
            f"For orientation: the paper reports medians of {elevation} (elevation) and {azimuth} degrees (azimuth) at this "
            "share, on its own 6,123 spectra and an unnamed split; the numbers are not comparable with these."
        )
    table = Table(columns, rows, "Median error with its 95 % interval over the test spectra.", strong)
    parts = [[name, *(str(n) for n in counts.values())] for name, counts in share.mix["counts"].items()]
    origin = Table(["training set", "measured", "withheld positions", "further positions"], parts, "Spectra by origin.")
    return Section(title, paragraphs, [table, origin], [_cdf(share), *_turbo_cdf(share)], arms.terms())


def _with_interval(summary: ErrorSummary) -> str:
    return f"{number(summary['median'])} [{number(summary['low'])}, {number(summary['high'])}]"


def _cdf(share: Share) -> Plot:
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    own = own[
        [arms.is_network(name) or name in arms.baselines() for name in own["method"]]
    ]  # more would hide each other
    figure, axes = figures.new_figure(1, 3, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=True):
        groups = {str(method): part[column] for method, part in own.groupby("method", sort=False)}
        shown = [float(part.quantile(0.95)) for method, part in groups.items() if method not in OFF_SCALE]
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=max(*shown, 1e-3))
    axes[1].set_ylabel("")
    axes[2].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "Distribution of the errors; full lines are networks, dashed ones baselines, which may leave the axes."
    return Plot(f"cdf-{share.file_name}", figure, caption, own[["repeat", "index", "method", *ERRORS]])


def _turbo_cdf(share: Share) -> list[Plot]:
    """The paper's figure: the network between its bounds, one curve a synthesizer, where there are several."""
    turbo = [name for name in share.mix["methods"] if name in map(arms.turbo, SYNTHESIZERS)]
    if len(turbo) < 2:
        return []
    table = share.run.table("errors")
    own = table[table["mix"] == float(share.key)]
    figure, axes = figures.new_figure(1, 2, 12, 3.8)
    for ax, (column, name) in zip(axes, ERRORS.items(), strict=False):  # azimuth and elevation
        groups = {arm: own[own["method"] == arm][column] for arm in (arms.LOWER.name, *turbo, arms.UPPER.name)}
        limit = max(*(float(part.quantile(0.95)) for part in groups.values()), 1e-3)
        figures.cdf(ax, arms.palette(), groups, f"{name} error [deg]", limit=limit)
    axes[1].set_ylabel("")
    figures.legend_below(figure, axes[0])
    caption = "The network with spectra of each synthesizer at the withheld positions, between its bounds."
    shown = own[own["method"].isin([arms.LOWER.name, *turbo, arms.UPPER.name])]
    return [Plot(f"turbo-{share.file_name}", figure, caption, shown[["repeat", "index", "method", *ERRORS]])]


def over_shares(shares: list[Share], name: str) -> Plot:
    """Median error of each arm against the measured share."""
    every = (arm for share in shares for arm in share.mix["methods"])
    names = dict.fromkeys(
        arm for arm in every if arm not in OFF_SCALE and (arms.is_network(arm) or arm in arms.baselines())
    )
    labels = [share.percent for share in shares]
    if len({share.run.place for share in shares}) > 1:
        labels = [figures.short(f"{s.percent}\n{s.run.metrics['data']}\n{s.run.metrics['split']}") for s in shares]
    heights = {arm: [_median_and_interval(share, arm) for share in shares] for arm in names}
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    figures.bars(axes[0], arms.palette(), labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    caption = "Median error of each arm against the measured share; whiskers: 95 % intervals."
    return Plot(name, figure, caption, figures.bars_data("share", labels, heights, "deg"))


def over_estimators(share: Share) -> Plot:
    """Of one share: each estimator on the measured spectra, with the synthetic ones, on everything."""
    trainings = dict.fromkeys(map(arms.training_of, share.mix["methods"]))
    estimators = [arms.NETWORK, *(name for name in learners() if name != arms.NETWORK)]
    heights = {
        training: [_median_and_interval(share, arms.arm(estimator, training)) for estimator in estimators]
        for training in trainings
    }
    figure, axes = figures.new_figure(1, 1, 7.2, 4)
    labels = [f"network ({name})" if name == arms.NETWORK else name.replace("_", " ") for name in estimators]
    figures.bars(axes[0], arms.palette(), labels, heights, "median great-circle error [deg]")
    figures.legend_below(figure, axes[0])
    caption = f"Median error of each estimator on each training set, {share.title}; whiskers: 95 % intervals."
    return Plot("summary", figure, caption, figures.bars_data("estimator", estimators, heights, "deg"))


def _median_and_interval(share: Share, arm: str) -> tuple[float, float, float]:
    """Of the great-circle errors; nan where the run has no such arm."""
    if arm not in share.mix["methods"]:
        return np.nan, np.nan, np.nan
    error = share.mix["methods"][arm]["great_circle_deg"]
    return error["median"], error["low"], error["high"]
