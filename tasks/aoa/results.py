"""From the rows of a run to what metrics.json says of each share."""

from __future__ import annotations

from pandas import DataFrame

from tasks.aoa import arms
from tasks.metrics import ANGLES, SCORES, AdviceMetrics, ArmMetrics, ChoiceMetrics, MixMetrics, SynthesisMetrics
from tasks.run import Row
from tasks.summarise import averaged, repeats_averaged


def mix_metrics(
    share: float,
    n_measured: int,
    counts: dict[str, dict[str, int]],
    choice: ChoiceMetrics | None,
    advice: AdviceMetrics | None,
    rows: dict[str, list[Row]],
) -> MixMetrics:
    """What metrics.json says of one share.

    Args:
        share: measured.
        n_measured: spectra.
        counts: of spectra by origin in each training set.
        choice, advice: of the first repeat, where there are any.
        rows: `errors` and `arm_seconds` of pooled arms, `training_seconds` of what was trained, `synthesis` and
            `synthesis_seconds` of all shares, the last with whether the spectra train an arm.
    """
    own = {name: DataFrame([row for row in table if row["mix"] == share]) for name, table in rows.items()}
    training, fits = own["training_seconds"], own["synthesis_seconds"]
    asked_for = fits[fits["trains"]]
    networks = training[[arms.estimator_of(name) == arms.NETWORK for name in training["method"]]]
    return {
        "n_measured": n_measured,
        "counts": counts,
        "choice": choice,
        "advice": advice,
        "synthesis": _synthesis_metrics(own["synthesis"], fits),
        "methods": _arm_metrics(own["errors"], own["arm_seconds"]),
        "seconds": {
            "fit": float(asked_for["fit"].sum()),
            "synthesize": float(asked_for["draw"].sum()),
            "train": float(networks["train"].sum()),
        },
    }


def _synthesis_metrics(scores: DataFrame, seconds: DataFrame) -> dict[str, SynthesisMetrics]:
    spent = averaged(seconds, "synthesizer", ("fit", "synthesize"))
    return {
        name: {
            "psnr_db": of["psnr_db"],
            "ssim": of["ssim"],
            "l1": of["l1"],
            "seconds": {"fit": spent[name]["fit"], "synthesize": spent[name]["synthesize"]},
        }
        for name, of in repeats_averaged(scores, "synthesizer", SCORES).items()
    }


def _arm_metrics(errors: DataFrame, seconds: DataFrame) -> dict[str, ArmMetrics]:
    spent = averaged(seconds, "method", ("train", "estimate"))
    return {
        name: {
            "azimuth_deg": of["azimuth_deg"],
            "elevation_deg": of["elevation_deg"],
            "great_circle_deg": of["great_circle_deg"],
            "seconds": {"train": spent[name]["train"], "estimate": spent[name]["estimate"]},
        }
        for name, of in repeats_averaged(errors, "method", ANGLES).items()
    }
