"""Figures of the RSSI report: where the errors are, and differences between methods."""

from __future__ import annotations

from matplotlib.figure import Figure

from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.metrics import paired_difference
from tasks.labels import PREDICTORS as LABELS
from tasks.labels import labels
from tasks.page import figures
from tasks.page.figures import Palette
from tasks.page.page import Plot
from tasks.rssi.page.maps import MAX_VECTOR_DOTS, RssiRecords
from tasks.rssi.page.summary import best_baseline, by_method, model_of
from tasks.summarise import running_median

MAX_RECEIVERS = 40  # of the figure of differences; all are in its table


def palette() -> Palette:
    """Return the colours of the predictors."""
    return Palette.of(labels(RSSI_PREDICTORS, LABELS))


def by_rows(run: RssiRecords) -> list[Figure]:
    """Return the errors by the number of training rows, none if the rows are too few for parts of them."""
    found = run.metrics["by_rows"]
    if len(found) < 2:
        return []
    names = list(next(iter(found.values())))
    figure, axes = figures.panel(5.6, 3.2)
    lines = {name: ([int(n) for n in found], [row[name] for row in found.values()]) for name in names}
    figures.curves(axes, palette(), lines, "training rows", "mean absolute error [dB]")
    axes.set_ylim(0, None)
    return [figure]


def differences(run: RssiRecords) -> list[Plot]:
    """Return the difference of the model's error from the best baseline's at each receiver, none for one receiver."""
    if len(run.metrics["receivers"]) < 2:
        return []
    own, best, errors = model_of(run), best_baseline(run), by_method(run)
    found = {}
    for name in run.metrics["receivers"]:
        at_receiver = errors[errors.index.get_level_values("receiver") == name].dropna(subset=[own, best])
        if len(at_receiver):
            found[name] = paired_difference(at_receiver, own, best)
    names = sorted(found, key=lambda name: found[name][0])
    shown, values = names[:MAX_RECEIVERS], {own: [found[name] for name in names]}
    label = f"{own} minus {best}, mean absolute error [dB]"
    figure = figures.dots(shown, {own: values[own][: len(shown)]}, palette(), label, zero=True)
    caption = (
        f"Difference of the mean absolute error of {own} from that of {best}, the best baseline, at each receiver on "
        f"the same pairs; whiskers: 95 % intervals. Below zero {own} is better."
    )
    data = figures.dots_data("receiver", names, values, "db")
    return [Plot(f"difference-{run.file_name}", [figure], caption, data)]


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
