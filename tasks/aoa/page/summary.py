"""Summary of the report: three numbers, a picture, their meaning, next steps."""

from __future__ import annotations

from tasks.aoa.condition import LOCATOR
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.former import FORMER_NAMES
from tasks.aoa.page.gains import change_text, changes_of, gain_sentence, judgement, reference, turbo_method
from tasks.aoa.page.records import AoaRecords, FractionRecords
from tasks.aoa.page.results import choice_sentence
from tasks.aoa.page.room import advice_sentences
from tasks.page.page import Number, Plot, Summary
from tasks.terminal import Answer


def summary(fraction: FractionRecords, picture: Plot) -> Summary:
    """Return the summary of one measured fraction."""
    metrics, mix = fraction.run.metrics, fraction.mix
    meaning = [
        f"On {fraction.run.scene}, {mix['n_measured']} of {metrics['n_train']} training spectra are measured "
        f"({fraction.percent}); the spectra at the other positions are synthesized, and the network learns from both. "
        f"It is tested on {metrics['n_test']} spectra that take no part in any fit.",
        *(text for text in (choice_sentence(fraction), gain_sentence(fraction)) if text),
        *advice_sentences(fraction),
    ]
    return Summary(_numbers(fraction), picture, meaning, _next_steps(fraction), verdict(fraction))


def _numbers(fraction: FractionRecords) -> list[Number]:
    """Return the error of the estimator that cross-validation chose, the gain of the network, the quality of the spectra."""
    turbo = turbo_method(fraction)
    choice = fraction.mix.get("estimator_choice")
    first = choice["name"] if choice else turbo
    synthesizer = fraction.synthesizers([turbo])[0]
    quality = fraction.mix["synthesis"][synthesizer]["psnr_db"]
    return [
        *(_error(fraction, name) for name in dict.fromkeys((first, turbo)) if name in fraction.mix["methods"]),
        _gain(fraction, turbo),
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
            names = {"condition": condition.meaning, "estimator": condition.estimator}
            rows.append((share | names, fraction.mix["methods"][method]["great_circle_deg"]))
    return Answer("deg", rows, verdict(fractions[0]), _next_steps(fractions[0]))


def verdict(fraction: FractionRecords) -> str:
    """Return which estimator to take and what synthetic spectra change, in one or two short sentences."""
    sentences = []
    if choice := fraction.mix.get("estimator_choice"):
        sentences.append(f"Take {choice['name']}: median error {fraction.medians[choice['name']]:.2f} degrees.")
    turbo = turbo_method(fraction)
    own = "measured_only"
    if change := changes_of(fraction, turbo).get(own):
        sentences.append(
            f"Synthetic spectra change the network's median error by {change_text(change)}: {judgement(change)}."
        )
    else:
        before, after = fraction.medians[own], fraction.medians[turbo]
        sentences.append(
            f"Synthetic spectra change the network's median error from {before:.2f} to {after:.2f} degrees."
        )
    return " ".join(sentences)


def _error(fraction: FractionRecords, method: str) -> Number:
    """Return the error of a method, with its position error if it locates."""
    error = fraction.mix["methods"][method]["great_circle_deg"]
    choice = fraction.mix.get("estimator_choice")
    who = "the network with synthetic spectra" if fraction.conditions[method].is_network else "the estimator"
    text = f"median angular error of {who}, {method}, 95 % interval [{error['low']:.2f}, {error['high']:.2f}]"
    text += "; cross-validation on the measured spectra chose it" if choice and choice["name"] == method else ""
    if located := (fraction.mix.get("locating") or {}).get(method):
        text += f"; median position error {100 * located['position_error_m']['median']:.1f} cm"
    return Number(f"{error['median']:.2f}\N{DEGREE SIGN}", text)


def _gain(fraction: FractionRecords, turbo: str) -> Number:
    """Return the change of the network's error against the best estimator without synthetic spectra."""
    best, error = reference(fraction), fraction.medians
    change, interval = error[turbo] / error[best] - 1, ""
    if found := changes_of(fraction, turbo).get(best):
        interval = f", 95 % interval [{found['low']:+.0%}, {found['high']:+.0%}]: {judgement(found)}"
    return Number(
        f"{change:+.0%}".replace("-", "\N{MINUS SIGN}"),
        f"change by synthetic spectra of the network's error against {error[best]:.2f} degrees of {best}, the best without "
        f"them{interval}; everything measured: {error['measured_all']:.2f}",
    )


def _next_steps(fraction: FractionRecords) -> list[str]:
    metrics, key = fraction.run.metrics, fraction.key
    steps = []
    if choice := fraction.mix.get("estimator_choice"):
        steps.append(f"Take {choice['name']} on this data: cross-validation chose it, without the test spectra.")
    if metrics["repeats"] == 1:
        steps.append(
            "One draw of the measured fraction proves little: repeat with --repeats 3 before you rely on a difference."
        )
    if metrics["split"] == "random" and metrics["data"] != "simulated-room":
        steps.append("Run --split block: it shows the error in a region where nothing was measured.")
    if (fraction.run.folder / f"suggested-mix{key}.csv").is_file():
        steps.append(f"Measure next at the positions in suggested-mix{key}.csv; the section below has their map.")
    else:
        steps.append("Ask where to measure next with --suggest 20.")
    files = {
        file.name.removesuffix(f"-mix{key}.safetensors") for file in fraction.run.folder.glob(f"*-mix{key}.safetensors")
    }
    estimators = sorted(files & {*ESTIMATORS, *FORMER_NAMES, LOCATOR})
    steps += [
        f"Estimate directions: python -m tasks.estimate {name}-mix{key}.safetensors SOURCE." for name in estimators
    ]
    steps += [
        f"Draw spectra anywhere: swiftwrf.load('{name}-mix{key}.safetensors').synthesize(position)."
        for name in sorted(files - set(estimators))
    ]
    return steps
