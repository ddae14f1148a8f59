"""The report's section on located test positions: errors, where they are, posteriors, calibration."""

from __future__ import annotations

import numpy as np
from pandas import DataFrame, concat

from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.page import Plot, Section, Table, number

LEVELS = np.linspace(0, 1, 21)  # of credible regions
TRUTH, ESTIMATE, MASS = "#2a9165", "#cf4a4a", "#3a7fd5"
MIN_WINDOW_M = 0.02  # half the side of the smallest map of a posterior
MAX_MARK = 120  # area [pt^2] of the candidate with the largest mass


def locating_section(fraction: FractionRecords) -> Section | None:
    """Return the errors of located test positions; None if nothing was located and nothing was left out."""
    located, left_out = fraction.mix["locating"], fraction.mix["left_out"]
    title = "Where was it?"
    notes = [f"{method} is left out: {reason}." for method, reason in left_out.items() if method not in located]
    if not located:
        return Section(title, notes) if notes else None
    rows = [
        [
            method,
            f"{number(100 * own['position_error_m']['median'], 1)} [{number(100 * own['position_error_m']['low'], 1)}, "
            f"{number(100 * own['position_error_m']['high'], 1)}]",
            number(100 * own["position_error_m"]["p90"], 1),
            f"{own['coverage_80']:.0%}",
            f"{own['ambiguous']:.0%}",
            *(number(own["seconds"][stage], 1) for stage in ("room", "fit", "locate")),
        ]
        for method, own in located.items()
    ]
    columns = [
        "method",
        "position error [cm]",
        "90 %",
        "in 80 % region",
        "ambiguous",
        "room [s]",
        "fit [s]",
        "locate [s]",
    ]
    caption = (
        "Median distance between true and estimated position with its 95 % interval over the test spectra. Regions are "
        "balls around the estimate. Ambiguous: a second mode has at least a tenth of the posterior mass."
    )
    text = (
        f"Matched-field processing searches the position of the moving end ({fraction.run.metrics['moving']}) whose "
        "spectrum, predicted by the room that was found, matches the observed one. The direction follows from the posterior "
        "over positions. The estimate is the posterior median."
    )
    plots = [_errors(fraction)]
    if fraction.arrays("located"):
        plots.append(_posteriors(fraction))
    return Section(title, [text, *notes], [Table(columns, rows, caption)], plots)


def _errors(fraction: FractionRecords) -> Plot:
    """Return the distribution of the position errors and the calibration of the credible regions."""
    table = fraction.table("positions")
    groups = {str(method): part for method, part in table.groupby("method", sort=False)}
    errors = {method: 100 * part["error_m"] for method, part in groups.items()}
    first, distribution = figures.panel(5, 3.4)
    limit = max(*(float(part.quantile(0.95)) for part in errors.values()), 1e-3)
    figures.cdf(distribution, fraction.palette, errors, "position error [cm]", limit=limit)
    second, calibration = figures.panel(5, 3.4)
    calibration.plot([0, 1], [0, 1], color=figures.RULE, linewidth=1)
    calibration.set(xlim=(0, 1), ylim=(0, 1.02))
    inside = {
        method: (LEVELS, [float((part["containing_level"] < level).mean()) for level in LEVELS])
        for method, part in groups.items()
    }
    label = "fraction of test positions inside"
    figures.curves(calibration, fraction.palette, inside, "level of the credible region", label)
    caption = (
        "Left: distribution of the position errors. Right: fraction of the test positions inside the credible region of "
        "each level; on the diagonal the posterior is calibrated."
    )
    data = table[["method", "repeat", "index", "truth_x_m", "truth_y_m", "truth_z_m", "error_m", "containing_level"]]
    return Plot(f"located-{fraction.file_name}", [first, second], caption, data)


def _posteriors(fraction: FractionRecords) -> Plot:
    """Return maps of the posteriors of six test spectra, from the best to the worst."""
    example = fraction.arrays("located")
    error, panels = np.linalg.norm(example["estimate"] - example["truth"], axis=1), []
    for row in range(len(error)):
        figure, ax = figures.panel(3.6, 3.6)
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
        ax.locator_params(nbins=5)
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
