"""Figures of the localization report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from pandas import DataFrame
from scipy.stats import binomtest

from swiftwrf.locate.baselines import LOCALIZERS
from swiftwrf.plotting import corners_of
from tasks.labels import LOCALIZERS as LABELS
from tasks.labels import labels
from tasks.locate.page.summary import OWN
from tasks.metrics import StudyMetrics
from tasks.page import figures
from tasks.page.figures import DASHES, MAX_CURVES, Palette

MAX_VECTOR_LINES = 300  # more lines become an image, so that the page stays small
TRUTH, ESTIMATE = "#cf4a4a", "#ffffff"


def palette() -> Palette:
    """Return the colours of the localizers."""
    return Palette.of(labels(LOCALIZERS, LABELS))


def overview(errors: DataFrame) -> list[Figure]:
    """Draw the posterior's errors in plan."""
    first, plan = figures.panel(5.4, 4.2)
    own = errors[errors["method"] == OWN]
    truth, estimate = own[["truth_x_m", "truth_y_m"]].to_numpy(), own[["x_m", "y_m"]].to_numpy()
    value = own["position_error_m"].to_numpy()
    many = len(own) >= MAX_VECTOR_LINES
    style: dict[str, Any] = {"cmap": "viridis", "clim": (0, float(np.quantile(value, 0.95)) or 1.0)}
    lines = LineCollection(np.stack([truth, estimate], axis=1).tolist(), linewidths=1, rasterized=many, **style)
    lines.set_array(value)
    plan.add_collection(lines)
    dots = plan.scatter(truth[:, 0], truth[:, 1], c=value, s=8, cmap=style["cmap"], rasterized=many, zorder=3)
    dots.set_clim(*style["clim"])
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plan.autoscale()
    figures.colour_bar(plan, lines, "position error [m]", extend="max")
    return [first]


def coverage(measured: Mapping[str, float], n: int) -> DataFrame:
    """Return nominal coverage, and measured coverage over n rows with its 95 % interval (Wilson)."""
    rows = []
    for level, value in measured.items():
        interval = binomtest(round(value * n), n).proportion_ci(method="wilson")
        rows.append((float(level), value, float(interval.low), float(interval.high)))
    return DataFrame(rows, columns=["nominal", "measured", "low", "high"])


def calibration(data: DataFrame) -> Figure:
    """Draw measured against nominal coverage."""
    figure, axes = figures.panel(5, 3.2)
    axes.plot([0, 1], [0, 1], color=figures.RULE, linewidth=1)
    _with_bars(axes, OWN, data, "nominal", "measured")
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.set(xlabel="probability of the credible region", ylabel="fraction of test positions inside")
    return figure


def study_table(found: Sequence[StudyMetrics]) -> DataFrame:
    """Return one row for each fit: localizer, numbers of training rows and receivers, and the summary of its errors."""
    rows = [{**study, **study["position_error_m"]} for study in found]
    return DataFrame(rows).drop(columns="position_error_m", errors="ignore")


def studies(by_rows: DataFrame, by_receivers: DataFrame) -> list[Figure]:
    """Draw the median error against the numbers of training rows and of receivers, tables of `study_table`."""
    shown = [
        (table, x, label)
        for table, x, label in (
            (by_rows, "n_train", "training rows"),
            (by_receivers, "n_receivers", "receivers"),
        )
        if len(table)
    ]
    panels = []
    for table, x, label in shown:
        figure, ax = figures.panel(3.6, 3.2)
        names = list(table["localizer"].unique())[:MAX_CURVES]
        for dashes, name in zip(DASHES, names, strict=False):
            _with_bars(ax, str(name), table[table["localizer"] == name].sort_values(x), x, "median", line=dashes)
        ax.set(xlabel=label, ylabel="median position error [m]", ylim=(0, None))
        figures.legend_below(figure, ax)
        panels.append(figure)
    return panels


def _with_bars(axes: Axes, name: str, data: DataFrame, x: str, y: str, line: Any = "") -> None:
    """Draw a localizer's values with their intervals, columns low and high."""
    bars = np.clip([data[y] - data["low"], data["high"] - data[y]], 0, None)
    style: dict[str, Any] = {"color": palette().colour(name), "linestyle": line, "linewidth": 1.4, "elinewidth": 0.8}
    axes.errorbar(data[x], data[y], yerr=bars, marker="o", markersize=4, label=name, **style)


def posteriors(maps: Mapping[str, NDArray[Any]]) -> list[Figure]:
    """Draw the posteriors of some test rows in plan, a panel each."""
    shape = float(np.clip(np.ptp(maps["y"]) / max(np.ptp(maps["x"]), 1e-9), 0.4, 1.6))
    extent = corners_of(maps["x"], maps["y"])
    panels = []
    for i in range(len(maps["density"])):
        figure, ax = figures.panel(3.8, 0.6 + 2.8 * shape)
        truth, estimate = maps["truth"][i], maps["estimate"][i]
        drawn = ax.imshow(maps["density"][i], origin="lower", extent=extent, cmap="magma", vmin=0, vmax=1)
        ax.plot(*maps["training_position"].T[:2], ".", color="#888888", markersize=1, rasterized=True)
        ax.add_patch(Circle(estimate[:2], maps["radius_80_m"][i], fill=False, color=ESTIMATE, linewidth=1))
        ax.plot(*estimate[:2], "o", color=ESTIMATE, markeredgecolor="#000001", markersize=5)
        ax.plot(*truth[:2], "x", color=TRUTH, markersize=8, markeredgewidth=2)
        error = float(np.linalg.norm(estimate - truth))
        ax.set_title(f"row {maps['index'][i]}: {error:.2f} m", fontsize=9)
        ax.set(xlabel="x [m]", ylabel="y [m]", xlim=extent[:2], ylim=extent[2:])
        ax.grid(visible=False)
        figures.colour_bar(ax, drawn, "posterior over its maximum")
        panels.append(figure)
    return panels


def posterior_cells(maps: Mapping[str, NDArray[Any]]) -> DataFrame:
    """Return the numbers of `posteriors`, one row for each test row and pixel with candidates."""
    index, ys, xs = (a.ravel() for a in np.meshgrid(maps["index"], maps["y"], maps["x"], indexing="ij"))
    density = maps["density"].ravel()
    table = DataFrame({"index": index, "x_m": xs.round(3), "y_m": ys.round(3), "relative_density": density.round(4)})
    return table[np.isfinite(density)]
