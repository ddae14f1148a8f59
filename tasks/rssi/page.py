"""The report of RSSI runs, one or several."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from tasks.metrics import RssiMetrics
from tasks.page import figures
from tasks.page.page import Page, Plot, Section, Table
from tasks.page.palette import Palette
from tasks.page.provenance import number, provenance
from tasks.page.records import Records
from tasks.rssi.predictors import PREDICTORS
from tasks.summarise import SHORTEST, paired_difference, running_median

RssiRecords = Records[RssiMetrics]
OWN = "swiftwrf"  # the predictor that all others are compared with
MANY = (
    300  # dots, from which on white edges would hide their colours, and each drawn by itself makes a page of megabytes
)


def palette() -> Palette:
    """Of the predictors; the mean, which uses no position, is dashed."""
    return Palette.of(PREDICTORS.entries(), dashed=["mean"])


def page(runs: list[RssiRecords]) -> Page:
    """The page of these runs."""
    sections = [section for run in runs for section in _run(run, several=len(runs) > 1)]
    names = ", ".join(dict.fromkeys(_place(run) for run in runs))
    return Page(f"RSSI: {names}", _lead(runs[0]), [*sections, _limits(runs[0]), provenance(runs)])


def _scene(run: RssiRecords) -> str:
    return _place(run) + run.label


def _place(run: RssiRecords) -> str:
    name = "the simulated floor" if run.metrics["data"] == "simulated-room" else run.metrics["data"]
    return f"{name}, {run.metrics['split']} split"


def _lead(run: RssiRecords) -> str:
    error = {name: entry["abs_error_db"] for name, entry in run.metrics["overall"].items()}
    best = min((name for name in error if name != "swiftwrf"), key=lambda name: error[name]["median"])
    interval = run.metrics["interval"]

    def in_words(name: str) -> str:
        return f"{error[name]['median']:.2f} dB (90 %: {error[name]['p90']:.1f})"

    law = f" and one log-distance law for all receivers {in_words('mri_pooled')}" if "mri_pooled" in error else ""

    return (
        f"On {_scene(run)}, SwiftWRF's median absolute error over {error['swiftwrf']['n']} heard pairs at "
        f"{len(run.metrics['receivers'])} receiver(s) is {in_words('swiftwrf')}; the best baseline, {best}, reaches "
        f"{in_words(best)}{law}. "
        f"The {interval['nominal']:.0%} interval covers {interval['coverage']:.0%} of the test measurements."
    )


def _run(run: RssiRecords, several: bool) -> list[Section]:
    suffix = f" - {_scene(run)}" if several else ""
    name = run.file_name
    plots = [Plot(f"bars-{name}", _bars(run), "Median absolute error; whiskers: its 95 % interval.")]
    plots.append(Plot(f"cdf-{name}", _cdf(run), "Distribution of the absolute errors over all receivers."))
    return [
        Section(
            f"Errors{suffix}",
            [
                "; ".join(f"{entry.name}: {entry.meaning}" for entry in PREDICTORS.entries()) + ".",
                *(f"Left out: {reason}." for reason in run.metrics.get("left_out", {}).values()),
            ],
            [_table(run), _paired(run)],
            plots,
        ),
        Section(
            f"Maps{suffix}",
            plots=[
                Plot(f"map-{name}", _maps(run, "predicted", "predicted RSSI [dBm]"), _MAP_CAPTION),
                Plot(
                    f"width-{name}",
                    _maps(run, "width", "width of the 80 % interval [dB]"),
                    "Wider away from measurements.",
                ),
            ],
        ),
        Section(f"Where the errors are{suffix}", plots=[Plot(f"where-{name}", _where(run), _WHERE_CAPTION)]),
        Section(f"Speed against error{suffix}", plots=[Plot(f"speed-{name}", _speed(run), _SPEED_CAPTION)]),
    ]


_MAP_CAPTION = (
    "The predicted field with the training measurements in the same colours; a cross marks the receiver. At the median "
    "height of the measurements."
)
_WHERE_CAPTION = (
    "Predicted against measured, and the absolute error (dots; line: running median) against the distance from the receiver "
    "and from the nearest training position. SwiftWRF, all receivers."
)
_SPEED_CAPTION = (
    "Seconds to fit and to predict the test rows against the median error, both logarithmic. The line is the Pareto front: "
    "whatever is not on it is beaten in both by a method that is."
)


def _table(run: RssiRecords) -> Table:
    rows = []
    for name, entry in run.metrics["overall"].items():
        error = entry["abs_error_db"]
        median = f"{number(error['median'])} [{number(error['low'])}, {number(error['high'])}]"
        seconds = f"{number(entry['seconds']['fit'])} + {number(entry['seconds']['predict'])}"
        rows.append([name, median, number(error["mean"]), number(error["p90"]), seconds])
    columns = ["method", "median [dB]", "mean [dB]", "90 % [dB]", "fit + predict [s]"]
    return Table(
        columns,
        rows,
        "Absolute error over all heard test pairs; median with its 95 % interval.",
        frozenset([OWN]),
    )


def _paired(run: RssiRecords) -> Table:
    errors = run.table("errors").pivot_table(index=["index", "receiver"], columns="method", values="abs_error_db")
    rows = []
    for name in run.metrics["overall"]:
        if name != OWN:
            mean, low, high = paired_difference(errors, OWN, name)
            rows.append([name, f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]"])
    caption = "Mean of SwiftWRF's absolute error minus the method's on the same pairs; 95 % bootstrap over test rows."
    return Table(["against", "difference [dB]"], rows, caption)


def _bars(run: RssiRecords) -> Figure:
    receivers = run.metrics["receivers"]
    heights = {}
    for name in run.metrics["overall"]:
        errors = [methods[name]["abs_error_db"] for methods in receivers.values()]
        heights[name] = [(error["median"], error["low"], error["high"]) for error in errors]
    figure, axes = figures.new_figure(1, 1, max(5, 1.1 * len(receivers)), 3.6)
    figures.bars(axes[0], palette(), [figures.plain(name) for name in receivers], heights, "median absolute error [dB]")
    axes[0].tick_params(axis="x", labelrotation=30 if len(receivers) > 6 else 0)
    figures.legend_below(figure, axes[0])
    return figure


def _cdf(run: RssiRecords) -> Figure:
    errors = run.table("errors")
    figure, axes = figures.new_figure(1, 1, 6, 3.6)
    groups = {str(name): part["abs_error_db"] for name, part in errors.groupby("method", sort=False)}
    limit = float(errors["abs_error_db"].quantile(0.98))
    figures.cdf(axes[0], palette(), groups, "absolute error [dB]", limit)
    axes[0].set_ylabel("share of heard test pairs")
    figures.legend_below(figure, axes[0])
    return figure


def _maps(run: RssiRecords, field: str, label: str) -> Figure:
    with np.load(run.folder / "maps.npz") as file:
        maps = dict(file)
    n = len(maps["receiver_names"])
    columns = min(3, n)
    figure, axes = figures.new_figure(-(-n // columns), columns, 3.4 * columns + 0.8, 2.9 * -(-n // columns))
    low, high = np.nanpercentile(maps["measured"] if field == "predicted" else maps["width"], (1, 99))
    extent = (maps["x"][0], maps["x"][-1], maps["y"][0], maps["y"][-1])
    for i, ax in enumerate(axes):
        ax.set_visible(i < n)
        if i >= n:
            continue
        if "plan" in maps:
            ax.imshow(maps["plan"], extent=tuple(maps["plan_extent"]), aspect="equal", zorder=0)
        see_through = 0.75 if "plan" in maps else 1.0
        colours = "viridis" if field == "predicted" else "magma"
        drawn = ax.imshow(
            maps[field][i],
            origin="lower",
            extent=extent,
            cmap=colours,
            vmin=low,
            vmax=high,
            alpha=see_through,
            zorder=1,
        )
        if field == "predicted":
            heard = ~np.isnan(maps["measured"][:, i])
            x, y = maps["measured_position"][heard, :2].T
            dots = {
                "cmap": colours,
                "vmin": low,
                "vmax": high,
                "edgecolors": "white",
                "linewidths": 0.3 if len(x) < MANY else 0,
            }
            ax.scatter(x, y, s=9, c=maps["measured"][heard, i], zorder=2, rasterized=len(x) >= MANY, **dots)
        ax.plot(*maps["receiver"][i, :2], "x", color="#ee6677", markersize=9, markeredgewidth=2, zorder=3)
        ax.set_title(figures.plain(str(maps["receiver_names"][i])), fontsize=9)
        ax.grid(visible=False)
    axes[0].set(xlabel="x [m]", ylabel="y [m]")
    figure.colorbar(drawn, ax=axes[:n], label=label, fraction=0.03, pad=0.02)
    return figure


def _where(run: RssiRecords) -> Figure:
    errors = run.table("errors")
    own = errors[errors["method"] == OWN]
    colour = palette().colour(OWN)
    columns = {
        "from_receiver_m": "distance from the receiver [m]",
        "from_training_m": "distance from training positions [m]",
    }
    columns = {column: label for column, label in columns.items() if own[column].notna().any()}
    figure, axes = figures.new_figure(1, 1 + len(columns), 3.4 * (1 + len(columns)), 3.3)
    many = len(own) >= MANY
    axes[0].plot(own["measured_dbm"], own["predicted_dbm"], ".", markersize=2, color=colour, rasterized=many)
    ends = [own["measured_dbm"].min(), own["measured_dbm"].max()]
    axes[0].plot(ends, ends, color="#aeb7c6", linewidth=1)
    axes[0].set(xlabel="measured [dBm]", ylabel="predicted [dBm]")
    for ax, (column, label) in zip(axes[1:], columns.items(), strict=True):
        ordered = own.sort_values(column)
        ax.plot(ordered[column], ordered["abs_error_db"], ".", markersize=2, color="#bbbbbb", rasterized=many)
        ax.plot(ordered[column], running_median(ordered["abs_error_db"]), color=colour, linewidth=1.6)
        ax.set(xlabel=label, ylabel="absolute error [dB]")
    return figure


def _speed(run: RssiRecords) -> Figure:
    overall = run.metrics["overall"]
    error = {name: entry["abs_error_db"]["median"] for name, entry in overall.items()}
    fit = {name: max(entry["seconds"]["fit"], SHORTEST) for name, entry in overall.items()}
    predict = {name: max(entry["seconds"]["predict"], SHORTEST) for name, entry in overall.items()}
    figure, axes = figures.new_figure(1, 2, 9, 3.2)
    for ax, stage, seconds in zip(axes, ("fit", "predict"), (fit, predict), strict=True):
        points = {name: (seconds[name], error[name]) for name in overall}
        figures.speed(ax, palette(), points, f"seconds to {stage}", "median absolute error [dB]")
    figures.legend_of(figure, palette(), list(overall))
    return figure


def _limits(run: RssiRecords) -> Section:
    texts = [
        "A single packet scatters about the mean of its place by 2 to 3 dB, mostly because it says nothing of its channel; "
        "no predictor of the mean can be better than that.",
        "Values that were not heard are neither learnt from nor scored; nothing here says where a receiver is out of reach.",
        "Intervals of medians treat pairs as independent draws; along a walked path they are not, and the intervals are too "
        "narrow. The paired table draws whole test rows, which mends that in part.",
        "The paper's table (2.91 dB for SwiftWRF, 6.74 for MRI) is of other data; compare methods here, not with it.",
    ]
    if run.metrics["data"] == "simulated-room":
        texts.append("This floor is simulated. It shows that the software works, no more.")
    return Section("What this does not show", texts)
