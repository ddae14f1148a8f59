"""Summary of the report: three numbers, a picture, their meaning, next steps."""

from __future__ import annotations

from augment.cross_validation import LOCATOR
from augment.estimators import ESTIMATORS
from augment.turbo.condition import LOCATED, MEASURED_STAND_IN
from tasks.aoa.page.overview import overview
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.aoa.page.results import change_text, choice_sentence, gain_sentence, judgement
from tasks.aoa.page.room import cross_validation_sentences
from tasks.environment import command
from tasks.page.page import Number, Summary
from tasks.page.shared import worth
from tasks.summarise import fingerprinting
from tasks.terminal import Answer


def summary(fraction: FractionRecords) -> Summary:
    """Return the summary of one measured fraction."""
    metrics, mix = fraction.run.metrics, fraction.mix
    meaning = [
        f"On {fraction.run.scene}, {mix['n_measured']} of {metrics['n_train']} training spectra are measured "
        f"({fraction.percent}). The spectra at the other positions are synthesized, and {fraction.learner} learns from "
        f"both. It is tested on {metrics['n_test']} spectra that take no part in any fit.",
        *(text for text in (choice_sentence(fraction), gain_sentence(fraction)) if text),
        *cross_validation_sentences(fraction),
    ]
    return Summary(_numbers(fraction), [overview(fraction)], meaning, next_steps(fraction), conclusion(fraction))


def _numbers(fraction: FractionRecords) -> list[Number]:
    """Return errors of the chosen estimator, the network and the strongest peak, and the quality of the spectra."""
    turbo = fraction.turbo_method
    choice = fraction.mix["estimator_choice"]
    first = choice["name"] if choice else turbo
    synthesizer = fraction.synthesizers([turbo])[0]
    quality = fraction.mix["synthesis"][synthesizer]["psnr_db"]
    return [
        *(_error(fraction, name) for name in dict.fromkeys((first, turbo)) if name in fraction.mix["methods"]),
        *_strongest_peak(fraction),
        Number(
            f"{quality['median']:.1f} dB",
            f"median PSNR of the spectra that {synthesizer} predicts at positions without a measurement",
        ),
    ]


def answer(run: AoaRecords) -> Answer:
    """Return what the terminal shows of a run."""
    fractions = FractionRecords.of(run)
    rows = []
    for fraction in fractions:
        share = {"measured": fraction.percent} if len(fractions) > 1 else {}
        for method, condition in fraction.conditions.items():
            names = {"estimator": condition.name, "training spectra": condition.training_set}
            rows.append((share | names, fraction.mix["methods"][method]["great_circle_deg"]))
    return Answer("deg", rows, conclusion(fractions[0]), next_steps(fractions[0]))


def conclusion(fraction: FractionRecords) -> str:
    """Return which estimator to take and what synthetic spectra change, in short sentences."""
    sentences, medians = [], fraction.medians
    if choice := fraction.mix["estimator_choice"]:
        sentences.append(f"Take {choice['name']}: median error {medians[choice['name']]:.2f} degrees.")
        for name, reason in list(choice["better"].items())[:1]:
            sentences.append(f"{name} has {medians[name]:.2f} degrees, but is not recommended: {reason}.")
    best = fraction.mix["reference"]
    change = fraction.mix["methods"][fraction.turbo_method]["changes"][best]
    without = "that uses neither them nor the room" if LOCATED in medians else "without them"
    sentences.append(
        f"With synthetic spectra {fraction.learner} changes the median error by {change_text(change)} against {best}, "
        f"the best estimator {without}: {judgement(change)}."
    )
    if "peak" in medians and "constant" in medians:
        sentences.append(fingerprinting(medians["constant"], medians["peak"]))
    return " ".join(sentence for sentence in sentences if sentence)


def _error(fraction: FractionRecords, method: str) -> Number:
    """Return the error of a method, with its position error if it locates."""
    error = fraction.mix["methods"][method]["great_circle_deg"]
    choice = fraction.mix["estimator_choice"]
    chosen = choice is not None and choice["name"] == method
    who = "network with synthetic spectra" if fraction.conditions[method].is_network else "estimator"
    text = f"median angular error of {method}, {'the chosen ' if chosen else 'the '}{who}, 95 % interval "
    text += f"[{error['low']:.2f}, {error['high']:.2f}]"
    if located := fraction.mix["locating"].get(method):
        text += f"; median position error {100 * located['position_error_m']['median']:.1f} cm"
    return Number(f"{error['median']:.2f}\N{DEGREE SIGN}", text)


def _strongest_peak(fraction: FractionRecords) -> list[Number]:
    """Return the error of the strongest direction, which needs no training."""
    if "peak" not in fraction.medians:
        return []
    without = "median angular error of the strongest peak, which needs no training"
    if "constant" in fraction.medians:
        without += f"; of the mean direction: {fraction.medians['constant']:.2f}\N{DEGREE SIGN}"
    return [Number(f"{fraction.medians['peak']:.2f}\N{DEGREE SIGN}", without)]


def next_steps(fraction: FractionRecords) -> list[str]:
    """Return what to do next, a sentence each."""
    metrics, key = fraction.run.metrics, fraction.key
    path = fraction.run.path
    files = {
        file.name.removesuffix(f"-mix{key}.safetensors") for file in fraction.run.folder.glob(f"*-mix{key}.safetensors")
    }
    estimators = files & {*ESTIMATORS, LOCATOR, MEASURED_STAND_IN}
    steps = []
    if files - estimators:
        steps.append(f"Explore the spectra: `{command('view', path)}`.")
    choice = fraction.mix["estimator_choice"]
    file = fraction.chosen_file
    taken = file.name.removesuffix(f"-mix{key}.safetensors") if file else ""
    if file:
        model = path if len(metrics["mixes"]) == 1 else f"{path}/{file.name}"
        steps.append(
            f"Take {taken} on this data: cross-validation chose it, without the test spectra. Estimate directions of new "
            f"spectra: `{command('predict', model, 'SOURCE')}`."
        )
    elif choice:
        steps.append(f"{choice['name']} needs no file: `augment.estimators.make_estimator('{choice['name']}')`.")
    others = sorted(estimators - {taken})
    if others:
        kept = f"`{command('predict', f'{path}/{others[0]}-mix{key}.safetensors', 'SOURCE')}`"
        more = f" Also kept: {', '.join(others[1:])}." if len(others) > 1 else ""
        steps.append(f"{'Or by' if taken else 'Estimate directions by'} {others[0]}: {kept}.{more}")
    steps += [
        f"Predict spectra anywhere: `swiftwrf.load({f'{path}/{name}-mix{key}.safetensors'!r}).predict(positions)`."
        for name in sorted(files - estimators)
    ]
    if suggested := fraction.arrays("suggested"):
        steps.append(f"Where to measure next is in suggested-mix{key}.csv. {worth(suggested['left'])}")
    else:
        steps.append("Ask where to measure next with `--suggest 20`.")
    if metrics["repeats"] == 1:
        steps.append("Repeat with `--repeats 3` before you rely on a difference: one random subset proves little.")
    if metrics["split"] == "random" and metrics["data"] != "simulated-room":
        steps.append("Run `--split block`: it shows the error in a region where nothing was measured.")
    return steps
