"""Measure every field model on ray-traced scenes of the size of the paper's: 6,000 positions a scene.

The positions lie at one height, as a trolley would measure them. Scenes are traced into the folder `--data`, unless they are
there. Each measured row is kept in the folder `--work`, and unfinished fits and runs continue from their state. Rows of the
committed result that were not measured again stay in the result. Seconds on a CPU are processor seconds of one thread, so
that other work on the machine changes them little. With `--device cuda` the fits by gradient descent have the settings of
their publications, shortened to minutes, and seconds are wall-clock.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from committed import RESULTS
from comparison import MEAN, SHARES, milliseconds, weight
from record import write_result
from torch import Tensor

from swiftwrf import Spectra, load_spectra, make_model
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.choices import Moving
from swiftwrf.data.raytraced import ROOMS
from swiftwrf.data.splits import validation_for
from swiftwrf.gp import subsample
from swiftwrf.metrics import l1, psnr, ssim, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.base import FieldModel
from swiftwrf.positions import Neighbours
from swiftwrf.runtime.durable import write_text
from swiftwrf.runtime.threads import set_threads
from tasks.aoa.experiment import run as run_aoa
from tasks.aoa.options import AoaConfig
from tasks.environment import machine
from tasks.scenes.options import ScenesConfig
from tasks.scenes.run import run as trace

POSITIONS, QUICK_POSITIONS = 6000, 300
HEIGHT_M = 1.2  # of all positions
SCENES: tuple[tuple[str, Moving], ...] = tuple(
    (room, moving) for room in ("conference", "office", "bedroom") for moving in ("transmitter", "receiver")
)
CLOSED_FORM = (MEAN, "nearest", "idw", "gp", "coarray", "geometry", "hybrid", "swiftwrf")
BY_GRADIENT = ("nerf2", "wrfgs", "vae", "dcgan", "swiftwrf_paper")
METHODS = (*CLOSED_FORM, *BY_GRADIENT)
ON_GPU: dict[str, dict[str, Any]] = {  # changes of the paper presets, for a few minutes of a GPU
    "nerf2": {"width": 128, "batch": 2048, "steps": 4000, "decay_steps": None},
    "wrfgs": {"steps": 5000, "decay_steps": None},
    "vae": {"width": 32, "batch": 32, "steps": 4000},
    "dcgan": {"width": 32, "batch": 32, "steps": 4000},
    "swiftwrf_paper": {"n_primitives": 2000, "batch": 16, "steps": 20_000, "smoothing_steps": 2000},
}
QUICK_DIVISOR = 20  # of the steps of a fit by gradient descent under --quick
JUDGES = 200  # test spectra of a split, evenly chosen: a neural field takes seconds to predict one
COUNTS, QUICK_COUNTS = (200, 500, 1000, 2000, 3000), (60, 120)  # training spectra
TURBO = ("swiftwrf", "nerf2", "wrfgs", "hybrid")
CPU = torch.device("cpu")
Split = Literal["random", "block"]
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the scenes; those that are missing are traced (extra: raytrace)"""
    only: tuple[str, ...] = tuple(f"{room}-{moving}" for room, moving in SCENES)
    """scenes to measure"""
    parts: tuple[Literal["scenes", "counts", "aoa"], ...] = ("scenes", "counts", "aoa")
    """every method on every scene; with fewer training spectra; angle of arrival. All but the first on the first scene
    only"""
    splits: tuple[Split, ...] = ("random", "block")
    """splits of the scenes"""
    methods: tuple[str, ...] = METHODS
    """methods of the part `scenes`"""
    steps: int | None = None
    """number of steps of every fit by gradient descent. Defaults to that of each quick preset"""
    synthesizers: tuple[str, ...] = TURBO
    """field models of the part `aoa`"""
    repeats: int = 3
    """draws of the measured spectra in the part `aoa`"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where fits run; on a GPU only those by gradient descent"""
    quick: bool = False
    """300 positions, a twentieth of the steps, no angle of arrival"""
    work: Path = Path("runs/paper_scale")
    """folder of the rows measured so far"""
    seed: int = 0
    """seed of scenes, splits and fits"""


def main(config: Config) -> None:
    """Measure the missing rows and write `results/paper_scale.json` (with `_quick`, `_gpu`)."""
    torch.set_num_threads(1)
    positions = QUICK_POSITIONS if config.quick else POSITIONS
    gpu = "" if config.device == "cpu" else "_gpu"
    work = config.work / f"{positions}{gpu}"
    work.mkdir(parents=True, exist_ok=True)
    name = f"paper_scale{'_quick' if config.quick else ''}{gpu}"
    for room, moving in SCENES:
        scene = f"{room}-{moving}"
        if scene not in config.only:
            continue
        folder = traced(room, moving, positions, config)
        data = load_spectra(folder)
        first = (room, moving) == SCENES[0]
        write_text(work / f"{scene}.scene.json", json.dumps(described(room, data, folder)))
        for split in config.splits:
            train, test = data.split(split, config.seed)
            measure(config, work / f"{scene} {split}", train, test, split, first)
        if first and "aoa" in config.parts and not config.quick:
            estimate_angles(config, folder, work)
        write_result(name, gathered(work, name) | {"positions": positions, "height_m": HEIGHT_M, "seed": config.seed})


def traced(room: str, moving: Moving, positions: int, config: Config) -> Path:
    """Return the folder of a scene, traced unless it is there."""
    folder = config.data / str(positions) / f"{room}-{moving}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        (x, y, _), (far_x, far_y, _) = ROOMS[room].region
        region = (x, y, HEIGHT_M, far_x, far_y, HEIGHT_M)
        trace(ScenesConfig(room, moving, positions, str(folder), region=region, seed=config.seed))
    return folder


def described(room: str, data: Spectra, folder: Path) -> Row:
    """Return the density of the positions in wavelengths, and how the scene was traced."""
    scene = json.loads((folder / "scene.json").read_text())
    wavelength = LIGHT_SPEED / scene["options"]["frequency"]
    train, test = data.split("random")
    nearest = Neighbours(train.position)(test.position, 1)[0].median()
    low, high = ROOMS[room].region
    area = (high[0] - low[0]) * (high[1] - low[1])
    kept = ("positions", "line_of_sight", "paths_per_position", "seconds")
    return {
        "spacing_wavelengths": math.sqrt(area / len(data)) / wavelength,
        "nearest_training_wavelengths": float(nearest) / wavelength,
        "traced": {key: scene[key] for key in kept},
    }


def measure(config: Config, prefix: Path, train: Spectra, test: Spectra, split: Split, first: bool) -> None:
    """Measure the missing rows of one split."""
    test = test.subset(*subsample(torch.arange(len(test)), rows=JUDGES)).in_memory()
    for method, n in wanted(config, len(train), split, first):
        file = Path(f"{prefix} {n} {method}")
        if not Path(f"{file}.json").exists():
            some = train.subset(torch.randperm(len(train), generator=torch.Generator().manual_seed(config.seed))[:n])
            device = torch.device(config.device if method in BY_GRADIENT else "cpu")
            found = row(built(method, split, config), some, test, Path(f"{file}.state"), device)
            write_text(Path(f"{file}.json"), json.dumps(found | {"machine": machine(device)}))
            print(file.name, f"{found['psnr_db']['median']:.2f} dB, {found['fit_seconds']:.0f} s", flush=True)


def wanted(config: Config, everything: int, split: Split, first: bool) -> Iterator[tuple[str, int]]:
    """Yield the methods of a split and their numbers of training spectra."""
    if "scenes" in config.parts:
        yield from ((method, everything) for method in config.methods)
    if "counts" in config.parts and first and split == "random":
        yield from (("swiftwrf", n) for n in (QUICK_COUNTS if config.quick else COUNTS))


def built(method: str, split: Split, config: Config) -> FieldModel | None:
    """Return a method, not fitted. None for the mean training spectrum."""
    if method == MEAN:
        return None
    options: dict[str, Any] = {"validation": validation_for(split), "seed": config.seed}
    if config.device == "cuda" and method in BY_GRADIENT:
        on_gpu = ON_GPU[method] | FIELD_MODELS[method].supported(options)
        model: FieldModel = make_model(method, "paper", **on_gpu)
    else:
        model = make_model(method, **FIELD_MODELS[method].supported(options))
    steps = getattr(model.config, "steps", 0)
    if steps and (config.steps or config.quick):
        model = type(model)(replace(model.config, steps=config.steps or steps // QUICK_DIVISOR))
    return model


def row(model: FieldModel | None, train: Spectra, test: Spectra, state: Path, device: torch.device) -> Row:
    """Return scores at the test positions, seconds of the fit and of a spectrum, and size of a method."""
    clock, seconds = time.process_time if device == CPU else time.perf_counter, state.with_suffix(".seconds")
    earlier = json.loads(seconds.read_text()) if seconds.exists() else 0.0
    began = clock()

    def on_record(record: Row) -> None:
        """Keep the seconds of an unfinished fit beside its state."""
        write_text(seconds, json.dumps(earlier + clock() - began))

    if model is None:
        mean = train.spectrum.mean(dim=0)
        size: Row = {"parameters": mean.numel(), "megabytes": 4e-6 * mean.numel()}

        def synthesize(position: Tensor) -> Tensor:
            return mean.repeat(len(position), 1, 1)
    else:
        model.fit(train, device=device, checkpoint=state, on_record=on_record)

        def synthesize(position: Tensor) -> Tensor:
            return model.synthesize(position).cpu()

    fit_seconds = earlier + clock() - began
    if model is not None:
        size = weight(model, train, state.with_suffix(".model")) | {"steps": getattr(model.config, "steps", 0)}
    predicted = synthesize(test.position)
    scores = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
    found: Row = {name: summary(score(predicted, test.spectrum)) for name, score in scores.items()}
    found |= {"fit_seconds": fit_seconds, "ms": milliseconds(synthesize, test.position, clock), **size}
    for file in (state, seconds):
        file.unlink(missing_ok=True)
    return found | {"n_train": len(train), "n_test": len(test)}


def estimate_angles(config: Config, folder: Path, work: Path) -> None:
    """Run turbo learning with the spectra of several field models, unless the runs are finished.

    Field models in closed form and those fitted by gradient descent have a run each: the same measured and test spectra.
    """
    by_gradient = tuple(name for name in config.synthesizers if name in BY_GRADIENT)
    closed_form = tuple(name for name in config.synthesizers if name not in BY_GRADIENT)
    for name, synthesizers in (("aoa", closed_form), ("aoa_by_gradient", by_gradient)):
        out, stopped = work / name, work / f"{name}.partial"
        if synthesizers and not out.exists():
            task = AoaConfig(
                SHARES, str(folder), synthesizer=synthesizers, extra=0, repeats=config.repeats, out=str(out)
            )
            set_threads(os.cpu_count() or 1)  # the run has a process for each
            run_aoa(task, stopped if stopped.exists() else None)
            set_threads(1)


def gathered(work: Path, name: str) -> Row:
    """Return all measured rows, and the rows of the committed result that were not measured again."""
    committed = RESULTS / f"{name}.json"
    found: Row = {"described": {}, "scenes": {}, "aoa": None}
    if committed.exists():
        found |= {key: value for key, value in json.loads(committed.read_text()).items() if key in found}
    found = copy.deepcopy(found)
    for file in work.glob("* * * *.json"):
        scene, split, n, method = file.stem.split()
        found["scenes"].setdefault(scene, {}).setdefault(split, {}).setdefault(n, {})[method] = json.loads(
            file.read_text()
        )
    for file in work.glob("*.scene.json"):
        found["described"][file.name.removesuffix(".scene.json")] = json.loads(file.read_text())
    angles = ("elevation_deg", "azimuth_deg", "great_circle_deg")
    runs = [json.loads(file.read_text()) for file in sorted(work.glob("aoa*/metrics.json"), reverse=True)]
    # a method that several runs contain is that of the run with most repeats
    for run in sorted(runs, key=lambda run: int(run["repeats"])):
        found["aoa"] = found["aoa"] or {}
        for share, mix in run["mixes"].items():
            methods = found["aoa"].setdefault(share, {})
            for method, errors in mix["methods"].items():
                methods[method] = {angle: errors[angle] for angle in angles}
    order = [f"{room}-{moving}" for room, moving in SCENES]
    found["described"] = {scene: found["described"][scene] for scene in order if scene in found["described"]}
    found["scenes"] = {
        scene: {
            split: {
                n: dict(sorted(rows.items(), key=lambda item: METHODS.index(item[0])))
                for n, rows in sorted(by_count.items(), key=lambda item: -int(item[0]))
            }
            for split, by_count in sorted(found["scenes"][scene].items(), reverse=True)
        }
        for scene in order
        if scene in found["scenes"]
    }
    return found


if __name__ == "__main__":
    main(tyro.cli(Config))
