"""The report of one localization run or several."""

from __future__ import annotations

import math

from pandas import concat

from swiftwrf.locate.baselines import LOCALIZERS
from swiftwrf.metrics import paired_difference
from tasks.environment import command
from tasks.labels import LOCALIZERS as LABELS
from tasks.labels import labels
from tasks.locate.page import drawing
from tasks.locate.page.summary import LEVEL, NEIGHBOURS, OWN, LocateRecords, by_method, conclusion, summary
from tasks.locate.steps import SUGGESTED
from tasks.page.page import Page, Plot, Section, Summary, Table, number, provenance, sections_of
from tasks.page.shared import Compared, comparison, suggestion_plot, with_interval, worth


def page(runs: list[LocateRecords]) -> Page:
    """Return the page of these runs."""
    terms = {name: label.meaning for name, label in labels(LOCALIZERS, LABELS).items()}
    sections = [
        sections_of("Position errors", runs, lambda run: _errors(run, several=len(runs) > 1), terms),
        sections_of("Posterior maps", runs, lambda run: Section("", plots=[_posteriors(run)])),
        sections_of("Calibration", runs, lambda run: Section("", _weights(run), plots=[_calibration(run)])),
        _limits(runs[0]),
    ]
    if any(run.holds(SUGGESTED) for run in runs):
        sections.insert(3, sections_of("Where to measure next", runs, _suggestion))
    details = []
    if any(run.metrics["by_rows"] or run.metrics["by_receivers"] for run in runs):
        details.append(sections_of("Errors against training rows and receivers", runs, _studies))
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    first = summary(runs[0], _overview(runs[0], "summary")) if len(runs) == 1 else _comparison(runs)
    return Page(f"Localization: {names}", first, sections, [*details, provenance(runs)])


def _comparison(runs: list[LocateRecords]) -> Summary:
    """Return the first screen of several runs."""
    compared = []
    for run in runs:
        found = {name: entry["position_error_m"] for name, entry in run.metrics["overall"].items()}
        further = {"in 80 % region": f"{run.metrics['calibration'][str(LEVEL)]:.0%}"}
        compared.append(Compared(f"{run.number}: {run.place}", found, further))
    shown = [name for name in (OWN, *NEIGHBOURS, "mean") if any(name in one.errors for one in compared)]
    table, plot = comparison(compared, drawing.palette(), shown, "m", "position error")
    meaning = [f"Run {run.number}, {run.place}: {conclusion(run)}" for run in runs]
    steps = [f"Explore run {run.number}: `{command('view', run.path)}`." for run in runs]
    return Summary([], [plot], meaning, steps, table=table)


def _errors(run: LocateRecords, several: bool) -> Section:
    n_undetected = run.metrics["n_undetected"]
    notes = [f"Test rows that no receiver detected are left out: {n_undetected}."] if n_undetected else []
    overview = [_overview(run, f"overview-{run.file_name}")] if several else []
    return Section("", notes, [_table(run), _paired(run)], overview)


def _suggestion(run: LocateRecords) -> Section | None:
    if not run.holds(SUGGESTED):
        return None
    arrays = run.arrays(SUGGESTED)
    left = arrays["left"]
    text = (
        f"Measuring at {len(arrays['suggested'])} more positions ({SUGGESTED}.csv, the most useful first) would reduce the "
        f"variance of the radio maps from {left[0]:.0%} to {left[-1]:.0%} of the field's variance. The mean over the region "
        "is weighted by the expected squared position error. Errors are those of simulated rows under the fitted maps. "
        f"{worth(left)}"
    )
    plot = suggestion_plot(f"suggested-{run.file_name}", arrays, "weighted variance left [%]")
    return Section("", [text], plots=[plot])


def _overview(run: LocateRecords, name: str) -> Plot:
    caption = (
        "Left: position errors of the posterior in plan, a line from each true position (dot) to its estimate, coloured by "
        "the error. Right: distribution of the position errors of all localizers."
    )
    columns = ["method", "index", "position_error_m", "truth_x_m", "truth_y_m", "x_m", "y_m"]
    return Plot(name, drawing.overview(run.table("errors")), caption, run.table("errors")[columns])


def _table(run: LocateRecords) -> Table:
    rows = []
    for name, entry in run.metrics["overall"].items():
        error, horizontal = entry["position_error_m"], entry["horizontal_error_m"]
        seconds = f"{number(entry['seconds']['fit'])} + {number(entry['seconds']['predict'])}"
        rows.append(
            [
                name,
                with_interval(error),
                number(error["p90"]),
                number(error["mean"]),
                number(horizontal["median"]),
                seconds,
                *([f"{entry['floor_hit_rate']:.1%}"] if "floor_hit_rate" in entry else []),
            ]
        )
    columns = ["localizer", "median [m]", "90 % [m]", "mean [m]", "median in plan [m]", "fit + locate [s]"]
    if rows and len(rows[0]) > len(columns):
        columns.append("floors right")
    return Table(columns, rows, "Position error of the test rows; median with its 95 % interval.", frozenset([OWN]))


def _paired(run: LocateRecords) -> Table:
    errors, rows = by_method(run), []
    for name in run.metrics["overall"]:
        if name != OWN:
            mean, low, high = paired_difference(errors, OWN, name)
            interval = "" if math.isnan(low) else f" [{low:+.2f}, {high:+.2f}]"
            rows.append([name, f"{mean:+.2f}{interval}"])
    caption = "Mean of the posterior's position error minus that of the localizer on the same rows; 95 % bootstrap."
    return Table(["against", "difference [m]"], rows, caption)


def _weights(run: LocateRecords) -> list[str]:
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in run.metrics["weights"].items())
    return [
        f"Weights of the posterior's likelihoods, which maximise the density at held-out training positions: {weights}. A "
        "weight below 1 widens the posterior."
    ]


def _calibration(run: LocateRecords) -> Plot:
    caption = (
        "Fraction of the true positions inside the posterior's credible regions (dots; bars: 95 % interval) against their "
        "probability. On the line the posterior is calibrated, below it the regions are too small."
    )
    data = drawing.coverage(run.metrics["calibration"], run.metrics["n_test"])
    return Plot(f"calibration-{run.file_name}", [drawing.calibration(data)], caption, data)


def _studies(run: LocateRecords) -> Section | None:
    if not (run.metrics["by_rows"] or run.metrics["by_receivers"]):
        return None
    caption = (
        "Median position error (bars: 95 % interval) of localizers fitted to a random part of the training rows, and with a "
        "random part of the receivers."
    )
    rows, receivers = drawing.study_table(run.metrics["by_rows"]), drawing.study_table(run.metrics["by_receivers"])
    data = concat([rows, receivers]).drop_duplicates()
    plot = Plot(f"studies-{run.file_name}", drawing.studies(rows, receivers), caption, data)
    return Section("", plots=[plot])


def _posteriors(run: LocateRecords) -> Plot:
    caption = (
        "Posteriors of six test rows in plan, from the smallest error to the largest, each relative to its largest mass. "
        "Cross: true position; dot: estimate; circle: 80 % credible region; small dots: training positions."
    )
    maps = run.arrays("maps")
    return Plot(f"posteriors-{run.file_name}", drawing.posteriors(maps), caption, drawing.posterior_cells(maps))


def _limits(run: LocateRecords) -> Section:
    texts = [
        "Rows that no receiver detected have no position. They are left out of the errors.",
        "Candidate positions lie in and around the training positions. A transmitter elsewhere is located at their edge.",
        "Intervals of medians treat test rows as independent. Along a walked path they are not, and the intervals are too "
        "narrow.",
        "Training and test rows are of one device and one time, unless the split separates these. Another device has "
        "another offset, which --offset-by COLUMN estimates if the table names devices.",
    ]
    if run.metrics["data"] == "simulated-floor":
        texts.append(
            "This floor is simulated. It shows that the software works, and not how accurate it is on measurements."
        )
    return Section("What this does not show", texts)
