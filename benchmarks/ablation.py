"""Repeat the paper's ablation studies on public data: deformed parameters, stages, loss, primitives, training spectra, grid.

Every variant changes one option: of the default, which is a regression, or of a fit by gradient as in the paper, with equal
sizes and numbers of steps. The paper's numbers come from other data and are shown for orientation only.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from record import write_result

from swiftwrf import (
    AngularGrid,
    FitConfig,
    FitError,
    InputError,
    ModelConfig,
    Spectra,
    fit,
    load_spectra,
    simulated_room,
)
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import l1, psnr, ssim, summary
from swiftwrf.rssi import Map
from tasks.cluster import connected

SCENES = (("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
SIZES = (16, 64, 256)
SHARES = (0.1, 0.3, 0.5, 0.7)  # of the training spectra
SEEDS = (0, 1)
SIZE, STEPS = 64, 600  # of the fits by gradient
ALL = ("mean", "response", "attenuation", "cholesky")


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """folder with s23-200, newrf-bedroom and newrf-office. Defaults to the simulated room alone"""
    large: Path | None = None
    """folder of a scene of thousands of positions. It is measured alone and by regression alone, into ablation_large.json"""
    quick: bool = False
    """one seed, 150 steps a fit"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the variants (extra: cluster)"""


@dataclass(frozen=True)
class Case:
    """One variant: its configuration, its seeds, and the rows of the training spectra (None: all)."""

    config: FitConfig
    seeds: tuple[int, ...]
    rows: torch.Tensor | None = None


def main(config: Config) -> None:
    """Run every variant on every scene and write `results/ablation.json`."""
    scenes: dict[str, tuple[Path | None, str]] = {"simulated-room random": (None, "random")}
    if config.large is not None:
        scenes = {f"{config.large.name} random": (config.large, "random")}
    elif config.data is not None:
        scenes = {f"{name} {split}": (config.data / name, split) for name, split in SCENES}
    began = time.perf_counter()
    with connected(config.scheduler, torch.device("cpu")) as cluster:
        parallel = cluster.map if cluster else map
        results = {name: study(name, *scene, config, parallel) for name, scene in scenes.items()}
        workers = {"workers": sorted(cluster.machines)} if cluster else {}
    seconds = time.perf_counter() - began
    name = "ablation_large" if config.large else "ablation_quick" if config.quick else "ablation"
    seeds = SEEDS[:1] if config.quick else SEEDS
    write_result(name, {"seeds": seeds, "seconds": seconds, **workers, "scenes": results})


def study(name: str, folder: Path | None, split: str, config: Config, parallel: Map) -> dict[str, Any]:
    """Return the scores of all variants on the scene of a folder, or on the built-in room."""
    data = load_spectra(folder) if folder else simulated_room()
    train, test = data.split(split)
    default = FitConfig(validation=validation_for(split))
    steps = 150 if config.quick else STEPS
    gradient = replace(default, model=ModelConfig(n_primitives=SIZE, components=ALL), steps=steps)

    def case(changed: FitConfig, rows: torch.Tensor | None = None) -> Case:
        return Case(changed, SEEDS if changed.steps and not config.quick else SEEDS[:1], rows)  # regression has no luck

    def scores(train: Spectra, test: Spectra, cases: dict[str, Case]) -> dict[str, Any]:
        found = {}
        results = parallel(partial(measure, train, test), cases.values())
        for variant, found[variant] in zip(cases, results, strict=True):
            print(name, variant, in_words(found[variant]), flush=True)
        return found

    cases = {
        variant: case(changed)
        for variant, changed in variants(default, gradient).items()
        if not (config.large and changed.steps)
    }
    for share in SHARES:
        kept = torch.randperm(len(train), generator=torch.Generator().manual_seed(0))[: round(share * len(train))]
        cases[f"{share:.0%} of the training spectra"] = case(default, kept.sort().values)
    results = scores(train, test, cases)
    if data.array is not None and folder:  # ray paths can be seen at any resolution
        fine = load_spectra(folder, grid=AngularGrid.hemisphere(180, 720))
        results |= scores(*fine.split(split), {"seen at 0.5 degrees": case(default)})
    return {"n_train": len(train), "n_test": len(test), "steps": steps, "variants": results}


def variants(default: FitConfig, gradient: FitConfig) -> dict[str, FitConfig]:
    """Return the variants of the default, and of a fit by gradient in which all parameters deform."""

    def model(base: FitConfig, **changes: Any) -> FitConfig:
        return replace(base, model=replace(base.model, **changes))

    network = model(gradient, deformation="per_primitive_mlp")
    return {
        "default (by regression)": default,
        **{f"{n} primitives": model(default, n_primitives=n) for n in SIZES},
        "axis-aligned covariance": model(default, axis_aligned=True),
        "nothing deforms": model(default, deformation="none"),
        "fitted on all pixels": replace(default, max_azimuths=0),
        "by gradient, all four deform": gradient,
        "mean, response, attenuation deform": model(gradient, components=("mean", "response", "attenuation")),
        "mean, response deform": model(gradient, components=("mean", "response")),
        "mean, attenuation deform": model(gradient, components=("mean", "attenuation")),
        "response, attenuation deform": model(gradient, components=("response", "attenuation")),
        "per-primitive network": replace(network, deformation_rate=2e-3),
        "coarse stage of 15 %": replace(gradient, coarse_fraction=0.15),
        "coarse stage, then means stopped": replace(gradient, coarse_fraction=0.15, stop_mean=True),
        "annealed noise on positions": replace(gradient, smoothing=1.0, smoothing_steps=gradient.steps),
        "no SSIM term": replace(gradient, ssim_weight=0.0),
        "SSIM term of 0.6": replace(gradient, ssim_weight=0.6),
        "squared error instead of L1": replace(gradient, pixel_loss="l2"),
    }


def measure(train: Spectra, test: Spectra, case: Case) -> dict[str, Any]:
    """Return the scores over the test spectra, averaged over seeds, or the reason why the fit was refused."""
    kept = train if case.rows is None else train.subset(case.rows)
    scores: dict[str, list[torch.Tensor]] = {"ssim": [], "psnr_db": [], "l1": []}
    began = time.perf_counter()
    try:
        for seed in case.seeds:
            drawn = fit(kept, replace(case.config, seed=seed), progress=False).synthesize(test.position)
            for key, score in (("ssim", ssim), ("psnr_db", psnr), ("l1", l1)):
                scores[key].append(score(drawn, test.spectrum))
    except (InputError, FitError) as error:
        return {"refusal": str(error)}
    result: dict[str, Any] = {key: summary(torch.stack(values).mean(dim=0)) for key, values in scores.items()}
    result["psnr_db"]["of_seeds"] = [float(values.median()) for values in scores["psnr_db"]]
    return result | {"seconds": (time.perf_counter() - began) / len(case.seeds)}


def in_words(result: dict[str, Any]) -> str:
    """Return a result in one line."""
    if "refusal" in result:
        return str(result["refusal"])
    return f"SSIM {result['ssim']['median']:.4f} PSNR {result['psnr_db']['median']:.2f} {result['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Config))
