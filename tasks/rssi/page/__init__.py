"""The report of one RSSI run or several."""

from __future__ import annotations

from functools import partial

from swiftwrf.choices import RSSI_PREDICTORS
from tasks.labels import PREDICTORS as LABELS
from tasks.labels import labels
from tasks.page.page import Number, Page, Section, Summary, provenance, sections_of
from tasks.page.records import notes
from tasks.page.shared import compared, errors_section
from tasks.rssi.page import errors
from tasks.rssi.page.maps import COVERED_DBM, Maps, RssiRecords
from tasks.rssi.page.summary import answer, best_baseline, model_of


def page(runs: list[RssiRecords]) -> Page:
    """Return the page of these runs."""
    terms = {name: label.meaning for name, label in labels(RSSI_PREDICTORS, LABELS).items()}
    sections = [
        sections_of("Errors", runs, _errors, terms),
        sections_of("Where the errors are", runs, lambda run: Section("", plots=[errors.where(run)])),
        _limits(runs[0]),
    ]
    details = [provenance(runs)]
    if len(runs) > 1 or any(len(Maps(run).names) > 1 for run in runs):
        sections.insert(0, sections_of("Maps", runs, partial(_maps, kind="predicted")))
        by_receiver = sections_of("Errors by receiver", runs, lambda run: Section("", plots=errors.differences(run)))
        details[:0] = [by_receiver, sections_of("Widths of the intervals", runs, partial(_maps, kind="width"))]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(runs) == 1:
        first = _summary(runs[0])
    else:
        answers = {f"{run.number}: {run.place}": answer(run) for run in runs}
        first = compared(answers, runs, errors.palette(), "absolute error")
    return Page(f"RSSI: {names}", first, sections, details)


def _summary(run: RssiRecords) -> Summary:
    """Return the first screen of one run."""
    found, floors, interval = answer(run), Maps.of_floors(run), run.metrics["interval"]
    error = {name: entry["abs_error_db"] for name, entry in run.metrics["overall"].items()}
    best = best_baseline(run)
    numbers = [
        *(Number(f"{maps.covered:.0%}", f"of {maps.place} above {COVERED_DBM:g} dBm") for maps in floors),
        Number(f"{error[found.chosen]['median']:.2f} dB", f"median absolute error of {found.chosen}"),
        Number(f"{error[best]['median']:.2f} dB", f"that of {best}, the best other method"),
        Number(f"{interval['coverage']:.0%}", f"of the test measurements in their {interval['nominal']:.0%} interval"),
    ]
    plots = [maps.summary() for maps in floors]
    return Summary(numbers, plots, found.conclusion, found.next_steps, notes=notes(run))


def _maps(run: RssiRecords, kind: str) -> Section:
    return Section("", plots=[maps.by_receiver(kind) for maps in Maps.of_floors(run)])


def _errors(run: RssiRecords) -> Section:
    caption = (
        f"Column of {model_of(run)}: difference of the mean absolute errors on the same pairs, with its 95 % bootstrap "
        "interval over test rows. Detection: mean of the fractions of detected and of empty test cells that are predicted "
        "as such; 0.5 is chance."
    )
    return errors_section(
        answer(run),
        run.table("errors")[["receiver", "index", "method", "abs_error_db"]],
        errors.palette(),
        name=run.file_name,
        quantity="absolute error",
        caption=caption,
        paragraphs=[f"Left out: {reason}." for reason in run.metrics["left_out"].values()],
        panels=errors.by_rows(run),
    )


def _limits(run: RssiRecords) -> Section:
    texts = [
        "Single packets scatter about the mean of their position. BLE packets of unknown channel scatter by 2 to 3 dB. No "
        "predictor of the mean has a lower error than this scatter.",
        "Errors are those of detected values. How well empty cells are predicted is a number of its own, and where a packet "
        "is more likely lost than received the maps are hatched.",
        "Intervals of medians treat pairs as independent. Along a walked path they are not, and the intervals are too "
        "narrow. The bootstrap of the paired table samples whole test rows, which corrects this in part.",
        "The paper's table (2.91 dB for SwiftWRF, 6.74 dB for MRI) is of other data. Compare methods in this report only.",
    ]
    if run.metrics["data"] == "simulated-floor":
        texts.append(
            "This floor is simulated. It shows that the software works, and not how accurate it is on measurements."
        )
    return Section("What this does not show", texts)
