"""The report of angle-of-arrival runs, one or several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from augment.cross_validation import LOCATOR
from augment.estimators import ESTIMATORS
from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK, NETWORK, NETWORKS
from augment.turbo.stages import MAX_HELD_OUT_EXTRA
from swiftwrf.contrib.comparison.errors import ChangeMetrics
from tasks import labels
from tasks.aoa.records import FractionRecords, palette
from tasks.aoa.room import choice_section, located_plan, locating_section, room_section
from tasks.aoa.synthesis import examples, examples_plot, spectra
from tasks.environment import command
from tasks.page.page import Number, Page, Plot, Section, Summary, number, provenance, sections_of
from tasks.page.shared import again, compared, errors_section, limits, next_steps, suggestion_section, worth
from tasks.records import Records, notes
from tasks.terminal import Answer, Method, NextStep

BASELINES = ("peak", "constant")  # others must beat them
LIMITS = (
    "The test positions lie in the region and time of one measurement campaign. They do not predict errors in another room, "
    "after furniture moved, or with another array.",
    "The label is the geometric direction of the transmitter, computed from positions. If the direct path is blocked, the "
    "spectrum may not contain it.",
)
MAX_SPREAD = 0.5  # of the labels about their mean, relative to the error of the peaks, where paths are fingerprints
LOOK_UP = (
    "A random split of positions along a path tests look-up more than prediction: each test position has a training "
    "position beside it. Use --split block for positions in a region without measurements."
)


def page(runs: list[Records]) -> Page:
    """Return the page of these runs."""
    fractions = [fraction for run in runs for fraction in FractionRecords.of(run)]
    answers = {fraction: answer(fraction) for fraction in fractions}
    of_first = joined({one: found for one, found in answers.items() if one.run is runs[0]})
    sections = [
        sections_of("Errors", fractions, lambda one: _errors(one, answers[one]), _terms()),
        sections_of("Where was it?", fractions, lambda one: _parts(locating_section(one), room_section(one))),
        sections_of("Spectra", fractions, lambda fraction: Section("", plots=[examples_plot(fraction)])),
        limits(runs[0], *LIMITS, *([LOOK_UP] if runs[0].metrics["split"] == "random" else [])),
    ]
    more = sections_of(
        "Measure or synthesize more?", fractions, lambda one: _parts(choice_section(one), _suggestion_section(one))
    )
    details = [more, sections_of("What is left out", fractions, _left_out), provenance(runs)]
    sections, details = (
        [section for section in part if section.paragraphs or section.plots or section.parts or section.tables]
        for part in (sections, details)
    )
    names = ", ".join(dict.fromkeys(run.place for run in runs))
    if len(fractions) == 1:
        first = first_screen(fractions[0], of_first)
    else:
        named = {fraction.scene: found for fraction, found in answers.items()}
        colours = palette(condition for fraction in fractions for condition in fraction.conditions.values())
        first = compared(named, runs, colours, "angular error", of_first.next_steps if len(runs) == 1 else ())
    return Page(f"Angle of arrival: {names}", first, sections, details, answer=of_first)


def first_screen(fraction: FractionRecords, found: Answer) -> Summary:
    """Return the first screen of one measured fraction."""
    medians, turbo = fraction.medians, fraction.turbo_method
    baseline = "peak" if "peak" in medians else fraction.mix["reference"]
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
    found_examples = examples(fraction)
    images, title, truth = found_examples[len(found_examples) // 2]
    pair = {kind: images[kind] for kind in ("measured", "predicted")}
    panels = [spectra(pair, f"spectrum {title}", truth)]
    caption = (
        "A spectrum at a position without a measurement, measured and predicted (cross: true direction, ring: peak)."
    )
    if fraction.arrays("located"):
        panels.insert(0, located_plan(fraction))
        caption = (
            "The room that was found (dashed walls are not identifiable), and test positions with the errors of their "
            f"location. {caption}"
        )
    errors = fraction.table("errors")[["repeat", "index", "method", "great_circle_deg"]]
    plot = Plot("summary", panels, caption, errors[errors["method"] == found.chosen])
    return Summary(numbers, [plot], found.conclusion, found.next_steps, notes=notes(fraction.run))


def _errors(fraction: FractionRecords, found: Answer) -> Section:
    caption = (
        "Near the zenith azimuth errors are large without meaning. Held out: median and mean error on measured spectra that "
        "decide the choice, all methods trained on the other measured spectra and on at most "
        f"{MAX_HELD_OUT_EXTRA:,} extra positions. By synthetic spectra: change of the median of the same estimator on "
        "measured spectra, a paired bootstrap over the test places."
    )
    errors = fraction.table("errors")[["repeat", "index", "method", "great_circle_deg"]]
    return errors_section(
        found,
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


def _parts(*parts: Section | None) -> Section | None:
    found = [part for part in parts if part is not None]
    return Section("", parts=found) if found else None


def _suggestion_section(fraction: FractionRecords) -> Section | None:
    return suggestion_section(
        "Where to measure next",
        fraction.arrays("suggested"),
        f"suggested-mix{fraction.key}",
        fraction.file_name,
        what="the predictive variance over the region",
        whole="the variance of the spectra",
        how="The estimate is that of a Gaussian process on the measured spectra.",
        label="variance left in the region [%]",
    )


def _terms() -> dict[str, str]:
    """Return what the parts of the names of methods mean."""
    return {
        "measured": "trained on the measured spectra alone",
        "all measured": "trained on all training spectra as if they were measured",
        "measured + synthetic (NAME)": "trained on the measured spectra, and on those that NAME predicts at the withheld "
        "positions; NAME is auto where repeats chose different field models",
        "measured + synthetic + extra (NAME)": "the same, and spectra that NAME predicts at extra positions, as many as "
        "--extra",
        NETWORK: f"{' or, with --preset paper, '.join(NETWORKS.values())}",
        **labels.meanings(ESTIMATORS),
        LOCATOR: "the position whose spectrum, predicted by the room, matches, and its direction (matched-field processing)",
    }


def answer(fraction: FractionRecords) -> Answer:
    """Return the answer of one measured fraction."""
    mix, chosen = fraction.mix, fraction.chosen
    choice = mix["estimator_choice"] or {"held_out_deg": {}, "held_out_mean_deg": {}}
    methods, held_out = [], (choice["held_out_deg"], choice["held_out_mean_deg"])
    for name, found in mix["methods"].items():
        condition = fraction.conditions[name]
        change = found["changes"].get(condition.measured_only.method)
        cells = {
            "azimuth [deg]": number(found["azimuth_deg"]["median"]),
            "elevation [deg]": number(found["elevation_deg"]["median"]),
            "held out, median and mean [deg]": ", ".join(number(errors[name]) for errors in held_out if name in errors),
            "by synthetic spectra": change_text(change) if change else "",
        }
        seconds = found["seconds"]["train"], found["seconds"]["estimate"]
        is_reference = condition.training == "all measured" or name in BASELINES
        methods.append(Method(name, found["great_circle_deg"], is_reference and name != chosen, seconds, cells))
    shown = (fraction.turbo_method, mix["reference"], MEASURED_NETWORK, LOCATED, FULL_NETWORK, "peak")
    return Answer("deg", methods, chosen, conclusion(fraction), steps(fraction), shown)


def answer_of(run: Records) -> Answer:
    """Return the answer of a run."""
    return joined({fraction: answer(fraction) for fraction in FractionRecords.of(run)})


def joined(of_fractions: Mapping[FractionRecords, Answer]) -> Answer:
    """Return the answer of a run, whose methods of several measured fractions have the fraction in their names."""
    if len(of_fractions) == 1:
        return next(iter(of_fractions.values()))
    fractions, answers = list(of_fractions), {one.percent: found for one, found in of_fractions.items()}
    named = [replace(one, name=f"{one.name}, {share} measured") for share, of in answers.items() for one in of.methods]
    chosen = [f"{of.chosen}, {share} measured" for share, of in answers.items()]
    sentences = [f"{share} measured: {of.conclusion[0]}" for share, of in answers.items()]
    every = list(dict.fromkeys(step for of in answers.values() for step in of.next_steps))
    # `swiftwrf predict` applies the choice of the largest fraction
    most = max(range(len(fractions)), key=lambda number: float(fractions[number].key))
    return Answer("deg", named, chosen[most], sentences, every, chosen)


def conclusion(fraction: FractionRecords) -> list[str]:
    """Return the error of the chosen method, how sure it is, and what synthetic spectra change."""
    mix, metrics, chosen = fraction.mix, fraction.run.metrics, fraction.chosen
    error, medians, choice = mix["methods"][chosen]["great_circle_deg"], fraction.medians, mix["estimator_choice"]
    located = mix["locating"].get(chosen)
    at = f", positions within {100 * located['position_error_m']['median']:.1f} cm" if located else ""
    sure = (
        f"The median's 95 % interval is {error['low']:.2f} to {error['high']:.2f} degrees over {metrics['n_test']} test "
        f"spectra that no fit used; {mix['n_measured']} of {metrics['n_train']} training spectra count as measured "
        f"({fraction.run.scene})."
    )
    if choice:
        sure += (
            f" Measured spectra that were held out chose it: {choice['held_out_deg'][chosen]:.2f} degrees on "
            f"{choice['n_held_out']} of them (mean {choice['held_out_mean_deg'][chosen]:.2f})."
        )
        if (first := min(choice["held_out_deg"], key=choice["held_out_deg"].__getitem__)) != chosen:
            sure += f" The median of `{first}` is smaller there by chance only, and its mean error is larger."
        # one sentence a reason, about the best of its methods
        for reason, name in {reason: name for name, reason in reversed(choice["better"].items())}.items():
            sure += f" `{name}` has {medians[name]:.2f} degrees, but is not recommended: {reason}."
    else:
        sure += " It is not compared with others: too few spectra are measured to hold some out."
    compared = comparison(fraction)
    if "peak" in medians and chosen != "peak":
        compared += f" The strongest peak, which needs no training, is within {medians['peak']:.2f} degrees."
    if "constant" in medians and medians["constant"] < MAX_SPREAD * medians.get("peak", 0.0):
        compared += (
            " This is fingerprinting along a path rather than estimation of angles: directions lie within "
            f"{medians['constant']:.1f} degrees of their mean (median), and peaks are {medians['peak']:.0f} degrees off."
        )
    return [
        f"Directions are found within {error['median']:.2f} degrees{at} (median errors; 90 % of the directions within "
        f"{error['p90']:.1f} degrees), by `{chosen}`.",
        sure,
        compared.strip(),
    ]


def comparison(fraction: FractionRecords) -> str:
    """Return the changes of the learner's error by synthetic spectra, and whether they are significant."""
    method, best = fraction.turbo_method, fraction.mix["reference"]
    parts = [
        f"{change_text(change)} against `{other}`{', the best one without them' if other == best else ''} "
        f"({'a gain' if change['high'] < 0 else 'a loss' if change['low'] > 0 else 'not significant'})"
        for other, change in fraction.mix["methods"][method]["changes"].items()
    ]
    return f"Synthetic spectra change the median error of `{method}` by {' and '.join(parts)}."


def change_text(change: ChangeMetrics) -> str:
    """Return a change with its 95 % interval.

    Example:
        >>> change_text({"median_deg": 1.0, "change": -0.49, "low": -0.6, "high": -0.3})
        '-49% [-60%, -30%]'
    """
    return f"{change['change']:+.0%} [{change['low']:+.0%}, {change['high']:+.0%}]"


def steps(fraction: FractionRecords) -> list[NextStep]:
    """Return what to do next."""
    run, key, path = fraction.run, fraction.key, fraction.run.path
    ending = f"-mix{key}.safetensors"
    models = sorted(name for name in fraction.mix["synthesis"] if (run.folder / f"{name}{ending}").is_file())
    own, several = [], len(run.metrics["mixes"]) > 1
    if fraction.chosen_file is None and fraction.mix["estimator_choice"]:
        make = f"augment.estimators.make_estimator({fraction.conditions[fraction.chosen].estimator!r})"
        own.append(NextStep(f"`{fraction.chosen}` needs no file", make))
    own += [
        NextStep(
            f"Predict spectra anywhere by `{name}`", f"swiftwrf.load({f'{path}/{name}{ending}'!r}).predict(positions)"
        )
        for name in models[:1]
    ]
    if suggested := fraction.arrays("suggested"):
        own.append(NextStep(f"Measure next where suggested-mix{key}.csv has positions. {worth(suggested['left'])}"))
    if run.metrics["repeats"] == 1:
        own.append(
            NextStep("Repeat with `--repeats 3` before you rely on a difference: one random subset proves little.")
        )
    if run.metrics["split"] == "random" and run.metrics["data"] != "simulated-room":
        own.append(again(run, "Test a region where nothing was measured", "block"))
    explore = "Explore the spectra" if models else ""
    if fraction.chosen_file is None:
        return [NextStep(explore, command("view", path)), *own] if explore else own
    model = f"{path}/{fraction.chosen_file.name}" if several else path
    return next_steps(run, explore, f"Estimate directions of new spectra by `{fraction.chosen}`", "SOURCE", own, model)
