"""Errors of the RSSI report: tables, differences between methods, distributions, places, seconds."""

from __future__ import annotations

import math
from typing import Any

from pandas import DataFrame

from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.metrics import paired_difference
from tasks.labels import PREDICTORS as LABELS
from tasks.labels import labels
from tasks.page import figures
from tasks.page.figures import Palette
from tasks.page.page import Plot, Table, number
from tasks.page.shared import with_interval
from tasks.rssi.page.maps import MAX_VECTOR_DOTS, RssiRecords
from tasks.rssi.page.summary import best_baseline, by_method, model_of, title
from tasks.summarise import SHORTEST, running_median

MAX_RECEIVERS = 40  # of the figure of differences; all are in its table


def palette() -> Palette:
    """Return the colours of the predictors."""
    return Palette.of(labels(RSSI_PREDICTORS, LABELS))


def table(run: RssiRecords) -> Table:
    """Return the errors of all methods, and the differences of the run's model from them."""
    errors, rows, own = by_method(run), [], model_of(run)
    scored = any(entry.get("detection") for entry in run.metrics["overall"].values())
    for name, entry in sorted(run.metrics["overall"].items(), key=lambda item: item[1]["abs_error_db"]["median"]):
        error, difference = entry["abs_error_db"], ""
        if name != own:
            mean, low, high = paired_difference(errors, own, name)
            difference = f"{mean:+.2f}" + ("" if math.isnan(low) else f" [{low:+.2f}, {high:+.2f}]")
        detection = entry.get("detection")
        right = [number(None if detection is None else sum(detection) / 2)] if scored else []
        rows.append([name, with_interval(error), number(error["mean"]), number(error["p90"]), *right, difference])
    columns = [
        "method",
        "median [dB]",
        "mean [dB]",
        "90 % [dB]",
        *["detection"] * scored,
        f"{title(run)} minus method [dB]",
    ]
    caption = (
        "Absolute error over all detected test pairs; median with its 95 % interval. Last column: mean difference of the "
        "absolute errors on the same pairs; 95 % bootstrap over test rows."
    ) + (
        " Detection: mean of the shares of detected and of empty test cells that are predicted as such; 0.5 is chance."
        if scored
        else ""
    )
    return Table(columns, rows, caption, frozenset([own]))


def differences(run: RssiRecords) -> Plot:
    """Return the difference of the model's error from the best baseline's at each receiver, sorted."""
    own, best, errors = model_of(run), best_baseline(run), by_method(run)
    found = {}
    for name in run.metrics["receivers"]:
        at_receiver = errors[errors.index.get_level_values("receiver") == name].dropna(subset=[own, best])
        if len(at_receiver):
            found[name] = paired_difference(at_receiver, own, best)
    names = sorted(found, key=lambda name: found[name][0])
    shown, values = names[:MAX_RECEIVERS], {own: [found[name] for name in names]}
    label = f"{title(run)} minus {best}, mean absolute error [dB]"
    figure = figures.dots(shown, {own: values[own][: len(shown)]}, palette(), label, zero=True)
    caption = (
        f"Difference of the mean absolute error of {title(run)} from that of {best}, the best baseline, at each receiver on "
        f"the same pairs; whiskers: 95 % intervals. Left of zero {title(run)} is better."
    )
    return Plot(f"difference-{run.file_name}", [figure], caption, figures.dots_data("receiver", names, values, "db"))


def distribution(run: RssiRecords) -> Plot:
    """Return the distribution of the errors of the model, the best baseline, one path-loss model, and the mean."""
    table = run.table("errors")
    shown = [
        name
        for name in dict.fromkeys((model_of(run), best_baseline(run), "mri_pooled", "mean"))
        if name in set(table["method"])
    ]
    figure, axes = figures.panel(5.8, 3.4)
    groups = {name: table[table["method"] == name]["abs_error_db"] for name in shown}
    figures.cdf(axes, palette(), groups, "absolute error [dB]", float(table["abs_error_db"].quantile(0.98)))
    axes.set_ylabel("fraction of test pairs")
    pairs = table[["receiver", "index", "method", "abs_error_db"]]
    return Plot(f"cdf-{run.file_name}", [figure], "Distribution of the absolute errors over all receivers.", pairs)


def where(run: RssiRecords) -> Plot:
    """Return predicted against measured RSSI, and the error against distances."""
    errors = run.table("errors")
    own = errors[errors["method"] == model_of(run)]
    colour, many = palette().colour(model_of(run)), len(own) >= MAX_VECTOR_DOTS
    columns = {
        "from_receiver_m": "distance from the receiver [m]",
        "from_training_m": "distance from training positions [m]",
    }
    columns = {column: label for column, label in columns.items() if own[column].notna().any()}
    first, ax = figures.panel(4, 3.4)
    ax.plot(own["measured_dbm"], own["predicted_dbm"], ".", markersize=2, color=colour, rasterized=many)
    ends = [own["measured_dbm"].min(), own["measured_dbm"].max()]
    ax.plot(ends, ends, color=figures.RULE, linewidth=1)
    ax.set(xlabel="measured [dBm]", ylabel="predicted [dBm]")
    panels = [first]
    for column, label in columns.items():
        panel, ax = figures.panel(4, 3.4)
        ordered = own.sort_values(column)
        ax.plot(ordered[column], ordered["abs_error_db"], ".", markersize=2, color=figures.RULE, rasterized=many)
        ax.plot(ordered[column], running_median(ordered["abs_error_db"]), color=colour, linewidth=2)
        ax.set(xlabel=label, ylabel="absolute error [dB]")
        panels.append(panel)
    caption = (
        "Predicted against measured RSSI, and the absolute error (dots; line: running median) against the distance from the "
        "receiver, if its position is known, and from the nearest training position. All receivers."
    )
    data = own[["receiver", "index", "measured_dbm", "predicted_dbm", "abs_error_db", *columns]]
    return Plot(f"where-{run.file_name}", panels, caption, data)


def speed(run: RssiRecords) -> Plot:
    """Return the error against the seconds to fit and to predict."""
    overall = run.metrics["overall"]
    error = {name: entry["abs_error_db"]["median"] for name, entry in overall.items()}
    seconds: dict[str, dict[str, Any]] = {
        stage: {name: max(entry["seconds"][stage], SHORTEST) for name, entry in overall.items()}
        for stage in ("fit", "predict")
    }
    panels = []
    for stage, each in seconds.items():
        panel, ax = figures.panel(5, 3.6)
        points = {name: (each[name], error[name]) for name in overall}
        figures.speed(ax, palette(), points, f"seconds to {stage}", "median absolute error [dB]", also=[*overall])
        panels.append(panel)
    caption = "Seconds to fit and to predict the test rows against the median error. The line is the Pareto front."
    columns = {"fit_s": seconds["fit"], "predict_s": seconds["predict"], "median_abs_error_db": error}
    data = DataFrame(columns).rename_axis("method").reset_index()
    return Plot(f"speed-{run.file_name}", panels, caption, data)
