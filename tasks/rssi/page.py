"""The report of one RSSI run or several."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from matplotlib.figure import Figure

from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.errors import paired_difference
from swiftwrf.contrib.comparison.leave_one_out import LEAVE_ONE_OUT
from swiftwrf.data.splits import places
from swiftwrf.metrics import LEVEL
from swiftwrf.models.prediction import difference_unit, suffix
from tasks.labels import PREDICTORS, colour, meanings
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, number, provenance, sections_of
from tasks.page.receivers import receivers_section, receivers_sentence
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
from tasks.rssi import coverage
from tasks.rssi.differences import where_methods_differ
from tasks.rssi.maps import MIN_RATIO, WIDTH_PER_STD, Maps
from tasks.terminal import Answer, Method, NextStep

COLUMNS = ["index", "place", "receiver", "method", "abs_error_db"]  # of the errors of methods
COLOURS = PREDICTORS
REFERENCES = ("mean", "mri_pooled")  # which explain no place
MIN_POSITIONS = 30  # for an interval of one width to show that more positions do not help
MIN_REPEATS = 10  # of measurements at one place
MAX_RATIO_TO_SCATTER = 1.3  # of an interval to the one of repeated measurements, which then explain it
MAX_RECEIVERS = 40  # of the figure of differences; all are in its table
LIMITS = (
    "Single packets scatter about the mean of their position. BLE packets of unknown channel scatter by 2 to 3 dB. No "
    "predictor of the mean has a lower error than this scatter.",
    "Errors are those of detected values. How well empty cells are predicted is a number of its own, and where a packet "
    "is more likely lost than received the maps are hatched.",
    "The paper's table (2.91 dB for SwiftWRF, 6.74 dB for MRI) is of other data. Compare methods in this report only.",
)


def page(runs: list[Records]) -> Page:
    """Return the page of these runs."""
    answers = {run: answer(run) for run in runs}
    covered = sections_of("Coverage", runs, coverage.section)
    first_sections = [covered] if covered.tables or covered.parts else []
    sections = [
        *first_sections,
        sections_of("Errors", runs, lambda run: _errors(run, answers[run]), meanings(RSSI_PREDICTORS)),
        limits(runs[0], *(LIMITS if Maps(runs[0]).quantity == "RSSI" else ())),
    ]
    if any(run.arrays(RECEIVERS) for run in runs):
        sections.insert(-1, sections_of("Where the receivers are", runs, receivers_section))
    if any(run.arrays(SUGGESTED) for run in runs):
        sections[0].parts.append(sections_of("Where to measure next", runs, _suggestion))
    details = [provenance(runs)]
    if len(runs) > 1 or any(len(Maps(run).names) > 1 or Maps(run).suffix for run in runs):
        sections.insert(len(first_sections), sections_of("Maps", runs, partial(_maps, kind="predicted")))
        by_receiver = sections_of("Errors by receiver", runs, lambda run: Section("", plots=_differences(run)))
        widths = sections_of("Widths of the intervals", runs, partial(_maps, kind="width"))
        details[:0] = [by_receiver, *([widths] if widths.all_plots else [])]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(runs) == 1:
        first = _summary(runs[0], answers[runs[0]])
    else:
        named = {f"{run.number}: {run.place}": one for run, one in answers.items()}
        first = compared(named, runs, COLOURS, "absolute error")
    return Page(f"{Maps(runs[0]).quantity}: {names}", first, sections, details, answer=answers[runs[0]])


def _summary(run: Records, found: Answer) -> Summary:
    floors, interval = Maps.of_floors(run), run.metrics["interval"]
    error = {name: entry["abs_error_db"] for name, entry in run.metrics["overall"].items()}
    best = best_baseline(run)
    unit = floors[0].error_unit
    covered = [(maps, maps.coverage["covered"]) for maps in floors]
    with_coverage = [maps for maps in floors if maps.has_coverage]
    numbers = [
        *(Number(f"{share:.0%}", f"of {maps.place} {maps.limit}") for maps, share in covered if share is not None),
        Number(f"{error[found.chosen]['median']:.2f} {unit}", f"median absolute error of {found.chosen}"),
        Number(f"{error[best]['median']:.2f} {unit}", f"that of {best}, the best other method"),
        Number(f"{interval['coverage']:.0%}", f"of the test measurements in their {interval['nominal']:.0%} interval"),
    ]
    plots = [Maps.coverage_plot(with_coverage)] if with_coverage else []
    plots += [maps.summary() for maps in floors if len(floors) == 1]
    return Summary(numbers, plots, found.conclusion, found.next_steps, notes=notes(run))


def _suggestion(run: Records) -> Section | None:
    return maps_suggestion(
        run,
        "The mean over the walked area is weighted by p (1 - p), where p is the probability that a scan has a receiver "
        "beyond the threshold of the coverage.",
    )


def _maps(run: Records, kind: str) -> Section:
    """Return the maps of the strongest receivers of each floor, the others folded."""
    floors = Maps.of_floors(run)
    parts = []
    for maps in floors:
        first = [maps.summary()] if len(floors) > 1 and kind == "predicted" else []
        part = Section(maps.name if maps.suffix else "", plots=[*first, *filter(None, [maps.by_receiver(kind)])])
        if kind == "predicted" and (more := maps.by_receiver(kind, first=False)) is not None:
            part.parts.append(Section("More receivers", plots=[more], folded=True))
        parts.append(part)
    return Section("", parts=parts) if len(floors) > 1 else parts[0]


def _errors(run: Records, found: Answer) -> Section:
    caption = (
        f"Column of {model_of(run)}: difference of the mean absolute errors on the same measurements, with its 95 % "
        "bootstrap interval over test places. Over splits: mean and standard deviation of the median error. Detection: "
        "mean of the fractions of detected and of empty test cells that are predicted as such; 0.5 is chance."
    )
    section = errors_section(
        found,
        run.in_files(run.table("errors")[COLUMNS]),
        COLOURS,
        name=run.file_name,
        quantity="absolute error",
        caption=caption,
        paragraphs=[f"Left out: {reason}." for reason in run.metrics["left_out"].values() if Maps(run).unit == "dBm"],
        panels=_by_rows(run),
    )
    section.tables.append(where_methods_differ(run, found))
    section.parts.append(Section("Where the errors are", plots=[_where(run)]))
    return section


def answer(run: Records) -> Answer:
    """Return the answer of a run."""
    own, errors, methods = model_of(run), by_method(run.table("errors")[COLUMNS]), []
    unit = Maps(run).error_unit
    chosen = recommendation(run, own, unit)[0]
    scored = any(entry.get("detection") for entry in run.metrics["overall"].values())
    for name, entry in run.metrics["overall"].items():
        detection = entry.get("detection")
        cells = {f"{own} minus it [{unit}]": difference(errors, own, name)}
        if (over := run.metrics.get("repeats", {}).get(name)) is not None:
            cells[f"over {over['n']:.0f} splits [{unit}]"] = f"{over['median_mean']:.2f} ± {over['median_std']:.2f}"
        cells |= {"detection": number(None if detection is None else sum(detection) / 2)} if scored else {}
        seconds = entry["seconds"]["fit"], entry["seconds"]["predict"]
        methods.append(Method(name, entry["abs_error_db"], name in REFERENCES and name != chosen, seconds, cells))
    return Answer(unit, methods, chosen, conclusion(run), steps(run), (own, best_baseline(run)))


def model_of(run: Records) -> str:
    """Return the predictor that all others are compared with, whose maps and intervals the run contains."""
    return str(run.metrics["model"])


def best_baseline(run: Records) -> str:
    """Return the name of the baseline with the lowest median error."""
    error: dict[str, float] = {
        name: float(entry["abs_error_db"]["median"]) for name, entry in run.metrics["overall"].items()
    }
    return min((name for name in error if name != model_of(run)), key=error.__getitem__)


def conclusion(run: Records) -> list[str]:
    """Return coverage and error, how sure they are, and how the model compares with the best baseline."""
    best, interval = best_baseline(run), run.metrics["interval"]
    own, floors = model_of(run), Maps.of_floors(run)
    unit = floors[0].error_unit
    error, table = run.metrics["overall"][own]["abs_error_db"], run.table("errors")
    errors = by_method(table[COLUMNS])
    near = table[table["method"] == own]["from_training_m"].median()
    tested = (
        f"Tested on {error['n']} measurements, half of them within {near:.1f} m of one of the {run.metrics['n_train']} rows "
        f"of the fit ({run.scene})."
    )
    if run.metrics["split"] == LEAVE_ONE_OUT:
        count = errors.index.get_level_values("place").nunique()
        tested = (
            f"All others predict each of {count} positions, {error['n']} measurements in all ({run.scene}). Errors and "
            "intervals of so few positions vary by chance."
        )
    sure = (
        f"Predictions are within {error['median']:.1f} {unit} (median error), 90 % of the errors are below "
        f"{error['p90']:.1f} {unit}, and {interval['coverage']:.0%} of the measurements lie in their "
        f"{interval['nominal']:.0%} intervals. {tested}"
    )
    compared = comparison_sentence(errors, own, best, name=own, unit=unit, rows="measurements")
    covered = [coverage.coverage_sentence(maps.coverage, f"{maps.who} {maps.limit}", maps.place) for maps in floors]
    return [
        *recommendation(run, own, unit)[1],
        *filter(None, [*covered, coverage.bands_sentence(run), coverage.spots_sentence(floors)]),
        *filter(None, [coverage.held_out_sentence(run), coverage.why(run)]),
        sure,
        compared,
        *receivers_sentence(run),
        *repeats_sentence(run),
    ]


def repeats_sentence(run: Records) -> list[str]:
    """Return mean and standard deviation over splits of the median errors of the model and the best baseline."""
    found, names, unit = run.metrics.get("repeats", {}), (model_of(run), best_baseline(run)), Maps(run).error_unit
    over = [
        f"{name} {found[name]['median_mean']:.2f} {unit} (standard deviation {found[name]['median_std']:.2f})"
        for name in names
        if name in found
    ]
    return [f"Median errors over {found[names[0]]['n']:.0f} splits: {', '.join(over)}."] if over else []


def steps(run: Records) -> list[NextStep]:
    """Return what to do next."""
    interval = run.metrics["interval"]
    pairs = model_of(run) == "pairs"  # its maps depend on both ends, and the page shows one
    own = [NextStep(where_next(run))]
    unknown = int(np.isnan(run.arrays("maps")["receiver"]).any(axis=1).sum())
    if unknown and Maps(run).quantity == "RSSI":
        text = f"Give the unknown positions of access points ({unknown}), in `receivers.csv` beside the table"
        estimated = f"{text}: begin with the estimates in {run.path}/{RECEIVERS}.csv, and correct those that you know"
        own.insert(0, NextStep(estimated) if run.arrays(RECEIVERS) else NextStep(text, "receiver,x,y,z"))
    n_places = run.table("errors")["place"].nunique()
    if warning := coverage_warning("intervals", interval["coverage"], interval["nominal"], n_places):
        own.append(NextStep(warning))
    if pairs and run.metrics["split"] != "place":
        own.append(again(run, "Test receivers at positions where they measured nothing", "place"))
    elif run.metrics["split"] == "random":
        own.append(again(run, "Test a region where nothing was measured", "block"))
    explore = "" if pairs else "Explore maps and coverage"
    return next_steps(run, explore, "Predict at other positions, with intervals", "positions.csv", own)


def where_next(run: Records) -> str:
    """Return where to measure next, between the scans, or that more positions hardly help."""
    floors = Maps.of_floors(run)
    if not any(maps.arrays["inside"].any() for maps in floors):
        return "Measure in a second dimension: the measured positions lie on a line."
    if varied := [maps for maps in floors if maps.varies]:
        widest = []
        for maps in varied:
            x, y, width, typical = maps.widest
            at = f"x = {x:.1f} m, y = {y:.1f} m{f' on {maps.name}' if maps.suffix else ''}"
            widest.append(f"{at} ({maps.amount(width)} instead of {maps.amount(typical)})")
        best = " of the best receiver" if len(floors[0].names) > 1 else ""
        return f"Measure around {', '.join(widest)}: the {LEVEL:.0%} interval{best} is widest there."
    if (n := int(places(torch.from_numpy(run.arrays("maps")["measured_position"])).max()) + 1) < MIN_POSITIONS:
        return f"Measure at more positions: {n} are too few to show how {floors[0].quantity} varies between them."
    typical, scatter = max(maps.widest[3] for maps in floors), scatter_of_repeats(run)
    reason = "and the model explains no more"
    if scatter is not None and typical < MAX_RATIO_TO_SCATTER * scatter:
        reason = "which is the scatter of repeated measurements at one place"
    elif scatter is not None:
        reason += f", though repeated measurements at one place lie within {floors[0].amount(scatter)}"
    return (
        f"More positions between the scans would hardly narrow the {LEVEL:.0%} interval: it is about "
        f"{floors[0].amount(typical)} wide, and less than {MIN_RATIO:g} times as wide in any place, {reason}."
    )


def scatter_of_repeats(run: Records) -> float | None:
    """Return the width of the 80 % interval of repeated measurements at one place [dB], None if there are too few."""
    table = run.table("predictions")
    place = places(torch.tensor(table[["x", "y", "z"]].to_numpy(dtype=float)))
    same = table.groupby([place.numpy(), "receiver"])["measured"]
    repeats = same.count() - 1
    n = int(repeats.clip(lower=0).sum())
    return float(WIDTH_PER_STD * np.sqrt((same.var() * repeats).sum() / n)) if n >= MIN_REPEATS else None


def _by_rows(run: Records) -> list[Figure]:
    """Return the errors by the number of training rows, none if the rows are too few for parts of them."""
    found = run.metrics["by_rows"]
    if len(found) < 2:
        return []
    names = list(next(iter(found.values())))
    figure, axes = figures.panel(5.6, 3.2)
    lines = {name: ([int(n) for n in found], [row[name] for row in found.values()]) for name in names}
    figures.curves(axes, COLOURS, lines, "training rows", f"mean absolute error [{Maps(run).error_unit}]")
    axes.set_ylim(0, None)
    return [figure]


def _differences(run: Records) -> list[Plot]:
    """Return the difference of the model's error from the best baseline's at each receiver, none for one receiver."""
    if len(run.metrics["receivers"]) < 2:
        return []
    own, best, errors = model_of(run), best_baseline(run), by_method(run.table("errors")[COLUMNS])
    found = {}
    for name in run.metrics["receivers"]:
        at_receiver = errors[errors.index.get_level_values("receiver") == name].dropna(subset=[own, best])
        if len(at_receiver):
            found[name] = paired_difference(at_receiver, own, best)
    names = sorted(found, key=lambda name: found[name][0])
    shown, values = names[:MAX_RECEIVERS], {own: [found[name] for name in names]}
    label = f"{own} minus {best}, mean absolute error [{Maps(run).error_unit}]"
    figure = figures.dots(shown, {own: values[own][: len(shown)]}, COLOURS, label, zero=True)
    caption = (
        f"Difference of the mean absolute error of {own} from that of {best}, the best baseline, at each receiver on "
        f"the same measurements; whiskers: 95 % intervals. Below zero {own} is better."
    )
    data = figures.dots_data("receiver", names, values, suffix(Maps(run).error_unit))
    return [Plot(f"difference-{run.file_name}", [figure], caption, data)]


def _where(run: Records) -> Plot:
    """Return predicted against measured RSSI, and the error against distances."""
    errors = run.table("errors")
    own = errors[errors["method"] == model_of(run)]
    own_colour, many = colour(COLOURS, model_of(run)), len(own) >= figures.MAX_VECTOR_MARKS
    columns = {
        "from_receiver_m": "distance from the receiver [m]",
        "from_training_m": "distance from training positions [m]",
    }
    columns = {column: label for column, label in columns.items() if own[column].notna().any()}
    first, ax = figures.panel(4, 3.4)
    ax.plot(own["measured_dbm"], own["predicted_dbm"], ".", markersize=2, color=own_colour, rasterized=many)
    ends = [own["measured_dbm"].min(), own["measured_dbm"].max()]
    ax.plot(ends, ends, color=figures.RULE, linewidth=1)
    unit = Maps(run).unit
    ax.set(xlabel=f"measured [{unit}]", ylabel=f"predicted [{unit}]")
    panels = [first]
    for column, label in columns.items():
        panel, ax = figures.panel(4, 3.4)
        ordered = own.sort_values(column)
        ax.plot(ordered[column], ordered["abs_error_db"], ".", markersize=2, color=figures.RULE, rasterized=many)
        median = ordered["abs_error_db"].rolling(max(len(ordered) // 5, 1), center=True).median()
        ax.plot(ordered[column], median, color=own_colour, linewidth=2)
        ax.set(xlabel=label, ylabel=f"absolute error [{difference_unit(unit)}]")
        panels.append(panel)
    caption = (
        f"Predicted against measured {Maps(run).quantity}, and the absolute error (dots; line: running median) against "
        "the distance from the receiver, if its position is known, and from the nearest training position. All receivers."
    )
    data = run.in_files(own[["receiver", "index", "measured_dbm", "predicted_dbm", "abs_error_db", *columns]])
    return Plot(f"where-{run.file_name}", panels, caption, data)
