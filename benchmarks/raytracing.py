"""Compare `raytrace` with other field models in the three furnished rooms. It needs the extra `raytrace`.

No model receives the room's geometry. tasks.scenes traces each room again, so the result contains the tracing time, too.
Spectra have 30 x 120 pixels and are split at random. Each finished row is saved in the folder `--work`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import tyro
from record import write_result

from swiftwrf import AngularGrid, Spectra, load_spectra, make_model
from swiftwrf.choices import Moving
from swiftwrf.data.raytraced import ROOMS
from swiftwrf.metrics import psnr, ssim, summary
from swiftwrf.runtime.durable import write_text
from tasks.scenes.options import ScenesConfig
from tasks.scenes.run import run

GRID = AngularGrid.hemisphere(30, 120)
METHODS = ("nearest", "gp", "coarray", "swiftwrf", "geometry", "hybrid", "raytrace")


@dataclass(frozen=True)
class Config:
    positions: int = 200
    """of each scene, a fifth of them for the test"""
    work: Path = Path("runs/raytracing")
    """folder of the scenes and of what is measured so far"""


def main(config: Config) -> None:
    """Measure missing rows and write `results/raytracing.json`."""
    scenes = {}
    for room in ROOMS:
        for moving in get_args(Moving):
            name = f"{room} {moving} {config.positions}"
            folder, file = config.work / name, config.work / f"{name}.json"
            if not folder.exists():
                run(ScenesConfig(room=room, moving=moving, positions=config.positions, out=str(folder)))
            if not file.exists():
                write_text(file, json.dumps(measure(folder)))
            scenes[f"{room}, {moving}"] = json.loads(file.read_text())
    write_result("raytracing", {"grid": GRID.shape, "scenes": scenes})


def measure(folder: Path) -> dict[str, Any]:
    """Return the scores of every method at the test positions, the estimated room, and the seconds."""
    scene = json.loads((folder / "scene.json").read_text())
    train, test = load_spectra(folder, grid=GRID).split("random")
    scores: dict[str, Any] = {"mean": score(train.spectrum.mean(dim=0).expand_as(test.spectrum), test)}
    found = None
    for name in METHODS:
        model, began = make_model(name), time.perf_counter()
        model.fit(train)
        fitted = time.perf_counter()
        predicted = model.synthesize(test.position)
        seconds = {"fit": fitted - began, "synthesize": time.perf_counter() - fitted}
        scores[name] = score(predicted, test) | {"seconds": seconds}
        if name == "geometry" and model.room is not None:
            found = model.room.to_json()["planes"]
        print(f"{folder.name} {name}: {scores[name]['psnr_db']['median']:.2f} dB, {seconds['fit']:.0f} s", flush=True)
    kept = ("positions", "line_of_sight", "paths_per_position", "seconds")
    return {"traced": {key: scene[key] for key in kept}, "n_train": len(train), "planes": found, "methods": scores}


def score(predicted: Any, test: Spectra) -> dict[str, Any]:
    """Return PSNR and SSIM of predicted spectra."""
    return {"psnr_db": summary(psnr(predicted, test.spectrum)), "ssim": summary(ssim(predicted, test.spectrum))}


if __name__ == "__main__":
    main(tyro.cli(Config))
