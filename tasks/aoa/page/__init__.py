"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from augment.cross_validation import LOCATOR
from augment.estimators import ESTIMATORS
from augment.turbo.condition import NETWORK, NETWORKS
from tasks import labels
from tasks.aoa.page.locating import located_plan, locating_section
from tasks.aoa.page.records import AoaRecords, FractionRecords, palette
from tasks.aoa.page.room import choice_section, room_section
from tasks.aoa.page.summary import answer, answer_of
from tasks.aoa.page.synthesis import example_pair, synthesis_section
from tasks.page.page import Number, Page, Plot, Section, Summary, provenance, sections_of
from tasks.page.records import notes
from tasks.page.shared import compared, errors_section, suggestion_plot, worth


def page(runs: list[AoaRecords]) -> Page:
    """Return the page of these runs."""
    fractions = [fraction for run in runs for fraction in FractionRecords.of(run)]
    sections = [
        sections_of("Errors", fractions, _errors, terms()),
        sections_of("Where was it?", fractions, _positions),
        sections_of("Spectra", fractions, synthesis_section),
        _limits(runs[0]),
    ]
    more = sections_of("Measure or synthesize more?", fractions, _more)
    details = [more, sections_of("What is left out", fractions, _left_out), provenance(runs)]
    sections, details = (
        [section for section in part if section.paragraphs or section.plots or section.parts or section.tables]
        for part in (sections, details)
    )
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(fractions) == 1:
        first = first_screen(fractions[0])
    else:
        answers = {fraction.scene: answer(fraction) for fraction in fractions}
        colours = palette(condition for fraction in fractions for condition in fraction.conditions.values())
        steps = answer_of(runs[0]).next_steps if len(runs) == 1 else ()
        first = compared(answers, runs, colours, "angular error", steps)
    return Page(f"Angle of arrival: {names}", first, sections, details)


def first_screen(fraction: FractionRecords) -> Summary:
    """Return the first screen of one measured fraction."""
    found, medians = answer(fraction), fraction.medians
    turbo, baseline = fraction.turbo_method, "peak" if "peak" in medians else fraction.mix["reference"]
    synthesizer = fraction.synthesizers([turbo])[0]
    quality = fraction.mix["synthesis"][synthesizer]["psnr_db"]["median"]
    numbers = [
        *(
            Number(f"{medians[name]:.2f}\N{DEGREE SIGN}", f"median angular error of {name}")
            for name in dict.fromkeys((found.chosen, turbo, baseline))
        ),
        Number(
            f"{quality:.1f} dB", f"median PSNR of the spectra that {synthesizer} predicts where nothing was measured"
        ),
    ]
    panels, caption = example_pair(fraction)
    if fraction.arrays("located"):
        panels.insert(0, located_plan(fraction))
        caption = (
            "The room that was found (dashed walls are not identifiable), and test positions with the errors of their "
            f"location. {caption}"
        )
    errors = fraction.table("errors")[["repeat", "index", "method", "great_circle_deg"]]
    plot = Plot("summary", panels, caption, errors[errors["method"] == found.chosen])
    return Summary(numbers, [plot], found.conclusion, found.next_steps, notes=notes(fraction.run))


def _errors(fraction: FractionRecords) -> Section:
    caption = (
        "Near the zenith azimuth errors are large without meaning. Held out: on measured "
        "spectra, which decide the choice. By synthetic spectra: change of the median of the same estimator on measured "
        "spectra, a paired bootstrap over the test positions."
    )
    errors = fraction.table("errors")[["repeat", "index", "method", "great_circle_deg"]]
    return errors_section(
        answer(fraction),
        errors,
        fraction.palette,
        name=fraction.file_name,
        quantity="angular error",
        caption=caption,
    )


def _left_out(fraction: FractionRecords) -> Section:
    left_out = fraction.mix["left_out"]
    texts = [
        f"{', '.join(name for name, own in left_out.items() if own == reason)}: {reason}."
        for reason in dict.fromkeys(left_out.values())
    ]
    return Section("", texts or ["Nothing."])


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
