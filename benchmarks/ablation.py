"""The paper's own studies on public data: what deforms, how the fit is staged, the loss, the number of primitives and of
training spectra, the resolution.

Every variant changes one thing of the default with the size and length that the default finds for the scene, so that all
take about as long. The columns are those of the paper's tables; its numbers are of its own data and stand beside for
orientation only.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from record import write_result

from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, Spectra, fit, load_spectra, simulated_room
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import l1, psnr, ssim, summary

SCENES = (("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
SIZES = (16, 64, 256)
SHARES = (0.1, 0.3, 0.5, 0.7)  # of the training spectra
SEEDS = (0, 1)


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """the folder that holds s23-200, newrf-bedroom and newrf-office; without it only the simulated room"""
    quick: bool = False
    """one seed, 150 steps a fit"""


def main(config: Config) -> None:
    """Runs every variant on every scene and writes `results/ablation.json`."""
    if config.data is None:
        scenes: dict[str, tuple[Spectra, str]] = {"simulated-room random": (simulated_room(), "random")}
    else:
        scenes = {f"{name} {split}": (load_spectra(config.data / name), split) for name, split in SCENES}
    began = time.perf_counter()
    results = {name: study(name, *scene, config) for name, scene in scenes.items()}
    seconds = time.perf_counter() - began
    name = "ablation_quick" if config.quick else "ablation"
    write_result(name, {"seeds": SEEDS[:1] if config.quick else SEEDS, "seconds": seconds, "scenes": results})


def study(name: str, data: Spectra, split: str, config: Config) -> dict[str, Any]:
    """All variants on one scene."""
    train, test = data.split(split)
    validation = validation_for(split)
    base = FitConfig(validation=validation)
    if config.quick:
        base = replace(base, model=ModelConfig(n_primitives=64), steps=150)
    else:
        records: list[dict[str, Any]] = []
        found = fit(train, base, progress=False, on_record=records.append)
        base = replace(base, model=found.config, steps=records[-1]["steps"])
    cases = {variant: (train, test, changed) for variant, changed in variants(base).items()}
    for share in SHARES:
        kept = torch.randperm(len(train), generator=torch.Generator().manual_seed(0))[: round(share * len(train))]
        changed = replace(base, model=replace(base.model, rank="auto"))
        cases[f"{share:.0%} of the training spectra"] = (train.subset(kept.sort().values), test, changed)
    if data.array is not None and config.data is not None:  # ray paths can be seen at any resolution
        fine = load_spectra(config.data / data.name, grid=AngularGrid.hemisphere(180, 720))
        cases["seen at 0.5 degrees"] = (*fine.split(split), base)
    results = {}
    for variant, case in cases.items():
        results[variant] = measure(*case, SEEDS[:1] if config.quick else SEEDS)
        print(name, variant, in_words(results[variant]), flush=True)
    default = {"n_primitives": base.model.n_primitives, "rank": base.model.rank, "steps": base.steps}
    return {"n_train": len(train), "n_test": len(test), "default": default, "variants": results}


def variants(base: FitConfig) -> dict[str, FitConfig]:
    """Each changes one thing."""

    def model(**changes: Any) -> FitConfig:
        return replace(base, model=replace(base.model, **changes))

    return {
        "default": base,
        "mean, response, attenuation deform": model(components=("mean", "response", "attenuation")),
        "mean, response deform": model(components=("mean", "response")),
        "mean, attenuation deform": model(components=("mean", "attenuation")),
        "response, attenuation deform": model(components=("response", "attenuation")),
        "nothing deforms": model(deformation="none"),
        "axis-aligned covariance": model(axis_aligned=True),
        "per-primitive network": replace(model(deformation="per_primitive_mlp"), rate=1e-2, deformation_rate=2e-3),
        "coarse stage of 15 %": replace(base, coarse_share=0.15),
        "coarse stage, then means stopped": replace(base, coarse_share=0.15, stop_mean=True),
        "annealed noise on positions": replace(base, smoothing=1.0, smoothing_steps=int(base.steps)),
        "no SSIM term": replace(base, ssim_weight=0.0),
        "SSIM term of 0.6": replace(base, ssim_weight=0.6),
        "squared error instead of L1": replace(base, pixel_loss="l2"),
        "fitted on all pixels": replace(base, max_azimuths=0),
        **{f"{n} primitives": model(n_primitives=n) for n in SIZES},
    }


def measure(train: Spectra, test: Spectra, config: FitConfig, seeds: tuple[int, ...]) -> dict[str, Any]:
    """Scores over the test spectra, averaged over seeds, with each seed's medians; or why there is no fit."""
    scores: dict[str, list[torch.Tensor]] = {"ssim": [], "psnr_db": [], "l1": []}
    began = time.perf_counter()
    try:
        for seed in seeds:
            drawn = fit(train, replace(config, seed=seed), progress=False).synthesize(test.position)
            for key, score in (("ssim", ssim), ("psnr_db", psnr), ("l1", l1)):
                scores[key].append(score(drawn, test.spectrum))
    except InputError as error:
        return {"refusal": str(error)}
    result: dict[str, Any] = {key: summary(torch.stack(values).mean(dim=0)) for key, values in scores.items()}
    result["psnr_db"]["of_seeds"] = [float(values.median()) for values in scores["psnr_db"]]
    return result | {"seconds": (time.perf_counter() - began) / len(seeds)}


def in_words(result: dict[str, Any]) -> str:
    """One line."""
    if "refusal" in result:
        return str(result["refusal"])
    return f"SSIM {result['ssim']['median']:.4f} PSNR {result['psnr_db']['median']:.2f} {result['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Config))
