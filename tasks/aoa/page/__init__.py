"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from augment.cross_validation import LOCATOR
from augment.estimators import ESTIMATORS
from augment.turbo.condition import NETWORK, NETWORKS
from tasks import labels
from tasks.aoa.page.cost import sizes, speed_section, time_section, trainings
from tasks.aoa.page.field import field_section
from tasks.aoa.page.locating import locating_section
from tasks.aoa.page.overview import compared
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.aoa.page.results import results_section, turbo_distribution
from tasks.aoa.page.room import choice_section, room_section
from tasks.aoa.page.summary import conclusion, next_steps, summary
from tasks.aoa.page.synthesis import similarity, synthesis_section
from tasks.environment import command
from tasks.page.page import Page, Plot, Section, Summary, provenance, sections_of
from tasks.page.shared import suggestion_plot, worth


def page(runs: list[AoaRecords]) -> Page:
    """Return the page of these runs."""
    fractions = [fraction for run in runs for fraction in FractionRecords.of(run)]
    sections = [
        sections_of("Errors", fractions, results_section, terms()),
        sections_of("Spectra", fractions, synthesis_section),
        sections_of("Positions and room", fractions, _positions),
        sections_of("Measure or synthesize more?", fractions, _more),
        _limits(runs[0]),
    ]
    sections = [section for section in sections if section.paragraphs or section.tables or section.parts]
    details = [
        sections_of("Field models", fractions, lambda fraction: Section("", plots=_field_models(fraction))),
        sections_of("Speed against error", fractions, speed_section),
        Section("Training and size", plots=[*sizes(runs), *trainings(runs)]),
        sections_of("The field over the region", fractions, field_section),
        time_section(fractions),
        provenance(runs),
    ]
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    first = summary(fractions[0]) if len(fractions) == 1 else _comparison(fractions)
    return Page(f"Angle of arrival: {names}", first, sections, details)


def _comparison(fractions: list[FractionRecords]) -> Summary:
    """Return the first screen of several measured fractions or runs."""
    table, plot = compared(fractions)
    meaning = [f"{fraction.scene}: {conclusion(fraction)}" for fraction in fractions]
    runs = {fraction.run.path: fraction.run for fraction in fractions}
    steps = [f"Explore{run.label.replace(',', '')}: `{command('view', path)}`." for path, run in runs.items()]
    if len(runs) == 1:
        steps = list(dict.fromkeys(step for fraction in fractions for step in next_steps(fraction)))
    return Summary([], [plot], meaning, steps, table=table)


def _positions(fraction: FractionRecords) -> Section | None:
    parts = [part for make in (locating_section, room_section) if (part := make(fraction))]
    return Section("", parts=parts) if parts else None


def _more(fraction: FractionRecords) -> Section | None:
    parts = [part for make in (choice_section, _suggestion_section) if (part := make(fraction))]
    return Section("", parts=parts) if parts else None


def _suggestion_section(fraction: FractionRecords) -> Section | None:
    """Return a plan of the suggested positions and the expected variance after measuring there; None without suggestions."""
    if not (arrays := fraction.arrays("suggested")):
        return None
    suggested, left = arrays["suggested"], arrays["left"]
    text = (
        f"Measuring at {len(suggested)} more positions (suggested-mix{fraction.key}.csv, the most informative first) would "
        f"reduce the predictive variance over the region from {left[0]:.0%} to {left[-1]:.0%} of the variance of the "
        "spectra. The estimate is that of a Gaussian process on the measured spectra. "
        f"{worth(left)}"
    )
    plot = suggestion_plot(f"suggested-{fraction.file_name}", arrays, "variance left in the region [%]")
    return Section("Where to measure next", [text], plots=[plot])


def _field_models(fraction: FractionRecords) -> list[Plot]:
    return [similarity(fraction), *turbo_distribution(fraction)]


def _limits(run: AoaRecords) -> Section:
    texts = [
        "The test positions lie in the region and time of one measurement campaign. They do not predict errors in "
        "another room, after furniture moved, or with another array.",
        "The label is the geometric direction of the transmitter, computed from positions. If the direct path is blocked, "
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


def terms() -> dict[str, str]:
    """Return what the parts of the names of methods mean."""
    return {
        "measured": "trained on the measured spectra alone",
        "all measured": "trained on all training spectra as if they were measured",
        "measured + synthetic (NAME)": "trained on the measured spectra, and on those that NAME predicts at the withheld "
        "positions; NAME is auto where repeats chose different field models",
        "measured + synthetic + extra (NAME)": "the same, and spectra that NAME predicts at extra positions, as many as "
        "--extra",
        NETWORK: f"{' or, with --preset paper, '.join(NETWORKS.values())}",
        **{name: label.meaning for name, label in labels.labels(ESTIMATORS, labels.ESTIMATORS).items()},
        LOCATOR: labels.ESTIMATORS[LOCATOR].meaning,
    }
