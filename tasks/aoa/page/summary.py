"""The answer of a run: errors of all methods, the conclusion, the next steps."""

from __future__ import annotations

from dataclasses import replace

from augment.cross_validation import LOCATOR
from augment.estimators import ESTIMATORS
from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK, MEASURED_STAND_IN, NETWORK
from swiftwrf.metrics import ChangeMetrics
from tasks.answer import Answer, Method, NextStep
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.environment import command
from tasks.page.page import number
from tasks.page.shared import again, next_steps, worth
from tasks.summarise import fingerprinting

BASELINES = ("peak", "constant")  # others must beat them


def answer(fraction: FractionRecords) -> Answer:
    """Return the answer of one measured fraction."""
    mix, chosen = fraction.mix, fraction.chosen
    held_out = mix["estimator_choice"]["held_out_deg"] if mix["estimator_choice"] else {}
    methods = []
    for name, found in mix["methods"].items():
        condition = fraction.conditions[name]
        change = found["changes"].get(condition.measured_only.method)
        cells = {
            "azimuth [deg]": number(found["azimuth_deg"]["median"]),
            "elevation [deg]": number(found["elevation_deg"]["median"]),
            "held out [deg]": number(held_out[name]) if name in held_out else "",
            "by synthetic spectra": change_text(change) if change else "",
        }
        seconds = found["seconds"]["train"], found["seconds"]["estimate"]
        is_reference = condition.training == "all measured" or name in BASELINES
        methods.append(Method(name, found["great_circle_deg"], is_reference and name != chosen, seconds, cells))
    shown = (fraction.turbo_method, mix["reference"], MEASURED_NETWORK, LOCATED, FULL_NETWORK, "peak")
    return Answer("deg", methods, chosen, conclusion(fraction), steps(fraction), shown)


def answer_of(run: AoaRecords) -> Answer:
    """Return the answer of a run, whose methods of several measured fractions have the fraction in their names."""
    fractions = FractionRecords.of(run)
    answers = {fraction.percent: answer(fraction) for fraction in fractions}
    first = answers[fractions[0].percent]
    if len(answers) == 1:
        return first
    named = [replace(one, name=f"{one.name}, {share} measured") for share, of in answers.items() for one in of.methods]
    chosen = [f"{of.chosen}, {share} measured" for share, of in answers.items()]
    sentences = [f"{share} measured: {of.conclusion[0]}" for share, of in answers.items()]
    every = list(dict.fromkeys(step for of in answers.values() for step in of.next_steps))
    return Answer("deg", named, chosen[0], sentences, every, chosen)


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
            f" Cross-validation on the measured spectra chose it: {choice['held_out_deg'][chosen]:.2f} degrees on "
            f"{choice['n_held_out']} held-out ones."
        )
        for name, reason in list(choice["better"].items())[:1]:
            sure += f" `{name}` has {medians[name]:.2f} degrees, but is not recommended: {reason}."
    compared = comparison(fraction)
    if "peak" in medians and chosen != "peak":
        compared += f" The strongest peak, which needs no training, is within {medians['peak']:.2f} degrees."
    if "peak" in medians and "constant" in medians:
        compared += f" {fingerprinting(medians['constant'], medians['peak'])}"
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
        f"{change_text(change)} against `{other}`"
        f"{', the best one without them' if other == best else ''} ({judgement(change)})"
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


def judgement(change: ChangeMetrics) -> str:
    """Return whether a change is a gain, a loss or not significant, by its interval.

    Example:
        >>> judgement({"median_deg": 1.0, "change": -0.17, "low": -0.4, "high": 0.1})
        'not significant'
    """
    if change["high"] < 0:
        return "a gain"
    return "a loss" if change["low"] > 0 else "not significant"


def steps(fraction: FractionRecords) -> list[NextStep]:
    """Return what to do next."""
    run, key, path = fraction.run, fraction.key, fraction.run.path
    ending = f"-mix{key}.safetensors"
    files = {file.name.removesuffix(ending) for file in run.folder.glob(f"*{ending}")}
    models = sorted(files - {*ESTIMATORS, LOCATOR, MEASURED_STAND_IN, NETWORK})
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
