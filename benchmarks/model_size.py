"""Measure quality against size: fits with fixed numbers of primitives beside the number that the fit chooses."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from record import write_result
from synthesis import SCENES

from swiftwrf import Spectra, fit, load_spectra, simulated_room
from swiftwrf.data.splits import Validation, validation_for
from swiftwrf.metrics import psnr, ssim, summary
from swiftwrf.rasterize import prepare
from swiftwrf.rssi import Map
from tasks.workers import connected

SIZES = (16, 32, 64, 128, 256, 512, 1024)


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """folder with s23-200, newrf-bedroom and newrf-office. Defaults to the simulated room alone"""
    seed: int = 0
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the fits (extra: cluster)"""


def main(config: Config) -> None:
    """Fit every size on every scene and write `results/model_size.json`."""
    scenes: dict[str, tuple[Spectra, str]] = {"simulated-room random": (simulated_room(), "random")}
    if config.data is not None:
        scenes |= {f"{name} {split}": (load_spectra(config.data / name), split) for name, split in SCENES}
    with connected(config.scheduler, torch.device("cpu")) as cluster:
        parallel = cluster.map if cluster else map
        results = {name: measure(name, *scene, config.seed, parallel) for name, scene in scenes.items()}
        workers = {"workers": sorted(cluster.machines)} if cluster else {}
    write_result("model_size", {"seed": config.seed, **workers, "scenes": results})


def measure(name: str, data: Spectra, split: str, seed: int, parallel: Map) -> dict[str, Any]:
    """Return the fit that chooses its size, and one fit of each size."""
    train, test = data.split(split, seed)
    sizes = (*SIZES, None)  # the first fit of a process bears what is done once
    results = []
    for size, result in zip(
        sizes, parallel(partial(fitted, train, test, validation_for(split), seed), sizes), strict=True
    ):
        found = f"{result['n_primitives']} {result['psnr_db']['median']:.2f} dB {result['seconds']:.0f} s"
        print(name, "fixed" if size else "auto", found, flush=True)
        results.append(result)
    return {"auto": results[-1], "fixed": results[:-1]}


def fitted(train: Spectra, test: Spectra, validation: Validation, seed: int, n: int | None) -> dict[str, Any]:
    """Return size, test scores and seconds of a fit with `n` primitives, or with the number that it chooses."""
    prepare("cpu")
    began, busy = time.perf_counter(), time.process_time()
    model = fit(train, n_primitives=n or "auto", validation=validation, seed=seed)
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    drawn = model.synthesize(test.position)
    return {
        "n_primitives": len(model.mean),
        "rank": len(model.weight) - 1,
        "parameters": sum(p.numel() for p in model.parameters()),
        "psnr_db": summary(psnr(drawn, test.spectrum)),
        "ssim": summary(ssim(drawn, test.spectrum)),
        "seconds": seconds,
        "processor_seconds": busy,
    }


if __name__ == "__main__":
    main(tyro.cli(Config))
