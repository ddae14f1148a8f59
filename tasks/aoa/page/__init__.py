"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from tasks.aoa.page.cost import sizes, speed_section, time_section, trainings
from tasks.aoa.page.field import field_section
from tasks.aoa.page.results import over_estimators, over_shares, results_section
from tasks.aoa.page.room import choice_section, room_section
from tasks.aoa.page.suggest import suggestion_section
from tasks.aoa.page.summary import summary
from tasks.aoa.page.synthesis import examples_section, synthesis_section
from tasks.aoa.share import AoaRecords, Share
from tasks.page.page import Page, Section
from tasks.page.provenance import provenance


def page(runs: list[AoaRecords]) -> Page:
    """The page of these runs."""
    several = len(runs) > 1
    shares = [share for run in runs for share in Share.of(run)]
    sections = [results_section(share, several) for share in shares]
    if len(shares) > 1:
        sections.insert(0, Section("Error against the measured share", plots=[over_shares(shares, "shares")]))
    for share in shares:
        sections += [
            section for section in (choice_section(share), room_section(share), suggestion_section(share)) if section
        ]
    sections += [synthesis_section(shares, several), *(examples_section(share) for share in shares)]
    sections += [section for share in shares if (section := field_section(share))]
    sections += [
        *(speed_section(share) for share in shares),
        Section("Training and size", plots=[*sizes(runs), *trainings(runs)]),
    ]
    sections += [time_section(shares, several), _limits(runs[0]), provenance(runs)]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    picture = over_shares(shares, "summary") if len(shares) > 1 else over_estimators(shares[0])
    return Page(f"Angle of arrival: {names}", summary(shares[0], picture), sections)


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
