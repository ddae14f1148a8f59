"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from tasks.aoa.page.cost import sizes, speed_section, time_section, trainings
from tasks.aoa.page.field import field_section
from tasks.aoa.page.locating import locating_section
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.aoa.page.results import estimator_section, over_estimators, over_fractions, results_section
from tasks.aoa.page.room import choice_section, room_section
from tasks.aoa.page.suggest import suggestion_section
from tasks.aoa.page.summary import summary
from tasks.aoa.page.synthesis import examples_section, synthesis_section
from tasks.page.page import Page, Section
from tasks.page.provenance import provenance


def page(runs: list[AoaRecords]) -> Page:
    """Return the page of these runs."""
    several = len(runs) > 1
    fractions = [fraction for run in runs for fraction in FractionRecords.of(run)]
    sections = [results_section(fraction, several) for fraction in fractions]
    if len(fractions) > 1:
        sections.insert(0, Section("Error against the measured fraction", plots=[over_fractions(fractions, "shares")]))
    for fraction in fractions:
        makers = (locating_section, estimator_section, choice_section, room_section, suggestion_section)
        sections += [section for make in makers if (section := make(fraction))]
    sections += [synthesis_section(fractions, several), *(examples_section(fraction) for fraction in fractions)]
    sections += [section for fraction in fractions if (section := field_section(fraction))]
    sections += [
        *(speed_section(fraction) for fraction in fractions),
        Section("Training and size", plots=[*sizes(runs), *trainings(runs)]),
    ]
    sections += [time_section(fractions, several), _limits(runs[0]), provenance(runs)]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    picture = over_fractions(fractions, "summary") if len(fractions) > 1 else over_estimators(fractions[0])
    return Page(f"Angle of arrival: {names}", summary(fractions[0], picture), sections)


def _limits(run: AoaRecords) -> Section:
    texts = [
        "The test positions lie in the region and time of one measurement campaign; nothing here says how the network does "
        "in another room, after furniture moved, or with another array.",
        "The label is the geometric direction of the transmitter, computed from positions; where the direct path is blocked "
        "the spectrum may not contain it.",
        "Intervals treat test spectra as independent draws. Along a measured path they are not, so on such data the "
        "intervals are too narrow.",
    ]
    if run.metrics["split"] == "random":
        texts.append(
            "A random split of positions along a path tests look-up more than prediction: each test position has a training "
            "position beside it. Use --split block for positions in a region without measurements."
        )
    if run.metrics["data"] == "simulated-room":
        texts.append(
            "These spectra are simulated: image sources in an idealised room. They show that the software works, no more."
        )
    return Section("What this does not show", texts)
