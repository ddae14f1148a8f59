"""The report's section on located test positions: where they are, posteriors, errors, calibration."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame, concat

from augment.turbo.condition import LOCATED
from tasks.aoa.page.records import FractionRecords
from tasks.aoa.page.room import FIXED, draw_in_plan, extent
from tasks.page import figures
from tasks.page.page import Plot, Section, Table, number

LEVELS = np.linspace(0, 1, 21)  # of credible regions
TRUTH, ESTIMATE, MASS = "#2a9165", "#cf4a4a", "#3a7fd5"
MIN_WINDOW_M = 0.02  # half the side of the smallest map of a posterior
MAX_MARK = 120  # area [pt^2] of the candidate with the largest mass


def located_plan(fraction: FractionRecords) -> Figure:
    """Return the plan of the room with a line from each test position to its estimate."""
    table, room = fraction.table("positions"), fraction.arrays("located")
    own = table[(table["method"] == LOCATED) & (table["repeat"] == 0)]
    truth, estimate = own[["truth_x_m", "truth_y_m"]].to_numpy(), own[["estimate_x_m", "estimate_y_m"]].to_numpy()
    figure, plan = figures.panel(4.6, 3.7)
    planes = [
        {"normal": normal, "offset_m": offset, "certain": certain}
        for normal, offset, certain in zip(room["normal"], room["offset"], room["certain"], strict=True)
    ]
    low, high = extent(planes, np.concatenate([room["measured"], room["fixed"][None]]))
    for plane in planes:
        draw_in_plan(plan, plane, low, high)
    plan.plot(*room["measured"][:, :2].T, ".", color=figures.RULE, markersize=3)
    plan.plot(*room["fixed"][:2], "*", color=FIXED, markersize=11)
    highest = max(float(own["error_m"].quantile(0.95)), 1e-3)
    for at, to in zip(truth, estimate, strict=True):
        plan.plot(*zip(at, to, strict=True), color=figures.RULE, linewidth=1, zorder=2)
    drawn = plan.scatter(
        truth[:, 0], truth[:, 1], c=100 * own["error_m"], s=14, cmap="viridis", vmin=0, vmax=100 * highest, zorder=3
    )
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.colour_bar(plan, drawn, "position error [cm]", extend="max")
    return figure


def locating_section(fraction: FractionRecords) -> Section | None:
    """Return the errors of located test positions; None if nothing was located."""
    located = fraction.mix["locating"]
    if not located:
        return None
    rows = [
        [
            method,
            f"{number(100 * own['position_error_m']['median'], 1)} [{number(100 * own['position_error_m']['low'], 1)}, "
            f"{number(100 * own['position_error_m']['high'], 1)}]",
            number(100 * own["position_error_m"]["p90"], 1),
            f"{own['coverage_80']:.0%}",
            f"{own['ambiguous']:.0%}",
        ]
        for method, own in located.items()
    ]
    columns = ["method", "median [cm]", "90 % [cm]", "in 80 % region", "ambiguous"]
    caption = (
        "Median distance between true and estimated position with its 95 % interval. Regions are balls around the estimate. "
        "Ambiguous: a second mode has at least a tenth of the posterior mass."
    )
    plots = [_posteriors(fraction)] if fraction.arrays("located") else []
    return Section("Positions", [], [Table(columns, rows, caption)], [*plots, _calibration(fraction)])


def _calibration(fraction: FractionRecords) -> Plot:
    """Return the calibration of the credible regions."""
    table = fraction.table("positions")
    figure, axes = figures.panel(5.4, 3.2)
    axes.plot([0, 1], [0, 1], color=figures.RULE, linewidth=1)
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    inside = {
        str(method): (LEVELS, [float((part["containing_level"] < level).mean()) for level in LEVELS])
        for method, part in table.groupby("method", sort=False)
    }
    label = "fraction of test positions inside"
    figures.curves(axes, fraction.palette, inside, "level of the credible region", label)
    caption = "Fraction of the test positions inside the credible region of each level: calibrated on the diagonal."
    data = table[["method", "repeat", "index", "truth_x_m", "truth_y_m", "truth_z_m", "error_m", "containing_level"]]
    return Plot(f"located-{fraction.file_name}", [figure], caption, data)


def _posteriors(fraction: FractionRecords) -> Plot:
    """Return maps of the posteriors of six test spectra, from the best to the worst."""
    example = fraction.arrays("located")
    error, panels = np.linalg.norm(example["estimate"] - example["truth"], axis=1), []
    for row in range(len(error)):
        figure, ax = figures.panel(2.4, 2.5)
        at, weight = example["candidate"][row], example["weight"][row]
        truth, estimate = example["truth"][row], example["estimate"][row]
        half = 1.3 * max(error[row], 2 * example["radius"][row], MIN_WINDOW_M)
        ax.scatter(
            at[:, 0], at[:, 1], s=MAX_MARK * weight / weight.max(), color=MASS, alpha=0.4, linewidths=0, rasterized=True
        )
        ax.plot(*truth[:2], "o", color=TRUTH, markersize=9, markerfacecolor="none")
        ax.plot(*estimate[:2], "x", color=ESTIMATE, markersize=8)
        x, y = estimate[:2]
        ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
        ax.set_title(f"row {example['index'][row]}: {100 * error[row]:.1f} cm", fontsize=9)
        ax.set(xlabel="x [m]", ylabel="y [m]")
        ax.locator_params(nbins=3)
        panels.append(figure)
    caption = (
        "Posteriors of six test spectra in plan, from the smallest to the largest position error (quantiles 0, 0.2, ..., "
        "1), each around its estimate. Circle: true position; cross: estimate. The area of a dot is proportional to the "
        "posterior mass."
    )
    parts = [
        DataFrame(example["candidate"][row], columns=["x_m", "y_m", "z_m"]).assign(
            index=example["index"][row], mass=example["weight"][row]
        )
        for row in range(len(error))
    ]
    return Plot(f"posteriors-{fraction.file_name}", panels, caption, concat(parts))
