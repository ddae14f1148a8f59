"""The report of one RSSI run or several."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from tasks.labels import PREDICTORS as LABELS
from tasks.labels import labels
from tasks.page import figures
from tasks.page.page import Page, Plot, Section, Table
from tasks.page.palette import Palette
from tasks.page.provenance import number, provenance
from tasks.rssi.page.summary import RssiRecords, by_method, model_of, summary, title, varies
from tasks.rssi.predictors import PREDICTORS
from tasks.summarise import SHORTEST, paired_difference, running_median

MAX_MAPS = 24  # receivers with a map in the report; all are in the tables
MAX_BARS = 60  # receivers beside each other in a figure
MAX_VECTOR_DOTS = 300  # more dots become an image: their white edges hide the colours, and the page grows to megabytes
_FIELDS = {"predicted": "predicted_dbm", "width": "width_db"}


def palette() -> Palette:
    """Return the colours of the predictors; the mean, which uses no position, is dashed."""
    return Palette.of(labels(PREDICTORS, LABELS), dashed=["mean"])


def page(runs: list[RssiRecords]) -> Page:
    """Return the page of these runs."""
    sections = [section for run in runs for section in _run(run, several=len(runs) > 1)]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    picture = Plot("summary", _maps(runs[0], "predicted", "predicted RSSI [dBm]", 1), _MAP_CAPTION, _cells(runs[0], 1))
    return Page(f"RSSI: {names}", summary(runs[0], picture), [*sections, _limits(runs[0]), provenance(runs)])


def _run(run: RssiRecords, several: bool) -> list[Section]:
    suffix = f" - {run.scene}" if several else ""
    name = run.file_name
    errors, cells = run.table("errors"), _cells(run)
    heights = _heights(run)
    pairs = errors[["receiver", "index", "method", "abs_error_db"]]
    plots = [Plot(f"cdf-{name}", _cdf(errors), "Distribution of the absolute errors over all receivers.", pairs)]
    if len(_receivers(run)) <= MAX_BARS:
        bars = Plot(
            f"bars-{name}",
            _bars(run, heights),
            "Median absolute error; whiskers: its 95 % interval.",
            figures.bars_data("receiver", _receivers(run), heights, "db"),
        )
        plots.insert(0, bars)
    maps = [
        Plot(
            f"width-{name}",
            _maps(run, "width", "width of the 80 % interval [dB]"),
            _WIDER if varies(run.arrays("maps")["width"]) else _EVEN,
            cells,
        )
    ]
    if several or len(_receivers(run)) > 1:  # else it is the picture of the summary
        maps.insert(0, Plot(f"map-{name}", _maps(run, "predicted", "predicted RSSI [dBm]"), _MAP_CAPTION, cells))
    return [
        Section(
            f"Errors{suffix}",
            [f"Left out: {reason}." for reason in run.metrics.get("left_out", {}).values()],
            [_table(run), _paired(run)],
            plots,
            {name: label.meaning for name, label in labels(PREDICTORS, LABELS).items()},
        ),
        Section(f"Maps{suffix}", plots=maps),
        Section(f"Where the errors are{suffix}", plots=[_where(run)]),
        Section(f"Speed against error{suffix}", plots=[_speed(run)]),
    ]


_MAP_CAPTION = (
    "Predicted RSSI and the training measurements in the same colours, at the median height of the measurements. A cross "
    "marks the receiver if its position is known."
)
_WIDER = "Wider away from measurements."
_EVEN = "Equally wide everywhere: a field does not improve the predictions of held-out measurements at these receivers."
_WHERE_CAPTION = (
    "Predicted against measured RSSI, and the absolute error (dots; line: running median) against the distance from the "
    "receiver, if its position is known, and from the nearest training position. All receivers."
)
_SPEED_CAPTION = (
    "Seconds to fit and to predict the test rows against the median error, both logarithmic. The line is the Pareto front: "
    "for every method off it, a method on it is faster and more accurate."
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
        "Absolute error over all detected test pairs; median with its 95 % interval.",
        frozenset([model_of(run)]),
    )


def _paired(run: RssiRecords) -> Table:
    errors, rows, own = by_method(run), [], model_of(run)
    for name in run.metrics["overall"]:
        if name != own:
            mean, low, high = paired_difference(errors, own, name)
            interval = "" if math.isnan(low) else f" [{low:+.2f}, {high:+.2f}]"
            rows.append([name, f"{mean:+.2f}{interval}"])
    caption = (
        f"Mean absolute error of {title(run)} minus that of the method on the same pairs; 95 % bootstrap of test rows."
    )
    return Table(["against", "difference [dB]"], rows, caption)


def _receivers(run: RssiRecords) -> list[str]:
    return list(run.metrics["receivers"])


def _heights(run: RssiRecords) -> dict[str, list[tuple[float, float, float]]]:
    """Return the median error and its interval by method, in the order of the receivers."""
    heights = {}
    for name in run.metrics["overall"]:
        errors = [methods[name]["abs_error_db"] for methods in run.metrics["receivers"].values()]
        heights[name] = [(error["median"], error["low"], error["high"]) for error in errors]
    return heights


def _bars(run: RssiRecords, heights: dict[str, list[tuple[float, float, float]]]) -> Figure:
    receivers = _receivers(run)
    figure, axes = figures.new_figure(1, 1, max(6, 1.1 * len(receivers)), 3.8)
    figures.bars(axes[0], palette(), [figures.short(name) for name in receivers], heights, "median absolute error [dB]")
    axes[0].tick_params(axis="x", labelrotation=30 if len(receivers) > 6 else 0)
    figures.legend_below(figure, axes[0])
    return figure


def _cdf(errors: DataFrame) -> Figure:
    figure, axes = figures.new_figure(1, 1, 6, 3.8)
    groups = {str(name): part["abs_error_db"] for name, part in errors.groupby("method", sort=False)}
    limit = float(errors["abs_error_db"].quantile(0.98))
    figures.cdf(axes[0], palette(), groups, "absolute error [dB]", limit)
    axes[0].set_ylabel("fraction of detected test pairs")
    figures.legend_below(figure, axes[0])
    return figure


def _most_detected(maps: dict[str, NDArray[Any]], n: int) -> list[int]:
    """Return the columns of the n receivers that detected most rows, ascending."""
    detected = (~np.isnan(maps["measured"])).sum(axis=0)
    return sorted(np.argsort(-detected, kind="stable")[:n].tolist())


def _cells(run: RssiRecords, n_maps: int = MAX_MAPS) -> DataFrame:
    """Return the numbers of `_maps`, one row for each cell and receiver."""
    maps = run.arrays("maps")
    shown = _most_detected(maps, n_maps)
    names, ys, xs = (a.ravel() for a in np.meshgrid(maps["receiver_names"][shown], maps["y"], maps["x"], indexing="ij"))
    values = {field: maps[kind][shown].ravel().round(2) for kind, field in _FIELDS.items()}
    origin = GeodeticOrigin(*maps["origin"].tolist()) if "origin" in maps else None
    degrees = {name: value.round(7) for name, value in degree_columns(origin, np.stack([xs, ys], axis=1)).items()}
    return DataFrame({"receiver": names, "x_m": xs.round(3), "y_m": ys.round(3)} | degrees | values)


def _maps(run: RssiRecords, field: str, label: str, n_maps: int = MAX_MAPS) -> Figure:
    """Draw maps of the receivers that detected most rows."""
    maps = run.arrays("maps")
    shown = _most_detected(maps, n_maps)
    n = len(shown)
    columns = min(3, n)
    rows = -(-n // columns)
    width = 6.8 if n == 1 else 12
    across, down = np.ptp(maps["x"]), np.ptp(maps["y"])
    height = (width - 0.8) / columns * min(max(down / max(across, 1e-9), 0.4), 1.6)
    figure, axes = figures.new_figure(rows, columns, width, max(rows * (height + 0.3) + 0.3, 3.6))
    low, high = np.nanpercentile(maps["measured"] if field == "predicted" else maps["width"], (1, 99))
    extent = (maps["x"][0], maps["x"][-1], maps["y"][0], maps["y"][-1])
    for ax in axes[n:]:
        ax.set_visible(False)
    style: dict[str, Any] = {"cmap": "viridis" if field == "predicted" else "magma", "vmin": low, "vmax": high}
    for panel, (i, ax) in enumerate(zip(shown, axes, strict=False)):
        left, bottom = panel % columns == 0, panel + columns >= n  # one axis serves all panels above and beside it
        ax.tick_params(labelleft=left, labelbottom=bottom)
        ax.set(xlabel="x [m]" if bottom else "", ylabel="y [m]" if left else "")
        if "plan" in maps:
            ax.imshow(maps["plan"], extent=tuple(maps["plan_extent"]), aspect="equal", zorder=0)
        alpha = 0.75 if "plan" in maps else 1.0
        drawn = ax.imshow(maps[field][i], origin="lower", extent=extent, alpha=alpha, zorder=1, **style)
        if field == "predicted":
            detected = ~np.isnan(maps["measured"][:, i])
            x, y = maps["measured_position"][detected, :2].T
            many, colours = len(x) >= MAX_VECTOR_DOTS, maps["measured"][detected, i]
            edges: dict[str, Any] = {"edgecolors": "white", "linewidths": 0 if many else 0.3}
            ax.scatter(x, y, s=9, c=colours, zorder=2, rasterized=many, **edges, **style)
        ax.plot(*maps["receiver"][i, :2], "x", color="#ee6677", markersize=9, markeredgewidth=2, zorder=3)
        ax.set_title(figures.short(str(maps["receiver_names"][i])), fontsize=9)
        ax.grid(visible=False)
    figure.colorbar(drawn, ax=axes[:n], label=label, fraction=0.03, pad=0.02)
    return figure


def _where(run: RssiRecords) -> Plot:
    errors = run.table("errors")
    own = errors[errors["method"] == model_of(run)]
    colour = palette().colour(model_of(run))
    columns = {
        "from_receiver_m": "distance from the receiver [m]",
        "from_training_m": "distance from training positions [m]",
    }
    columns = {column: label for column, label in columns.items() if own[column].notna().any()}
    figure, axes = figures.new_figure(1, 1 + len(columns), 4 * (1 + len(columns)), 3.6)
    many = len(own) >= MAX_VECTOR_DOTS
    axes[0].plot(own["measured_dbm"], own["predicted_dbm"], ".", markersize=2, color=colour, rasterized=many)
    ends = [own["measured_dbm"].min(), own["measured_dbm"].max()]
    axes[0].plot(ends, ends, color=figures.RULE, linewidth=1)
    axes[0].set(xlabel="measured [dBm]", ylabel="predicted [dBm]")
    for ax, (column, label) in zip(axes[1:], columns.items(), strict=True):
        ordered = own.sort_values(column)
        ax.plot(ordered[column], ordered["abs_error_db"], ".", markersize=2, color="#bbbbbb", rasterized=many)
        ax.plot(ordered[column], running_median(ordered["abs_error_db"]), color=colour, linewidth=1.6)
        ax.set(xlabel=label, ylabel="absolute error [dB]")
    data = own[["receiver", "index", "measured_dbm", "predicted_dbm", "abs_error_db", *columns]]
    return Plot(f"where-{run.file_name}", figure, _WHERE_CAPTION, data)


def _speed(run: RssiRecords) -> Plot:
    overall = run.metrics["overall"]
    error = {name: entry["abs_error_db"]["median"] for name, entry in overall.items()}
    fit = {name: max(entry["seconds"]["fit"], SHORTEST) for name, entry in overall.items()}
    predict = {name: max(entry["seconds"]["predict"], SHORTEST) for name, entry in overall.items()}
    figure, axes = figures.new_figure(1, 2, 12, 4)
    for ax, stage, seconds in zip(axes, ("fit", "predict"), (fit, predict), strict=True):
        points = {name: (seconds[name], error[name]) for name in overall}
        figures.speed(ax, palette(), points, f"seconds to {stage}", "median absolute error [dB]", also=[model_of(run)])
    figures.legend_of(figure, palette(), list(overall))
    columns = {"fit_s": fit, "predict_s": predict, "median_abs_error_db": error}
    data = DataFrame(columns).rename_axis("method").reset_index()
    return Plot(f"speed-{run.file_name}", figure, _SPEED_CAPTION, data)


def _limits(run: RssiRecords) -> Section:
    texts = [
        "Single packets scatter about the mean of their position. BLE packets of unknown channel scatter by 2 to 3 dB. No "
        "predictor of the mean has a lower error than this scatter.",
        "Values that were not detected are neither training nor test data. The report does not show where a receiver is out "
        "of range.",
        "Intervals of medians treat pairs as independent. Along a walked path they are not, and the intervals are too "
        "narrow. The bootstrap of the paired table samples whole test rows, which corrects this in part.",
        "The paper's table (2.91 dB for SwiftWRF, 6.74 dB for MRI) is of other data. Compare methods in this report only.",
    ]
    if run.metrics["data"] == "simulated-floor":
        texts.append(
            "This floor is simulated. It shows that the software works, and not how accurate it is on measurements."
        )
    return Section("What this does not show", texts)
