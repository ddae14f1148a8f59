"""Summary of the report: three numbers, a picture, their meaning, next steps."""

from __future__ import annotations

from tasks.aoa.condition import LOCATOR, headline
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.former import FORMER_NAMES
from tasks.aoa.page.records import FractionRecords
from tasks.aoa.page.results import choice_sentence
from tasks.aoa.page.room import advice_sentences
from tasks.page.page import Number, Plot, Summary


def summary(fraction: FractionRecords, picture: Plot) -> Summary:
    """Return the summary of one measured fraction."""
    metrics, mix = fraction.run.metrics, fraction.mix
    error = {name: method["great_circle_deg"] for name, method in mix["methods"].items()}
    turbo = headline(fraction.conditions.values()).method
    lower, upper = error["measured_only"]["median"], error["measured_all"]["median"]
    own = error[turbo]
    synthesizer = fraction.synthesizers([turbo])[0]
    quality = mix["synthesis"][synthesizer]["psnr_db"]
    numbers = [
        Number(
            f"{own['median']:.2f}\N{DEGREE SIGN}",
            f"median great-circle error of the network with turbo learning ({turbo}), 95 % interval "
            f"[{own['low']:.2f}, {own['high']:.2f}]",
        ),
        Number(
            f"{own['median'] / lower - 1:+.0%}".replace("-", "\N{MINUS SIGN}"),
            f"against {lower:.2f} degrees with the measured fraction alone; everything measured: {upper:.2f}",
        ),
        *_located(fraction),
        Number(
            f"{quality['median']:.1f} dB",
            f"median PSNR of the spectra that {synthesizer} predicts at positions without a measurement",
        ),
    ]
    meaning = [
        f"On {fraction.run.scene}, {mix['n_measured']} of {metrics['n_train']} training spectra are measured "
        f"({fraction.percent}); the spectra at the other positions are synthesized, and the network learns from both. "
        f"It is tested on {metrics['n_test']} spectra that take no part in any fit.",
        *([text] if (text := choice_sentence(fraction)) else []),
        *advice_sentences(fraction),
    ]
    return Summary(numbers, picture, meaning, _next_steps(fraction))


def _located(fraction: FractionRecords) -> list[Number]:
    """Return the error of matched-field processing on the measured fraction, if the run has it."""
    located = (fraction.mix.get("locating") or {}).get(LOCATOR)
    if located is None:
        return []
    error, position = fraction.mix["methods"][LOCATOR]["great_circle_deg"], located["position_error_m"]
    text = (
        f"median great-circle error of matched-field processing with the measured fraction alone, 95 % interval "
        f"[{error['low']:.2f}, {error['high']:.2f}]; median position error {100 * position['median']:.1f} cm"
    )
    return [Number(f"{error['median']:.2f}\N{DEGREE SIGN}", text)]


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
