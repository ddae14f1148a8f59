"""What the report says first: three numbers, a picture, what they mean, what to do next."""

from __future__ import annotations

from tasks.aoa import arms
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.page.room import advice_sentence
from tasks.aoa.share import Share
from tasks.page.page import Number, Plot, Summary


def summary(share: Share, picture: Plot) -> Summary:
    """Of one share."""
    metrics, mix = share.run.metrics, share.mix
    error = {name: arm["great_circle_deg"] for name, arm in mix["methods"].items()}
    turbo = arms.taken(error)
    lower, upper = error[arms.LOWER.name]["median"], error[arms.UPPER.name]["median"]
    own, best = error[turbo], min(error, key=lambda name: error[name]["median"])
    drawn_by = share.drawn_by([turbo])[0]
    quality = mix["synthesis"][drawn_by]["psnr_db"]
    numbers = [
        Number(
            f"{own['median']:.2f}\N{DEGREE SIGN}",
            f"median great-circle error of the network with turbo learning ({turbo}), 95 % interval "
            f"[{own['low']:.2f}, {own['high']:.2f}]",
        ),
        Number(
            f"{own['median'] / lower - 1:+.0%}".replace("-", "\N{MINUS SIGN}"),
            f"against {lower:.2f} degrees with the measured share alone; everything measured: {upper:.2f}",
        ),
        Number(
            f"{quality['median']:.1f} dB",
            f"median PSNR of the spectra that {drawn_by} synthesizes where nobody measured",
        ),
    ]
    meaning = [
        f"On {share.run.scene}, {mix['n_measured']} of {metrics['n_train']} training spectra are measured "
        f"({share.percent}); the spectra at the other positions are synthesized, and the network learns from both. "
        f"It is tested on {metrics['n_test']} spectra that nothing here has seen.",
        f"The best of all arms is {best} with a median error of {error[best]['median']:.2f} degrees.",
        *filter(None, [advice_sentence(share)]),
    ]
    return Summary(numbers, picture, meaning, _next_steps(share, best))


def _next_steps(share: Share, best: str) -> list[str]:
    metrics, key = share.run.metrics, share.key
    steps = []
    if arms.estimator_of(best) != arms.NETWORK:
        steps.append(
            f"Use {arms.estimator_of(best)} rather than the network here: it is more accurate and cheaper to train."
        )
    if metrics["repeats"] == 1:
        steps.append(
            "One draw of the measured share proves little: repeat with --repeats 3 before you rely on a difference."
        )
    if metrics["split"] == "random" and metrics["data"] != "simulated-room":
        steps.append("Run --split block: it shows the error in a region where nothing was measured.")
    if (share.run.folder / f"suggested-mix{key}.csv").is_file():
        steps.append(f"Measure next at the positions in suggested-mix{key}.csv; the section below has their map.")
    else:
        steps.append("Ask where to measure next with --suggest 20.")
    files = {
        file.name.removesuffix(f"-mix{key}.safetensors") for file in share.run.folder.glob(f"*-mix{key}.safetensors")
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
