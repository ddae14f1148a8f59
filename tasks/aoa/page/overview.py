"""First screen of the report: errors against the baselines, the room with located positions, spectra."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK
from tasks.aoa.page.records import FractionRecords, palette
from tasks.aoa.page.room import FIXED, draw_in_plan, extent
from tasks.aoa.page.synthesis import examples, spectra
from tasks.page import figures
from tasks.page.page import Plot, Table
from tasks.page.shared import Compared, comparison, interval

BASELINES = ("peak", "constant")  # in every table and figure of errors: others must beat them
SHOWN_SPECTRUM = 3  # of the examples, quantile 0.4 of the quality


def essential(fraction: FractionRecords) -> list[str]:
    """Return the methods of overviews, in their order: baselines, without synthetic spectra, with them, references."""
    choice = fraction.mix["estimator_choice"]
    names = [*BASELINES, fraction.mix["reference"], MEASURED_NETWORK, fraction.turbo_method, LOCATED]
    names += [*([choice["name"]] if choice else []), FULL_NETWORK]
    return [name for name in dict.fromkeys(names) if name in fraction.mix["methods"]]


def overview(fraction: FractionRecords) -> Plot:
    """Return the plan with located positions if there are any, spectra, and the errors of the essential methods."""
    example = examples(fraction)[SHOWN_SPECTRUM]
    pair = {kind: example.images[kind] for kind in ("measured", "predicted")}
    panels = [spectra(pair, f"spectrum {example.title}", example.truth)]
    names = essential(fraction)
    values = [interval(fraction.mix["methods"][name]["great_circle_deg"]) for name in names]
    dots = figures.dots(names, {"error": values}, palette([]), "median angular error [deg]", log=True)
    caption = (
        "A spectrum at a position without a measurement, measured and predicted (cross: true direction, ring: peak). "
    )
    caption += "Median angular error with its 95 % interval; `peak` and `constant` need no training."
    if fraction.arrays("located"):
        panels.insert(0, located_plan(fraction))
        caption = (
            "The room that was found (dashed walls are not identifiable), and test positions with the errors of their "
            f"location. {caption}"
        )
    data = figures.dots_data("method", names, {"error": values}, "deg")
    return Plot("summary", [*panels, dots], caption, data)


def located_plan(fraction: FractionRecords) -> Figure:
    """Return the plan of the room with a line from each test position to its estimate."""
    table = fraction.table("positions")
    own = table[(table["method"] == LOCATED) & (table["repeat"] == 0)]
    truth, estimate = own[["truth_x_m", "truth_y_m"]].to_numpy(), own[["estimate_x_m", "estimate_y_m"]].to_numpy()
    figure, plan = figures.panel(4.8, 3.8)
    draw_room(plan, fraction.arrays("located"))
    highest = max(float(own["error_m"].quantile(0.95)), 1e-3)
    for at, to in zip(truth, estimate, strict=True):
        plan.plot(*zip(at, to, strict=True), color=figures.RULE, linewidth=1, zorder=2)
    drawn = plan.scatter(
        truth[:, 0], truth[:, 1], c=100 * own["error_m"], s=14, cmap="viridis", vmin=0, vmax=100 * highest, zorder=3
    )
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.colour_bar(plan, drawn, "position error [cm]", extend="max")
    return figure


def draw_room(plan: Axes, room: dict[str, NDArray[np.floating]]) -> None:
    """Draw the planes of a room, measured positions and the fixed end."""
    planes = [
        {"normal": normal, "offset_m": offset, "certain": certain}
        for normal, offset, certain in zip(room["normal"], room["offset"], room["certain"], strict=True)
    ]
    low, high = extent(planes, np.concatenate([room["measured"], room["fixed"][None]]))
    for plane in planes:
        draw_in_plan(plan, plane, low, high)
    plan.plot(*room["measured"][:, :2].T, ".", color=figures.RULE, markersize=3)
    plan.plot(*room["fixed"][:2], "*", color=FIXED, markersize=11)


def compared(fractions: list[FractionRecords]) -> tuple[Table, Plot]:
    """Return the comparison of several measured fractions or runs."""
    every = []
    for fraction in fractions:
        methods = {name: fraction.mix["methods"][name]["great_circle_deg"] for name in essential(fraction)}
        every.append(Compared(fraction.scene, methods, {}))
    shown = [
        *BASELINES,
        *(fraction.mix["reference"] for fraction in fractions),
        *(fraction.turbo_method for fraction in fractions),
        LOCATED,
        FULL_NETWORK,
    ]
    conditions = [condition for fraction in fractions for condition in fraction.conditions.values()]
    names = [name for name in dict.fromkeys(shown) if any(name in one.errors for one in every)]
    return comparison(every, palette(conditions), names, "deg", "angular error")
