"""How well each synthesizer draws spectra at positions that it has not seen, and how long it takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from record import write_result

from augment import Settings, make_synthesizer
from swiftwrf import Spectra, load_spectra, project, simulated_room
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.splits import TEST_SHARE, block_split, validation_for
from swiftwrf.metrics import covered, l1, psnr, ssim, summary

S23_ARRAY = PlanarArray.square(4, 915e6, spacing=0.16)  # which the files of s23-200 do not describe
SCENES = (("s23-200", "random"), ("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))


@dataclass(frozen=True)
class Config:
    data: Path
    """the folder that holds s23-200, newrf-bedroom and newrf-office"""
    scenes: tuple[str, ...] = ()
    """only these data sets"""
    seed: int = 0


def main(config: Config) -> None:
    """Measures every synthesizer on every scene."""
    chosen = [(name, split) for name, split in SCENES if not config.scenes or name in config.scenes]
    results = {f"{name} {split}": measure(load(config.data / name), split, config.seed) for name, split in chosen}
    slabs = {}
    if not config.scenes:
        room = simulated_room()
        results["simulated-room random"] = measure(room, "random", config.seed)
        slabs = {data.name: covered_slabs(data) for data in (load(config.data / "s23-200"), room)}
    write_result("synthesis", {"seed": config.seed, "scenes": results, "slabs_covered_by_80": slabs})


def load(folder: Path) -> Spectra:
    """The spectra, with the array that took them."""
    data = load_spectra(folder)
    return replace(data, array=S23_ARRAY) if data.name.startswith("s23") else data


def measure(data: Spectra, split: str, seed: int) -> dict[str, Any]:
    """Scores of each synthesizer, of the mean training spectrum, and of SwiftWRF projected onto what the array can
    produce, at the test positions."""
    train, test = data.split(split, seed)
    drawn = {"mean": train.spectrum.mean(dim=0).expand_as(test.spectrum)}
    seconds: dict[str, dict[str, float]] = {}
    inside: dict[str, float] = {}
    for name in ("nearest", "idw", "gp", "coarray", "swiftwrf"):
        synthesizer = make_synthesizer(name, Settings(validation=validation_for(split), seed=seed))
        began = time.perf_counter()
        synthesizer.fit(train)
        fitted = time.perf_counter()
        drawn[name] = synthesizer.synthesize(test.position)
        seconds[name] = {"fit": fitted - began, "synthesize": time.perf_counter() - fitted}
        deviation = synthesizer.deviation(test.position)
        if deviation is not None:
            inside[name] = float(covered(drawn[name], deviation, test.spectrum).mean())
    if train.array is not None:
        stretched = data.name.startswith("s23")
        drawn["swiftwrf, projected"] = project(drawn["swiftwrf"], train.array, train.grid, stretched=stretched)
    scores = {
        name: {
            "ssim": summary(ssim(spectrum, test.spectrum)),
            "psnr_db": summary(psnr(spectrum, test.spectrum)),
            "l1": summary(l1(spectrum, test.spectrum)),
            "seconds": seconds.get(name),
            "covered_by_80": inside.get(name),
        }
        for name, spectrum in drawn.items()
    }
    for name, score in scores.items():
        print(
            f"{data.name} {split} {name}: SSIM {score['ssim']['median']:.4f} PSNR {score['psnr_db']['median']:.2f}",
            flush=True,
        )
    return {"n_train": len(train), "n_test": len(test), "grid": data.grid.shape, "synthesizers": scores}


def covered_slabs(data: Spectra) -> list[float]:
    """Share of the pixels that lie in SwiftWRF's 80 % intervals, of each slab that the others draw: a single slab, as a
    block split has it, says little of how well they are calibrated."""
    shares = []
    for slab in range(round(1 / TEST_SHARE)):
        train, test = map(data.subset, block_split(data.position, slab))
        synthesizer = make_synthesizer("swiftwrf", Settings(validation="block"))
        synthesizer.fit(train)
        deviation = synthesizer.deviation(test.position)
        assert deviation is not None
        shares.append(float(covered(synthesizer.synthesize(test.position), deviation, test.spectrum).mean()))
    print(f"{data.name}, slabs covered: {' '.join(f'{share:.0%}' for share in shares)}", flush=True)
    return shares


if __name__ == "__main__":
    main(tyro.cli(Config))
