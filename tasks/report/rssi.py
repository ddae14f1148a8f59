"""The report of RSSI runs, one or several."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from tasks.report import figures
from tasks.report.page import Page, Plot, Section, Table
from tasks.report.provenance import number, provenance
from tasks.report.records import Records

MANY = 300  # dots, from which on white edges would hide their colours
MEANING = {
    "swiftwrf": "50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance law",
    "mean": "the mean of the receiver's training values",
    "mri_pooled": "one log-distance law for all receivers",
    "mri_receiver": "a log-distance law for each receiver",
    "mri_residual": "the same, and what it leaves interpolated from the nearest measurements",
    "knn": "inverse-distance mean of the nearest measurements",
    "gp": "a Gaussian process on what the log-distance law leaves",
}


def rssi_page(runs: list[Records]) -> Page:
    """The page of these runs."""
    sections = [section for run in runs for section in _run(run, several=len(runs) > 1)]
    names = ", ".join(dict.fromkeys(_scene(run) for run in runs))
    return Page(f"RSSI: {names}", _lead(runs[0]), [*sections, _limits(runs[0]), provenance(runs)])


def _scene(run: Records) -> str:
    name = "the simulated floor" if run.metrics["data"] == "simulated-room" else run.metrics["data"]
    return f"{name}, {run.metrics['split']} split"


def _lead(run: Records) -> str:
    error = {name: entry["abs_error_db"] for name, entry in run.metrics["overall"].items()}
    best = min((name for name in error if name != "swiftwrf"), key=lambda name: error[name]["median"])
    interval = run.metrics["interval"]

    def told(name: str) -> str:
        return f"{error[name]['median']:.2f} dB (90 %: {error[name]['p90']:.1f})"

    return (
        f"On {_scene(run)}, SwiftWRF's median absolute error over {error['swiftwrf']['n']} heard pairs at "
        f"{len(run.metrics['receivers'])} receiver(s) is {told('swiftwrf')}; the best baseline, {best}, reaches "
        f"{told(best)} and one log-distance law for all receivers {told('mri_pooled')}. "
        f"The {interval['nominal']:.0%} interval covers {interval['coverage']:.0%} of the test measurements."
    )


def _run(run: Records, several: bool) -> list[Section]:
    suffix = f" - {_scene(run)}" if several else ""
    name = f"{run.metrics['data']}-{run.metrics['split']}-s{run.metrics['seed']}"
    plots = [Plot(f"bars-{name}", _bars(run), "Median absolute error; whiskers: its 95 % interval.")]
    plots.append(Plot(f"cdf-{name}", _cdf(run), "Distribution of the absolute errors over all receivers."))
    return [
        Section(
            f"Errors{suffix}",
            ["; ".join(f"{k}: {v}" for k, v in MEANING.items()) + "."],
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


def _table(run: Records) -> Table:
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
        frozenset(["swiftwrf"]),
    )


def _paired(run: Records) -> Table:
    """Differences of the same pairs' errors, with a bootstrap over test rows, for rows are not independent of receivers."""
    errors = run.table("errors").pivot_table(index=["index", "receiver"], columns="method", values="abs_error_db")
    rows = []
    for name in run.metrics["overall"]:
        if name == "swiftwrf":
            continue
        difference = (errors["swiftwrf"] - errors[name]).groupby(level="index").agg(["sum", "count"]).to_numpy()
        draws = np.random.default_rng(0).integers(len(difference), size=(1000, len(difference)))
        sums = difference[draws].sum(axis=1)
        low, high = np.percentile(sums[:, 0] / sums[:, 1], (2.5, 97.5))
        mean = difference[:, 0].sum() / difference[:, 1].sum()
        rows.append([name, f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]"])
    caption = "Mean of SwiftWRF's absolute error minus the method's on the same pairs; 95 % bootstrap over test rows."
    return Table(["against", "difference [dB]"], rows, caption)


def _bars(run: Records) -> Figure:
    receivers = list(run.metrics["receivers"])
    heights = {
        name: [
            tuple(run.metrics["receivers"][r][name]["abs_error_db"][k] for k in ("median", "low", "high"))
            for r in receivers
        ]
        for name in run.metrics["overall"]
    }
    figure, axes = figures.new_figure(1, 1, max(5, 1.1 * len(receivers)), 3.6)
    figures.bars(axes[0], receivers, heights, "median absolute error [dB]")
    axes[0].tick_params(axis="x", labelrotation=30 if len(receivers) > 6 else 0)
    figures.legend_below(figure, axes[0])
    return figure


def _cdf(run: Records) -> Figure:
    errors = run.table("errors")
    figure, axes = figures.new_figure(1, 1, 6, 3.6)
    groups = {str(name): part["abs_error_db"] for name, part in errors.groupby("method", sort=False)}
    figures.cdf(axes[0], groups, "absolute error [dB]", limit=float(errors["abs_error_db"].quantile(0.98)))
    axes[0].set_ylabel("share of heard test pairs")
    figures.legend_below(figure, axes[0])
    return figure


def _maps(run: Records, field: str, label: str) -> Figure:
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
            ax.scatter(x, y, s=9, c=maps["measured"][heard, i], zorder=2, **dots)
        ax.plot(*maps["receiver"][i, :2], "x", color="#ee6677", markersize=9, markeredgewidth=2, zorder=3)
        ax.set_title(str(maps["receiver_names"][i]), fontsize=9)
        ax.grid(visible=False)
    axes[0].set(xlabel="x [m]", ylabel="y [m]")
    figure.colorbar(drawn, ax=axes[:n], label=label, fraction=0.03, pad=0.02)
    return figure


def _where(run: Records) -> Figure:
    errors = run.table("errors")
    own = errors[errors["method"] == "swiftwrf"]
    figure, axes = figures.new_figure(1, 3, 10, 3.3)
    axes[0].plot(own["measured_dbm"], own["predicted_dbm"], ".", markersize=2, color=figures.colour("swiftwrf"))
    ends = [own["measured_dbm"].min(), own["measured_dbm"].max()]
    axes[0].plot(ends, ends, color="#aeb7c6", linewidth=1)
    axes[0].set(xlabel="measured [dBm]", ylabel="predicted [dBm]")
    columns = {
        "from_receiver_m": "distance from the receiver [m]",
        "from_training_m": "distance from training positions [m]",
    }
    for ax, (column, label) in zip(axes[1:], columns.items(), strict=True):
        ordered = own.sort_values(column)
        ax.plot(ordered[column], ordered["abs_error_db"], ".", markersize=2, color="#bbbbbb")
        window = max(len(ordered) // 5, 1)
        running = ordered["abs_error_db"].rolling(window, center=True).median()
        ax.plot(ordered[column], running, color=figures.colour("swiftwrf"), linewidth=1.6)
        ax.set(xlabel=label, ylabel="absolute error [dB]")
    return figure


def _speed(run: Records) -> Figure:
    figure, axes = figures.new_figure(1, 2, 9, 3.2)
    for ax, stage in zip(axes, ("fit", "predict"), strict=True):
        overall = run.metrics["overall"].items()
        points = {
            name: (max(entry["seconds"][stage], 1e-5), entry["abs_error_db"]["median"]) for name, entry in overall
        }
        figures.speed(ax, points, f"seconds to {stage}", "median absolute error [dB]")
    figures.legend_of(figure, list(run.metrics["overall"]))
    return figure


def _limits(run: Records) -> Section:
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
