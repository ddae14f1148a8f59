"""Summary of the report: three numbers, a picture, their meaning, next steps."""

from __future__ import annotations

from tasks.aoa.condition import headline
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.page.records import FractionRecords
from tasks.aoa.page.room import advice_sentences
from tasks.page.page import Number, Plot, Summary


def summary(fraction: FractionRecords, picture: Plot) -> Summary:
    """Return the summary of one measured fraction."""
    metrics, mix = fraction.run.metrics, fraction.mix
    error = {name: method["great_circle_deg"] for name, method in mix["methods"].items()}
    turbo = headline(fraction.conditions.values()).method
    lower, upper = error["measured_only"]["median"], error["measured_all"]["median"]
    own, best = error[turbo], min(error, key=lambda name: error[name]["median"])
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
        Number(
            f"{quality['median']:.1f} dB",
            f"median PSNR of the spectra that {synthesizer} predicts at positions without a measurement",
        ),
    ]
    meaning = [
        f"On {fraction.run.scene}, {mix['n_measured']} of {metrics['n_train']} training spectra are measured "
        f"({fraction.percent}); the spectra at the other positions are synthesized, and the network learns from both. "
        f"It is tested on {metrics['n_test']} spectra that take no part in any fit.",
        f"The best of all methods is {best} with a median error of {error[best]['median']:.2f} degrees.",
        *advice_sentences(fraction),
    ]
    return Summary(numbers, picture, meaning, _next_steps(fraction, best))


def _next_steps(fraction: FractionRecords, best: str) -> list[str]:
    metrics, key = fraction.run.metrics, fraction.key
    steps = []
    if best in fraction.conditions and not fraction.conditions[best].is_network:
        estimator = fraction.conditions[best].estimator
        steps.append(f"Use {estimator} rather than the network here: it is more accurate and cheaper to train.")
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
    estimators = sorted(files & set(ESTIMATORS))
    steps += [
        f"Estimate directions: python -m tasks.estimate {name}-mix{key}.safetensors SOURCE." for name in estimators
    ]
    steps += [
        f"Draw spectra anywhere: swiftwrf.load('{name}-mix{key}.safetensors').synthesize(position)."
        for name in sorted(files - set(ESTIMATORS))
    ]
    return steps
