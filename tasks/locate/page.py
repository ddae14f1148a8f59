"""The report of one localization run or several."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from pandas import DataFrame, crosstab
from scipy.stats import binomtest

from swiftwrf.contrib.comparison.localizers import LOCALIZERS
from swiftwrf.data.rooms import OUTSIDE
from swiftwrf.metrics import LEVEL
from swiftwrf.plotting import corners_of
from tasks import labels
from tasks.locate.placement import poses_section
from tasks.page import figures
from tasks.page.maps import FloorPlan
from tasks.page.page import Number, Page, Plot, Section, Summary, Table, number, provenance, sections_of
from tasks.page.receivers import receivers_section
from tasks.page.shared import (
    again,
    by_method,
    compared,
    comparison_sentence,
    coverage_warning,
    difference,
    errors_section,
    limits,
    maps_suggestion,
    next_steps,
    recommendation,
)
from tasks.records import RECEIVERS, SUGGESTED, Records, notes
from tasks.terminal import Answer, Method, NextStep

OWN = "posterior"  # the localizer that all others are compared with
BASELINES = {
    "receiver": (("knn", "knn_difference"), "the best nearest-neighbour fingerprinting"),
    "station": (("triangulation", "triangulation_matched", "knn"), "the best baseline"),
}  # by what receives: localizers without a model of the scene, and what they are together
OF_STATIONS = ("stations", "alone_estimate", "alone_radius_80_m")
STATIONS_TEXT = "; triangles: stations; dashed circles of their colours: 80 % credible regions by each station alone."
TRUTH, ESTIMATE = "#cf4a4a", "#b07b10"
MIN_SHOWN = 0.01  # density relative to its maximum from which on a map shows it
COLUMNS = ["index", "place", "method", "position_error_m"]  # of the errors of methods
COLOURS = labels.LOCALIZERS
LIMITS_OF_STATIONS = (
    "Candidate positions lie in and around the training positions. A transmitter elsewhere is located at their edge.",
    "Positions and orientations of the stations are taken as given. An error of a station's pose is an error of its room.",
    "Training and test transmissions are of one time, unless the split separates these.",
)
LIMITS = (
    "Rows that no receiver detected have no position. They are left out of the errors.",
    "Candidate positions lie in and around the training positions. A transmitter elsewhere is located at their edge.",
    "Training and test rows are of one device and one time, unless the split separates these. Another device has "
    "another offset, which --offset-by COLUMN estimates if the table names devices.",
)


def page(runs: list[Records]) -> Page:
    """Return the page of these runs."""
    answers = {run: answer(run) for run in runs}
    sections = [
        sections_of("Where was it?", runs, lambda run: _posteriors(run, several=len(runs) > 1)),
        sections_of("Errors", runs, lambda run: _errors(run, answers[run]), labels.meanings(LOCALIZERS)),
        sections_of("How sure is it?", runs, lambda run: Section("", plots=[_calibration(run)])),
        limits(runs[0], *(LIMITS if runs[0].metrics["received_by"] == "receiver" else LIMITS_OF_STATIONS)),
    ]
    if any(run.metrics.get("rooms") for run in runs):
        sections.insert(1, sections_of("Which room?", runs, _rooms))
    if runs[0].metrics["received_by"] == "receiver" and any(run.arrays(SUGGESTED) for run in runs):
        sections.insert(-1, sections_of("Where to measure next", runs, _suggestion))
    if any(run.arrays(RECEIVERS) for run in runs):
        sections[0].parts.append(sections_of("Where the receivers are", runs, receivers_section))
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(runs) == 1:
        first = _summary(runs[0], answers[runs[0]])
    else:
        named = {f"{run.number}: {run.place}": one for run, one in answers.items()}
        first = compared(named, runs, COLOURS, "position error")
    return Page(f"Localization: {names}", first, sections, [provenance(runs)], answer=answers[runs[0]])


def _summary(run: Records, found: Answer) -> Summary:
    error = {name: entry["position_error_m"]["median"] for name, entry in run.metrics["overall"].items()}
    names, described = BASELINES[run.metrics["received_by"]]
    nearest = min(names, key=lambda name: error[name])
    numbers = [
        Number(f"{error[OWN]:.2f} m", "median position error of the posterior"),
        Number(f"{error[nearest]:.2f} m", f"that of {nearest}, {described}"),
        Number(f"{run.metrics['calibration'][str(LEVEL)]:.0%}", f"of the true positions in their {LEVEL:.0%} region"),
    ]
    return Summary(numbers, [_overview(run, "summary")], found.conclusion, found.next_steps, notes=notes(run))


def _errors(run: Records, found: Answer) -> Section:
    n_undetected = run.metrics.get("n_undetected", 0)
    section = errors_section(
        found,
        run.table("errors")[COLUMNS],
        COLOURS,
        name=run.file_name,
        quantity="position error",
        caption=f"Column of {OWN}: difference of the mean errors on the same rows, with its 95 % bootstrap interval over "
        "test places.",
        paragraphs=[f"Test rows that no receiver detected are left out: {n_undetected}."] if n_undetected else [],
    )
    if run.metrics["received_by"] == "station":
        section.parts.append(_directions(run))
    return section


def _directions(run: Records) -> Section:
    """Return the angular errors at each station, and poses of a next one."""
    table = run.table("directions")
    rows = [
        [str(name), str(count), *(f"{value:.2f}" for value in values)]
        for name, count, *values in table.itertuples(index=False)
    ]
    heads = ["station", "received", "posterior of all [deg]", "posterior of this station alone [deg]", "peak [deg]"]
    text = (
        "Median angular errors of the direction of the transmitter. A position found by all stations determines each."
    )
    poses = poses_section(run.arrays(SUGGESTED), SUGGESTED, run.file_name)
    return Section(
        "Directions at each station", paragraphs=[text], tables=[Table(heads, rows)], parts=[poses] if poses else []
    )


def _rooms(run: Records) -> Section | None:
    """Return how often the most probable room is the true one, and which rooms are taken for which."""
    if not run.metrics.get("rooms"):
        return None
    table = run.table("rooms")
    counts = crosstab(table["truth_room"], table["room"])
    names = [name for name in [*run.metrics["rooms"], OUTSIDE] if name in counts.index or name in counts.columns]
    counts = counts.reindex(index=names, columns=names, fill_value=0)
    rows = [
        [name, *(str(count) if count else "" for count in row)]
        for name, row in zip(names, counts.to_numpy(), strict=True)
    ]
    caption = (
        "Test rows by their true room (row) and the most probable room (column). `rooms.csv` contains the probability of "
        "each room."
    )
    return Section("", [_rooms_sentence(run)], [Table(["true room", *names], rows, caption)])


def _rooms_sentence(run: Records) -> str:
    table = run.table("rooms")
    right, mean = (table["room"] == table["truth_room"]).mean(), table["room_probability"].mean()
    return (
        f"The most probable room is the true one in {right:.0%} of {len(table)} test rows; the mean of its probability is "
        f"{mean:.0%}."
    )


def _suggestion(run: Records) -> Section | None:
    return maps_suggestion(
        run,
        "The mean over the region is weighted by the expected squared position error. Errors are those of simulated "
        "rows under the fitted maps.",
    )


def _overview(run: Records, name: str) -> Plot:
    errors = run.table("errors")
    figure, plan = figures.panel(5.4, 4.2)
    own = errors[errors["method"] == OWN]
    truth, estimate = own[["truth_x_m", "truth_y_m"]].to_numpy(), own[["x_m", "y_m"]].to_numpy()
    figures.errors_in_plan(plan, truth, estimate, own["position_error_m"].to_numpy(), "position error [m]")
    if (floor := FloorPlan.load(run.folder)) is not None:
        floor.draw(plan)
    caption = (
        "Errors of the posterior in plan: a line from each true position (dot) to its estimate, coloured by the error."
    )
    columns = ["method", "index", "position_error_m", "truth_x_m", "truth_y_m", "x_m", "y_m"]
    return Plot(name, [figure], caption, errors[columns])


def _calibration(run: Records) -> Plot:
    """Return measured against nominal coverage, with its 95 % interval (Wilson), as if each place were one row."""
    rows, n = [], run.table("errors")["place"].nunique()
    for level, value in run.metrics["calibration"].items():
        interval = binomtest(round(value * n), n).proportion_ci(method="wilson")
        rows.append((float(level), value, float(interval.low), float(interval.high)))
    data = DataFrame(rows, columns=["nominal", "measured", "low", "high"])
    figure, axes = figures.panel(5, 3.2)
    axes.plot([0, 1], [0, 1], color=figures.RULE, linewidth=1)
    bars = np.clip([data["measured"] - data["low"], data["high"] - data["measured"]], 0, None)
    style: dict[str, Any] = {"color": labels.colour(COLOURS, OWN), "linewidth": 1.4, "elinewidth": 0.8}
    axes.errorbar(data["nominal"], data["measured"], yerr=bars, marker="o", markersize=4, label=OWN, **style)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.set(xlabel="probability of the credible region", ylabel="fraction of test positions inside")
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in run.metrics["weights"].items())
    caption = (
        "Fraction of the true positions inside the posterior's credible regions (dots; bars: 95 % interval) against their "
        "probability. On the line the posterior is calibrated, below it the regions are too small. Weights of the "
        f"likelihoods, which maximise the density at held-out training positions: {weights}."
    )
    return Plot(f"calibration-{run.file_name}", [figure], caption, data)


def _posteriors(run: Records, several: bool) -> Section:
    maps = run.arrays("maps")
    index, ys, xs = (a.ravel() for a in np.meshgrid(maps["index"], maps["y"], maps["x"], indexing="ij"))
    density = maps["density"].ravel()
    data = DataFrame({"index": index, "x_m": xs.round(3), "y_m": ys.round(3), "relative_density": density.round(4)})
    caption = (
        f"Posteriors of {len(maps['index'])} test rows in plan, from the smallest error to the largest, each relative to "
        "its largest mass. Cross: true position; dot: estimate; circle: 80 % credible region; small dots: training "
        "positions" + (STATIONS_TEXT if "stations" in maps else ".")
    )
    panels = posteriors(maps, FloorPlan.load(run.folder))
    plot = Plot(f"posteriors-{run.file_name}", panels, caption, data[np.isfinite(density)])
    return Section("", plots=[plot, *([_overview(run, f"overview-{run.file_name}")] if several else [])])


def posteriors(maps: Mapping[str, NDArray[Any]], plan: FloorPlan | None = None) -> list[Figure]:
    """Draw the posteriors of some test rows in plan, a panel each, above the image of the floor."""
    shape = float(np.clip(np.ptp(maps["y"]) / max(np.ptp(maps["x"]), 1e-9), 0.4, 1.6))
    extent = corners_of(maps["x"], maps["y"])
    panels = []
    for i in range(len(maps["density"])):
        figure, ax = figures.panel(3.8, 0.6 + 2.8 * shape)
        truth, estimate = maps["truth"][i], maps["estimate"][i]
        style: dict[str, Any] = {"cmap": "Blues", "vmin": 0, "vmax": 1, "alpha": 1.0 if plan is None else 0.75}
        density = np.where(maps["density"][i] > MIN_SHOWN, maps["density"][i], np.nan)
        drawn = ax.imshow(density, origin="lower", extent=extent, zorder=1, **style)
        if plan is not None:
            plan.draw(ax)
        ax.plot(*maps["training_position"].T[:2], ".", color="#888888", markersize=1, rasterized=True)
        if "stations" in maps:
            for colour, *of_station in zip(labels.OTHER_COLOURS, *(maps[name] for name in OF_STATIONS), strict=False):
                place, alone, radius = of_station
                ax.plot(*place[:2], "^", color=colour, markersize=7, clip_on=False)
                style = {"fill": False, "color": colour, "linewidth": 0.8, "linestyle": "--"}
                ax.add_patch(Circle(alone[i][:2], radius[i], **style))
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


def answer(run: Records) -> Answer:
    """Return the answer of a run."""
    chosen, _ = recommendation(run, OWN, "m")
    errors, methods = by_method(run.table("errors")[COLUMNS]), []
    for name, entry in run.metrics["overall"].items():
        cells = {"median in plan [m]": number(entry["horizontal_error_m"]["median"])}
        cells |= {"floors right": f"{entry['floor_hit_rate']:.1%}"} if "floor_hit_rate" in entry else {}
        cells |= {f"{OWN} minus it [m]": difference(errors, OWN, name)}
        seconds = entry["seconds"]["fit"], entry["seconds"]["predict"]
        is_reference = name == "mean" != chosen
        methods.append(Method(name, entry["position_error_m"], is_reference, seconds, cells))
    return Answer("m", methods, chosen, conclusion(run), _steps(run), BASELINES[run.metrics["received_by"]][0])


def conclusion(run: Records) -> list[str]:
    """Return the position error, how sure it is, and how the posterior compares with the best other localizer."""
    error = {name: entry["position_error_m"] for name, entry in run.metrics["overall"].items()}
    best = min((name for name in error if name != OWN), key=lambda name: error[name]["median"])
    own, n_test = error[OWN], run.metrics["n_test"]
    receivers = f"{run.metrics['n_receivers']} {run.metrics['received_by']}{'s' * (run.metrics['n_receivers'] > 1)}"
    return [
        *recommendation(run, OWN, "m")[1],
        f"Positions are found within {own['median']:.2f} m (median error; 90 % within {own['p90']:.1f} m).",
        f"The median's 95 % interval is {own['low']:.2f} to {own['high']:.2f} m, and "
        f"{run.metrics['calibration'][str(LEVEL)]:.0%} of the true positions lie in the {LEVEL:.0%} region that comes with "
        f"each estimate. Tested on {n_test} rows, fitted to {run.metrics['n_train']} rows at {receivers}; "
        f"{run.scene}.",
        *([_rooms_sentence(run)] if run.metrics.get("rooms") else []),
        comparison_sentence(
            by_method(run.table("errors")[COLUMNS]),
            OWN,
            best,
            name="the posterior",
            unit="m",
            rows="rows",
        ),
    ]


def _steps(run: Records) -> list[NextStep]:
    own, coverage = [], run.metrics["calibration"][str(LEVEL)]
    if warning := coverage_warning("credible regions", coverage, LEVEL, run.table("errors")["place"].nunique()):
        own.append(NextStep(warning))
    if run.metrics["split"] == "random":
        own.append(again(run, "Test a region where nothing was measured", "block"))
    return next_steps(run, "Explore posteriors and maps", "Locate new observations", "SOURCE", own)
