"""The report's sections on the field model and on positions: gains, the room that was found, located test positions."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame, concat

from augment.turbo.condition import LOCATED
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.geometry.planes import IDENTIFIABLE
from swiftwrf.plotting import corners_of, hatch
from tasks import labels
from tasks.aoa.records import FractionRecords
from tasks.aoa.synthesis import quality_table
from tasks.page import figures
from tasks.page.page import Plot, Section, Table, number
from tasks.page.shared import with_interval
from tasks.records import Row, read_json

MARGIN = 0.5  # [m] around the room in a plan
FIXED, MEASURED, IMAGE = "#cf4a4a", "#3a7fd5", "#d1620f"
LEVELS = np.linspace(0, 1, 21)  # of credible regions
TRUTH, ESTIMATE, MASS = "#2a9165", "#cf4a4a", "#3a7fd5"
MIN_WINDOW_M = 0.02  # half the side of the smallest map of a posterior
MAX_MARK = 120  # area [pt^2] of the candidate with the largest mass


def _cross_validations(fraction: FractionRecords) -> dict[str, Row]:
    """Return the cross-validation of each field model, if it has extra positions."""
    return {name: entry for name, entry in (fraction.mix["cross_validation"] or {}).items() if entry["gains"]}


def cross_validation_sentences(fraction: FractionRecords) -> list[str]:
    """Return a text for each field model that was compared: does turbo learning help?"""
    texts = []
    for name, validation in _cross_validations(fraction).items():
        best, rule = _best_and_rule(validation)
        found = (
            f"Cross-validation inside the measured fraction ({validation['n_held_out']} spectra held out, "
            f"{validation['stand_in']} in place of the network): spectra predicted by {name} at synthetic positions change "
            f"the median error by {rule['change']:+.0%} [{rule['low']:+.0%}, {rule['high']:+.0%}], from "
            f"{validation['measured_only_deg']:.2f} to {rule['median_deg']:.2f} degrees, with their number chosen on other "
            "held-out spectra. "
            + (f"The best number is {best['n_synthetic']}." if best["change"] < 0 else "No number reduces it.")
        )
        texts.append(f"{found} {_advice(validation)}")
    return texts


def _advice(validation: Row) -> str:
    """Return in one sentence whether turbo learning helps by a field model."""
    if validation["helps"]:
        return f"Turbo learning helps here: use --extra {validation['recommended_n_synthetic']} with this fraction."
    if _best_and_rule(validation)[1]["low"] > 0:
        return "Turbo learning harms here: measure more instead, or use another synthesizer."
    return "The change is not significant: more measured positions are the safer way."


def _best_and_rule(validation: Row) -> tuple[Row, Row]:
    """Return the number with the lowest error, and the number chosen on other folds."""
    best = min(validation["gains"], key=lambda gain: gain["median_deg"])
    return best, validation["rule"] or best


def choice_section(fraction: FractionRecords) -> Section:
    """Return the quality of the field models, why one was chosen, and the gain over the number of extra positions."""
    choice, texts = fraction.mix["choice"], cross_validation_sentences(fraction)
    if choice is not None:
        name = choice["name"]
        meaning = labels.meanings(FIELD_MODELS, labels.FIELD_MODELS).get(name)
        texts.insert(0, f"{name} predicts held-out measured spectra best{f': {meaning}' if meaning else ''}.")
        texts += [f"{name} could not be fitted: {reason}." for name, reason in choice["left_out"].items()]
    plots = [_gain(fraction, *item) for item in _cross_validations(fraction).items()]
    return Section("Do synthetic spectra help?", texts, [quality_table(fraction)], plots)


def _gain(fraction: FractionRecords, name: str, validation: Row) -> Plot:
    figure, ax = figures.panel(5.8, 3.2)
    colour = labels.colour(fraction.palette, name)
    gains = sorted(validation["gains"], key=lambda gain: gain["n_synthetic"])
    at = [0, *(gain["n_synthetic"] for gain in gains)]
    change, low, high = ([0, *(100 * gain[end] for gain in gains)] for end in ("change", "low", "high"))
    ax.plot(at, change, marker="o", markersize=4, color=colour)
    ax.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.axhline(0, color=figures.RULE, linewidth=1)
    ax.set_xlim(0, 1.02 * at[-1])
    ax.set(xlabel="extra positions with synthetic spectra", ylabel="change of the median error [%]")
    caption = (
        f"Held-out measured spectra, {validation['stand_in']} trained on the other measured spectra and on spectra by "
        f"{name}. Bands: 95 % bootstrap intervals of the change. Turbo learning helps below zero."
    )
    return Plot(f"gain-{name}-{fraction.file_name}", [figure], caption, DataFrame(validation["gains"]))


def room_section(fraction: FractionRecords) -> Section | None:
    """Return the planes of the room, in plan and in space; None if no model searched for them."""
    file = fraction.run.folder / f"geometry-mix{fraction.key}.json"
    if not file.is_file():
        return None
    room = read_json(file)
    title = "The room that was found"
    if not room["planes"]:
        return Section(title, ["No plane predicts held-out spectra: the direct path is all that was found."])
    rows = [
        [
            _described(plane),
            f"{plane['gain']:+.2f}" + " (dielectric)" * plane["dielectric"],
            number(plane["std_mm"], 1),
            f"{plane['probability']:.1%}",
            "none" if plane["rival_m"] is None else _described({**plane, "offset_m": plane["rival_m"]}),
            "yes" if plane["certain"] else "no",
        ]
        for plane in room["planes"]
    ]
    caption = (
        f"Mirror planes, also in `geometry-mix{fraction.key}.json`; images up to order {room['order']}. The room explains "
        f"{1 - room['unexplained']:.0%} of the power of the spectra. Its spectra have a correlation of "
        f"{1 - room['score_held_out']:.3f} with measured ones that the first stage of the search did not use. Half a "
        "phase period away, with the other sign of its gain, a plane explains the spectra nearly as well. Probability: that "
        "the plane is not at such an alternative. Standard deviation: without alternatives. Identifiable: a probability of "
        f"at least {IDENTIFIABLE:.0%}. The gain of a dielectric is that at normal incidence."
    )
    heading = ["plane", "gain", "standard deviation [mm]", "probability", "strongest alternative", "identifiable"]
    table = Table(heading, rows, caption)
    points = fraction.arrays("room")
    first = points["image"][points["order"] == 1]
    places = {"measured": points["measured"], "fixed end": points["fixed"][None], "image of first order": first}
    figure, plan = _plan(room["planes"], points, 5.4, 4.2)
    plan.plot(*points["measured"][:, :2].T, "o", color=MEASURED, markersize=2, label="measured")
    plan.plot(*first[:, :2].T, "D", color=IMAGE, markersize=4, label="its images")
    figures.legend_below(plan)
    plot = Plot(
        f"room-{fraction.file_name}",
        [figure],
        "The planes in plan (dashed: not identifiable), measured positions, the fixed end and its images of first "
        "order. The images of a moving transmitter are those of the array that sees it.",
        concat([DataFrame(at, columns=["x_m", "y_m", "z_m"]).assign(what=what) for what, at in places.items()]),
    )
    if "plan" not in points:
        return Section(title, [], [table], [plot])
    z, y, x = np.meshgrid(points["height"][:-1], points["plan_y"], points["plan_x"], indexing="ij")
    columns = {"x_m": x, "y_m": y, "z_from_m": z, "absorption_db_per_m": points["plan"]}
    furniture = Plot(
        f"furniture-{fraction.file_name}",
        furniture_panels(room["planes"], points),
        "What stands in the room between three pairs of heights: the largest absorption of the amplitude. Hatched: unknown, "
        "because no measured path crosses it. Held-out channels need this furniture.",
        DataFrame({name: values.ravel().round(3) for name, values in columns.items()}),
    )
    return Section(title, [], [table], [plot, furniture])


def furniture_panels(planes: list[dict[str, Any]], points: dict[str, NDArray[Any]]) -> list[Figure]:
    """Return a plan of the absorption between each pair of neighbouring heights, with the planes."""
    x, y, height = points["plan_x"], points["plan_y"], points["height"]
    most = max(float(np.nanmax(points["plan"], initial=0.0)), 1.0)
    panels = []
    for values, ends in zip(points["plan"], pairwise(height), strict=True):
        figure, ax = _plan(planes, points, 3.8, 3.6)
        drawn = ax.imshow(values, origin="lower", extent=corners_of(x, y), vmin=0, vmax=most, cmap="Greys")
        hatch(ax, x, y, np.isnan(values))
        ax.set_title(f"z = {ends[0]:.2f} to {ends[1]:.2f} m")
        figures.colour_bar(ax, drawn, "absorption [dB/m]")
        panels.append(figure)
    return panels


def _described(plane: dict[str, Any]) -> str:
    normal = np.array(plane["normal"])
    axis = int(np.abs(normal).argmax())
    if abs(normal[axis]) > 1 - 1e-6:
        return f"{'xyz'[axis]} = {plane['offset_m'] * normal[axis]:.3f} m"
    return f"({', '.join(f'{x:.3f}' for x in normal)}) . x = {plane['offset_m']:.3f} m"


def _plan(
    planes: list[dict[str, Any]], points: dict[str, NDArray[Any]], width: float, height: float
) -> tuple[Figure, Axes]:
    """Return a panel with the planes and the fixed end in plan; planes that are not identifiable are dashed."""
    low, high = extent(planes, np.concatenate([points["measured"], points["fixed"][None]]))
    figure, plan = figures.panel(width, height)
    for plane in planes:
        ends = in_plan(plane, low - MARGIN, high + MARGIN)
        if ends is not None:
            plan.plot(*ends.T, "-" if plane["certain"] else "--", color="black", linewidth=1.3)
    plan.plot(*points["fixed"][:2], "*", color=FIXED, markersize=11, label="fixed end")
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return figure, plan


def extent(planes: list[dict[str, Any]], inside: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Opposite corners (3,) [m] of the room around positions (n, 3), as far as it is known."""
    low, high = inside.min(axis=0) - MARGIN, inside.max(axis=0) + MARGIN
    for plane in planes:
        normal = np.array(plane["normal"])
        axis = int(np.abs(normal).argmax())
        at = plane["offset_m"] / normal[axis]
        if abs(normal[axis]) > 0.99:
            low[axis], high[axis] = min(low[axis], at), max(high[axis], at)
    return low, high


def in_plan(plane: dict[str, Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[Any] | None:
    """Return both ends (2, 2) [m] of a plane's line through the box from `low` to `high` (3,), seen from above.

    The line is at half the height of the box. None for floors and ceilings.
    """
    nx, ny, nz = plane["normal"]
    if abs(nz) > 0.7:
        return None
    height = (low[2] + high[2]) / 2
    if abs(nx) >= abs(ny):
        y = np.array([low[1], high[1]])
        return np.stack([(plane["offset_m"] - ny * y - nz * height) / nx, y], axis=1)
    x = np.array([low[0], high[0]])
    return np.stack([x, (plane["offset_m"] - nx * x - nz * height) / ny], axis=1)


def located_plan(fraction: FractionRecords) -> Figure:
    """Return the plan of the room with a line from each test position to its estimate."""
    table, room = fraction.table("positions"), fraction.arrays("located")
    own = table[(table["method"] == LOCATED) & (table["repeat"] == 0)]
    truth, estimate = own[["truth_x_m", "truth_y_m"]].to_numpy(), own[["estimate_x_m", "estimate_y_m"]].to_numpy()
    planes = [
        {"normal": normal, "offset_m": offset, "certain": certain}
        for normal, offset, certain in zip(room["normal"], room["offset"], room["certain"], strict=True)
    ]
    figure, plan = _plan(planes, room, 4.6, 3.7)
    plan.plot(*room["measured"][:, :2].T, ".", color=figures.RULE, markersize=3)
    figures.errors_in_plan(plan, truth, estimate, 100 * own["error_m"].to_numpy(), "position error [cm]")
    return figure


def locating_section(fraction: FractionRecords) -> Section | None:
    """Return the errors of located test positions; None if nothing was located."""
    located = fraction.mix["locating"]
    if not located:
        return None
    rows = []
    for method, own in located.items():
        error_cm = {name: 100 * value for name, value in own["position_error_m"].items()}
        shares = [f"{own['coverage_80']:.0%}", f"{own['ambiguous']:.0%}"]
        rows.append([method, with_interval(error_cm, 1), number(error_cm["p90"], 1), *shares])
    columns = ["method", "median [cm]", "90 % [cm]", "in 80 % region", "ambiguous"]
    caption = (
        "Median distance between true and estimated position with its 95 % interval. Regions are balls around the estimate. "
        "Ambiguous: a second mode has at least a tenth of the posterior mass."
    )
    plots = [_posteriors(fraction)] if fraction.arrays("located") else []
    return Section("Positions", [], [Table(columns, rows, caption)], [*plots, _calibration(fraction)])


def _calibration(fraction: FractionRecords) -> Plot:
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
