"""Repeat the paper's ablation studies on public data: number of primitives, training spectra, grid.

Every variant changes one option of the default. The paper's numbers come from other data and are shown for orientation only.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from record import write_result

from swiftwrf import AngularGrid, FitError, InputError, Spectra, fit, load_spectra, simulated_room
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import l1, psnr, ssim, summary
from swiftwrf.rssi import Map
from tasks.workers import connected

SCENES = (("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
SIZES = (16, 64, 256)
SHARES = (0.1, 0.3, 0.5, 0.7)  # of the training spectra


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """folder with s23-200, newrf-bedroom and newrf-office. Defaults to the simulated room alone"""
    large: Path | None = None
    """folder of a scene of thousands of positions. It is measured alone, into ablation_large.json"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the variants (extra: cluster)"""


@dataclass(frozen=True)
class Case:
    """One variant: its options, and the rows of the training spectra (None: all)."""

    options: dict[str, Any]
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
        results = {name: study(name, *scene, parallel) for name, scene in scenes.items()}
        workers = {"workers": sorted(cluster.machines)} if cluster else {}
    seconds = time.perf_counter() - began
    name = "ablation_large" if config.large else "ablation"
    write_result(name, {"seconds": seconds, **workers, "scenes": results})


def study(name: str, folder: Path | None, split: str, parallel: Map) -> dict[str, Any]:
    """Return the scores of all variants on the scene of a folder, or on the built-in room."""
    data = load_spectra(folder) if folder else simulated_room()
    train, test = data.split(split)
    default = {"validation": validation_for(split)}

    def scores(train: Spectra, test: Spectra, cases: dict[str, Case]) -> dict[str, Any]:
        found = {}
        results = parallel(partial(measure, train, test), cases.values())
        for variant, found[variant] in zip(cases, results, strict=True):
            print(name, variant, in_words(found[variant]), flush=True)
        return found

    cases = {variant: Case(options) for variant, options in variants(default).items()}
    for share in SHARES:
        kept = torch.randperm(len(train), generator=torch.Generator().manual_seed(0))[: round(share * len(train))]
        cases[f"{share:.0%} of the training spectra"] = Case(default, kept.sort().values)
    results = scores(train, test, cases)
    if data.array is not None and folder:  # ray paths can be seen at any resolution
        fine = load_spectra(folder, grid=AngularGrid.hemisphere(180, 720))
        results |= scores(*fine.split(split), {"seen at 0.5 degrees": Case(default)})
    return {"n_train": len(train), "n_test": len(test), "variants": results}


def variants(default: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the options of the variants."""
    return {
        "default": default,
        **{f"{n} primitives": default | {"n_primitives": n} for n in SIZES},
        "fitted on all pixels": default | {"max_azimuths": 0},
    }


def measure(train: Spectra, test: Spectra, case: Case) -> dict[str, Any]:
    """Return the scores over the test spectra, or the reason why the fit was refused."""
    kept = train if case.rows is None else train.subset(case.rows)
    began = time.perf_counter()
    try:
        drawn = fit(kept, **case.options).synthesize(test.position)
    except (InputError, FitError) as error:
        return {"refusal": str(error)}
    scores = {"ssim": ssim, "psnr_db": psnr, "l1": l1}
    found: dict[str, Any] = {key: summary(score(drawn, test.spectrum)) for key, score in scores.items()}
    return found | {"seconds": time.perf_counter() - began}


def in_words(result: dict[str, Any]) -> str:
    """Return a result in one line."""
    if "refusal" in result:
        return str(result["refusal"])
    return f"SSIM {result['ssim']['median']:.4f} PSNR {result['psnr_db']['median']:.2f} {result['seconds']:.0f} s"


if __name__ == "__main__":
    main(tyro.cli(Config))
