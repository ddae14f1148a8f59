"""The report of one localization run or several."""

from __future__ import annotations

from pandas import concat

from swiftwrf.locate.baselines import LOCALIZERS
from tasks.labels import LOCALIZERS as LABELS
from tasks.labels import labels
from tasks.locate.page import drawing
from tasks.locate.page.summary import LEVEL, NEIGHBOURS, OWN, LocateRecords, answer
from tasks.locate.steps import SUGGESTED
from tasks.page.page import Number, Page, Plot, Section, Summary, provenance, sections_of
from tasks.page.records import notes
from tasks.page.shared import compared, errors_section, suggestion_plot, worth


def page(runs: list[LocateRecords]) -> Page:
    """Return the page of these runs."""
    terms = {name: label.meaning for name, label in labels(LOCALIZERS, LABELS).items()}
    sections = [
        sections_of("Where was it?", runs, lambda run: _posteriors(run, several=len(runs) > 1)),
        sections_of("Errors", runs, _errors, terms),
        sections_of("How sure is it?", runs, lambda run: Section("", plots=[_calibration(run), *_studies(run)])),
        _limits(runs[0]),
    ]
    if any(run.holds(SUGGESTED) for run in runs):
        sections.insert(3, sections_of("Where to measure next", runs, _suggestion))
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(runs) == 1:
        first = _summary(runs[0])
    else:
        answers = {f"{run.number}: {run.place}": answer(run) for run in runs}
        first = compared(answers, runs, drawing.palette(), "position error")
    return Page(f"Localization: {names}", first, sections, [provenance(runs)])


def _summary(run: LocateRecords) -> Summary:
    """Return the first screen of one run."""
    error = {name: entry["position_error_m"]["median"] for name, entry in run.metrics["overall"].items()}
    nearest, found = min(NEIGHBOURS, key=lambda name: error[name]), answer(run)
    numbers = [
        Number(f"{error[OWN]:.2f} m", "median position error of the posterior"),
        Number(f"{error[nearest]:.2f} m", f"that of {nearest}, the best nearest-neighbour fingerprinting"),
        Number(f"{run.metrics['calibration'][str(LEVEL)]:.0%}", f"of the true positions in their {LEVEL:.0%} region"),
    ]
    return Summary(numbers, [_overview(run, "summary")], found.conclusion, found.next_steps, notes=notes(run))


def _errors(run: LocateRecords) -> Section:
    n_undetected = run.metrics["n_undetected"]
    return errors_section(
        answer(run),
        run.table("errors")[["index", "place", "method", "position_error_m"]],
        drawing.palette(),
        name=run.file_name,
        quantity="position error",
        caption=f"Column of {OWN}: difference of the mean errors on the same rows, with its 95 % bootstrap interval.",
        paragraphs=[f"Test rows that no receiver detected are left out: {n_undetected}."] if n_undetected else [],
    )


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
        "Errors of the posterior in plan: a line from each true position (dot) to its estimate, coloured by the error."
    )
    columns = ["method", "index", "position_error_m", "truth_x_m", "truth_y_m", "x_m", "y_m"]
    return Plot(name, drawing.overview(run.table("errors")), caption, run.table("errors")[columns])


def _calibration(run: LocateRecords) -> Plot:
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in run.metrics["weights"].items())
    caption = (
        "Fraction of the true positions inside the posterior's credible regions (dots; bars: 95 % interval) against their "
        "probability. On the line the posterior is calibrated, below it the regions are too small. Weights of the "
        f"likelihoods, which maximise the density at held-out training positions: {weights}."
    )
    data = drawing.coverage(run.metrics["calibration"], run.metrics["n_test"])
    return Plot(f"calibration-{run.file_name}", [drawing.calibration(data)], caption, data)


def _studies(run: LocateRecords) -> list[Plot]:
    if not (run.metrics["by_rows"] or run.metrics["by_receivers"]):
        return []
    caption = (
        "Median position error (bars: 95 % interval) of localizers fitted to a random part of the training rows, and with a "
        "random part of the receivers."
    )
    rows, receivers = drawing.study_table(run.metrics["by_rows"]), drawing.study_table(run.metrics["by_receivers"])
    data = concat([rows, receivers]).drop_duplicates()
    return [Plot(f"studies-{run.file_name}", drawing.studies(rows, receivers), caption, data)]


def _posteriors(run: LocateRecords, several: bool) -> Section:
    caption = (
        "Posteriors of six test rows in plan, from the smallest error to the largest, each relative to its largest mass. "
        "Cross: true position; dot: estimate; circle: 80 % credible region; small dots: training positions."
    )
    maps = run.arrays("maps")
    plot = Plot(f"posteriors-{run.file_name}", drawing.posteriors(maps), caption, drawing.posterior_cells(maps))
    return Section("", plots=[plot, *([_overview(run, f"overview-{run.file_name}")] if several else [])])


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
