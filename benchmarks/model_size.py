"""Quality against size: fits of each number of primitives beside the one that the fit finds by itself."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from record import write_result
from synthesis import SCENES

from swiftwrf import FitConfig, ModelConfig, Spectra, fit, load_spectra, simulated_room
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import psnr, ssim, summary

SIZES = (16, 32, 64, 128, 256, 512, 1024)


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """the folder that holds s23-200, newrf-bedroom and newrf-office; without it only the simulated room"""
    seed: int = 0


def main(config: Config) -> None:
    """Fits every size on every scene."""
    scenes: dict[str, tuple[Spectra, str]] = {"simulated-room random": (simulated_room(), "random")}
    if config.data is not None:
        scenes |= {f"{name} {split}": (load_spectra(config.data / name), split) for name, split in SCENES}
    results = {name: measure(name, *scene, config.seed) for name, scene in scenes.items()}
    write_result("model_size", {"seed": config.seed, "scenes": results})


def measure(name: str, data: Spectra, split: str, seed: int) -> dict[str, Any]:
    """The fit that chooses, and one of each size."""
    train, test = data.split(split, seed)
    validation = validation_for(split)

    def fitted(n: int | None) -> dict[str, Any]:
        model_config = ModelConfig() if n is None else ModelConfig(n_primitives=n)
        began = time.perf_counter()
        model = fit(
            train,
            FitConfig(model=model_config, validation=validation, seed=seed),
            progress=False,
        )
        seconds = time.perf_counter() - began
        drawn = model.synthesize(test.position)
        result = {
            "n_primitives": model.config.n_primitives,
            "rank": model.config.rank,
            "parameters": sum(p.numel() for p in model.parameters()),
            "psnr_db": summary(psnr(drawn, test.spectrum)),
            "ssim": summary(ssim(drawn, test.spectrum)),
            "seconds": seconds,
        }
        label = "auto" if n is None else "fixed"
        print(name, label, result["n_primitives"], f"{result['psnr_db']['median']:.2f} dB {seconds:.0f} s", flush=True)
        return result

    return {"auto": fitted(None), "fixed": [fitted(n) for n in SIZES]}


if __name__ == "__main__":
    main(tyro.cli(Config))
