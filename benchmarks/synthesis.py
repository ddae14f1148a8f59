"""Measure how well each field model predicts spectra at unseen positions, and the time it takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from record import write_result

from swiftwrf import Spectra, load_spectra, make_model, simulated_room
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.splits import TEST_SHARE, block_split, validation_for
from swiftwrf.metrics import covered, l1, psnr, ssim, summary
from swiftwrf.models.coarray import project

S23_ARRAY = PlanarArray.square(4, 915e6, spacing=0.16)  # the files of s23-200 do not describe it
SCENES = (("s23-200", "random"), ("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))


@dataclass(frozen=True)
class Config:
    data: Path
    """folder with s23-200, newrf-bedroom and newrf-office"""
    scenes: tuple[str, ...] = ()
    """data sets to measure. Defaults to all of them and the simulated room"""
    seed: int = 0


def main(config: Config) -> None:
    """Measure every field model on every scene and write `results/synthesis.json`."""
    chosen = [(name, split) for name, split in SCENES if not config.scenes or name in config.scenes]
    results = {f"{name} {split}": measure(load(config.data / name), split, config.seed) for name, split in chosen}
    slabs = {}
    if not config.scenes:
        room = simulated_room()
        results["simulated-room random"] = measure(room, "random", config.seed)
        slabs = {data.name: covered_slabs(data) for data in (load(config.data / "s23-200"), room)}
    write_result("synthesis", {"seed": config.seed, "scenes": results, "slabs_covered_by_80": slabs})


def load(folder: Path) -> Spectra:
    """Load spectra with the array that measured them."""
    data = load_spectra(folder)
    return replace(data, array=S23_ARRAY) if data.name.startswith("s23") else data


def measure(data: Spectra, split: str, seed: int) -> dict[str, Any]:
    """Return the scores at the test positions of each field model, of the mean training spectrum, and of SwiftWRF projected
    onto the spectra that the array can produce."""
    train, test = data.split(split, seed)
    predicted = {"mean": train.spectrum.mean(dim=0).expand_as(test.spectrum)}
    seconds: dict[str, dict[str, float]] = {}
    inside: dict[str, float] = {}
    for name in ("nearest", "idw", "gp", "coarray", "swiftwrf"):
        model = make_model(name, validation=validation_for(split), seed=seed)
        began = time.perf_counter()
        model.fit(train)
        fitted = time.perf_counter()
        predicted[name] = model.synthesize(test.position)
        seconds[name] = {"fit": fitted - began, "synthesize": time.perf_counter() - fitted}
        std = model.predict(test.position).std
        if std is not None:
            inside[name] = float(covered(predicted[name], std, test.spectrum).mean())
    if train.array is not None:
        stretched = data.name.startswith("s23")
        predicted["swiftwrf, projected"] = project(predicted["swiftwrf"], train.array, train.grid, stretched=stretched)
    scores = {
        name: {
            "ssim": summary(ssim(spectrum, test.spectrum)),
            "psnr_db": summary(psnr(spectrum, test.spectrum)),
            "l1": summary(l1(spectrum, test.spectrum)),
            "seconds": seconds.get(name),
            "covered_by_80": inside.get(name),
        }
        for name, spectrum in predicted.items()
    }
    for name, score in scores.items():
        print(
            f"{data.name} {split} {name}: SSIM {score['ssim']['median']:.4f} PSNR {score['psnr_db']['median']:.2f}",
            flush=True,
        )
    return {"n_train": len(train), "n_test": len(test), "grid": data.grid.shape, "synthesizers": scores}


def covered_slabs(data: Spectra) -> list[float]:
    """Return the fraction of pixels inside SwiftWRF's 80 % intervals for each slab, predicted from the other slabs.

    The single slab of a block split is too little to judge the calibration by.
    """
    fractions = []
    for slab in range(round(1 / TEST_SHARE)):
        train, test = map(data.subset, block_split(data.position, slab))
        predicted = make_model("swiftwrf", validation="block").fit(train).predict(test.position)
        assert predicted.std is not None
        fractions.append(float(covered(predicted.mean, predicted.std, test.spectrum).mean()))
    print(f"{data.name}, slabs covered: {' '.join(f'{fraction:.0%}' for fraction in fractions)}", flush=True)
    return fractions


if __name__ == "__main__":
    main(tyro.cli(Config))
