"""Fit field models and score them at unseen positions.

python benchmarks/fields.py STUDY --data DATA

coverage: intervals of `swiftwrf` on measured scenes and in the built-in room, all training spectra measured.
with_channels: `geometry` and `hybrid` by spectra, and by channels at the carrier, 30 % of the training positions measured.
raytracing: `raytrace` beside other field models in the furnished rooms (extra: raytrace).
comparison: the paper's methods on measured and built-in scenes, with few training spectra, and turbo learning.
paper_scale: every method on six scenes of 6,000 positions at one height (extra: raytrace), and angle of arrival.

Each row is kept in the folder `--work`, and unfinished fits and runs continue from their state. Rows of the committed result
that were not measured again stay in the result. Seconds are processor seconds of one thread, on a GPU wall-clock seconds.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import torch
import tyro
from record import CPU, ROOT, kept, load, options, provenance, write_result
from torch import Tensor

from augment import withhold
from swiftwrf import AngularGrid, FieldModel, FitError, InputError, Spectra, SwiftWRF, make_model, simulated_room
from swiftwrf import load_spectra as read
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.contrib.comparison.errors import summary
from swiftwrf.contrib.raytraced import ROOMS
from swiftwrf.data.splits import places
from swiftwrf.gp import subsample
from swiftwrf.metrics import covered, l1, psnr, ssim
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.positions import Neighbours
from swiftwrf.runtime.durable import write_text
from swiftwrf.runtime.threads import set_threads
from swiftwrf.runtime.validation import Preset
from tasks import labels
from tasks.aoa.experiment import run as run_aoa
from tasks.configs import AoaConfig, ScenesConfig
from tasks.page import figures
from tasks.scenes import run as trace
from tasks.workers import connected

Study = Literal["coverage", "with_channels", "raytracing", "comparison", "paper_scale"]
S23_ARRAY = PlanarArray.square(4, 915e6, spacing=0.16)  # the files of s23-200 do not describe it
MEASURED = (("s23-200", "random"), ("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
MEAN = "mean"  # the mean training spectrum
BY_GRADIENT = ("nerf2", "wrfgs", "vae", "dcgan", "swiftwrf_paper")
COMPARED = (MEAN, "nearest", "gp", "coarray", "swiftwrf", *BY_GRADIENT[:4])
AT_PAPER_SCALE = (MEAN, "nearest", "idw", "gp", "coarray", "geometry", "hybrid", "swiftwrf", *BY_GRADIENT)
ON_GPU: dict[str, dict[str, Any]] = {  # changes of the paper presets, for a few minutes of a GPU
    "nerf2": {"width": 128, "batch": 2048, "steps": 4000, "decay_steps": None},
    "wrfgs": {"steps": 5000, "decay_steps": None},
    "vae": {"width": 32, "batch": 32, "steps": 4000},
    "dcgan": {"width": 32, "batch": 32, "steps": 4000},
    "swiftwrf_paper": {"n_primitives": 2000, "batch": 16, "steps": 20_000, "smoothing_steps": 2000},
}
FRACTIONS = (0.1, 0.3, 0.5, 0.7)  # measured
COMPARED_COUNTS, QUICK_COMPARED_COUNTS = (20, 40, 80), (40,)  # training spectra of the first scene
PAPER_COUNTS, QUICK_PAPER_COUNTS = (200, 500, 1000, 2000, 3000), (60, 120)
N_COMPARED, N_AT_PAPER_SCALE = 50, 200  # test spectra, evenly chosen: a neural field takes seconds to predict one
QUICK_DIVISOR = {"comparison": 5, "paper_scale": 20}  # of the steps of a fit by gradient descent under --quick
PAPER_POSITIONS, QUICK_POSITIONS, RAYTRACED_POSITIONS = 6000, 300, 200
PAPER_HEIGHT_M = 1.2  # of all positions
BATCH_SIZE, REPEATS = 8, 3  # spectra a call, and calls, of which a rate is the median
Row = dict[str, Any]
Part = tuple[Spectra, Spectra]  # training and test spectra


@dataclass(frozen=True)
class Config:
    study: tyro.conf.Positional[Study]
    data: Path | None = None
    """folder of the data sets, into which missing scenes are traced. Without it some studies measure the built-in room"""
    only: tuple[str, ...] = ()
    """beginnings of the names of the scenes to measure. Defaults to all"""
    splits: tuple[str, ...] = ("random", "block")
    """splits of the scenes of paper_scale"""
    methods: tuple[str, ...] = ()
    """methods to measure. Defaults to all of the study"""
    parts: tuple[Literal["scenes", "counts", "aoa"], ...] = ("scenes", "counts", "aoa")
    """all methods on all scenes; the first scene with fewer training spectra; angle of arrival there"""
    steps: int | None = None
    """number of steps of every fit by gradient descent. Defaults to that of each preset"""
    synthesizers: tuple[str, ...] = ("swiftwrf", "nerf2", "wrfgs", "hybrid")
    """field models of the part aoa"""
    repeats: int = 3
    """random choices of the measured spectra in the part aoa"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where fits by gradient descent run"""
    quick: bool = False
    """a trial in minutes: comparison and paper_scale on one scene, with few steps, without angle of arrival"""
    work: Path = Path("runs/fields")
    """folder of the rows measured so far"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the fits (extra: cluster)"""
    seed: int = 0

    @property
    def result(self) -> str:
        """Name of the result."""
        return f"{self.study}{'_quick' if self.quick else ''}{'_gpu' if self.device == 'cuda' else ''}"


@dataclass(frozen=True)
class Fit:
    """A method to fit.

    Args:
        method: Name of the field model, or `MEAN`.
        options: Options of the method.
        n: Number of training spectra, chosen at random. None: all.
        preset: Preset of the method.
        device: Device of the fit.
    """

    method: str
    options: Row = field(default_factory=dict)
    n: int | None = None
    preset: Preset = "quick"
    device: str = "cpu"


@dataclass(frozen=True)
class Scene:
    """Spectra and the fits to them.

    Args:
        name: Name of the scene.
        split: Name of the split.
        part: Training and test spectra.
        fits: Methods.
        described: What is known of the scene.
    """

    name: str
    split: str
    part: Part
    fits: Sequence[Fit]
    described: Row = field(default_factory=dict)


def main(config: Config) -> None:
    """Measure the missing rows of a study and write its result."""
    torch.set_num_threads(1)
    work = config.work / config.result
    work.mkdir(parents=True, exist_ok=True)
    rows = {_key(row): row for row in kept(config.result, "rows")}
    described = load(config.result).get("described", {})
    with connected(config.scheduler, CPU) as cluster:
        for scene in STUDIES[config.study](config):
            described |= {scene.name: scene.described} if scene.described else {}
            files = [work / f"{scene.name} {scene.split} {fit.n or 'all'} {fit.method}" for fit in scene.fits]
            missing = [n for n, file in enumerate(files) if not Path(f"{file}.json").exists()]
            fits = [scene.fits[n] for n in missing]
            found: Iterator[Row] = (
                cluster.map(partial(measure_away, scene.part), fits)
                if cluster
                else (measure(scene.part, scene.fits[n], Path(f"{files[n]}.state")) for n in missing)
            )
            for n, fit, row in zip(missing, fits, found, strict=True):
                write_text(Path(f"{files[n]}.json"), json.dumps(row))
                print(scene.name, scene.split, fit.n or "", fit.method, in_words(row), flush=True)
            for fit, file in zip(scene.fits, files, strict=True):
                row = {"scene": scene.name, "split": scene.split, "method": fit.method}
                row |= json.loads(Path(f"{file}.json").read_text())
                rows[_key(row)] = row
    content = {"seed": config.seed, "rows": list(rows.values())} | ({"described": described} if described else {})
    if config.study in QUICK_DIVISOR:
        content["aoa"] = angles(work) or load(config.result).get("aoa")
    write_result(config.result, content)
    if config.result == "comparison":
        draw(list(rows.values()))


def _key(row: Row) -> tuple[str, str, str, int]:
    return row["scene"], row["split"], row["method"], row.get("n_train", 0)


def in_words(row: Row) -> str:
    """Return a row in one line."""
    if "refusal" in row:
        return str(row["refusal"])
    return f"{row['psnr_db']['median']:.2f} dB, {row['fit_seconds']:.0f} s"


# -------------------------------------------------------------------------------------------------------------- one row


def measure_away(part: Part, fit: Fit) -> Row:
    """Measure a row on a worker, where an interrupted fit starts from the beginning."""
    with TemporaryDirectory(prefix="swiftwrf-") as folder:
        return measure(part, fit, Path(folder) / "fit.state")


def measure(part: Part, fit: Fit, state: Path) -> Row:
    """Return scores over the test spectra, seconds and size of a method, or the reason of its refusal."""
    train, test = part
    row: Row = {"n_train": fit.n or len(train), "n_test": len(test), "fit_seconds": 0.0}
    try:
        scores, numbers = scored(train, test, fit, state)
    except (InputError, FitError) as error:
        return row | {"refusal": str(error), "provenance": provenance(torch.device(fit.device))}
    row |= numbers
    if "covered_by_80" in scores:
        row["covered_by_80"] = float(scores.pop("covered_by_80").mean())
    place = places(test.position, 2)
    row |= {name: summary(score, place) for name, score in scores.items()}
    return row | {"provenance": provenance(torch.device(fit.device))}


def scored(train: Spectra, test: Spectra, fit: Fit, state: Path) -> tuple[dict[str, Tensor], Row]:
    """Return scores of each test spectrum, and seconds and size of a method."""
    if fit.n is not None:
        order = torch.randperm(len(train), generator=torch.Generator().manual_seed(fit.options.get("seed", 0)))
        train = train.subset(order[: fit.n].sort().values)
    device, file = torch.device(fit.device), state.with_suffix(".seconds")
    clock = time.process_time if device == CPU else time.perf_counter
    earlier = json.loads(file.read_text()) if file.exists() else 0.0
    began = clock()

    def on_record(_: Row) -> None:
        """Keep the seconds of an unfinished fit beside its state."""
        write_text(file, json.dumps(earlier + clock() - began))

    std = None
    if fit.method == MEAN:
        mean = train.spectrum.mean(dim=0)
        row: Row = {"parameters": mean.numel(), "megabytes": 4e-6 * mean.numel(), "fit_seconds": clock() - began}

        def synthesize(position: Tensor) -> Tensor:
            return mean.repeat(len(position), 1, 1)

        predicted = synthesize(test.position)
    else:
        model = make_model(fit.method, fit.preset, **FIELD_MODELS[fit.method].supported(fit.options))
        model.fit(train, device=device, checkpoint=state, on_record=on_record)
        row = {"fit_seconds": earlier + clock() - began} | weight(model, train, state.with_suffix(".model"))

        def synthesize(position: Tensor) -> Tensor:
            return model.synthesize(position).cpu()

        prediction = model.predict(test.position)
        predicted, std = prediction.mean.cpu(), prediction.std
    scores = {name: score(predicted, test.spectrum) for name, score in (("psnr_db", psnr), ("ssim", ssim), ("l1", l1))}
    if std is not None:
        scores["covered_by_80"] = covered(predicted, std.cpu(), test.spectrum)
    row["ms"] = milliseconds(synthesize, test.position, clock)
    for left in (state, file):
        left.unlink(missing_ok=True)
    return scores, row


def weight(model: FieldModel, train: Spectra, file: Path) -> Row:
    """Return the number of fitted values and the megabytes on disk; a model that stores the spectra has their size."""
    if isinstance(model, MemoryModel):
        return {"parameters": train.spectrum.numel(), "megabytes": 4e-6 * train.spectrum.numel()}
    model.save(file)
    megabytes = file.stat().st_size / 1e6
    file.unlink()
    fitted = tuple(model.parameters()) or tuple(model.state()[0].values())
    found: Row = {"parameters": sum(tensor.numel() for tensor in fitted), "megabytes": megabytes}
    found["steps"] = getattr(model.config, "steps", 0)
    if isinstance(model, SwiftWRF):
        found |= {"n_primitives": len(model.mean), "rank": len(model.weight) - 1}
    if model.room is not None:
        found["planes"] = model.room.to_json()["planes"]
    return found


def milliseconds(synthesize: Callable[[Tensor], Tensor], position: Tensor, clock: Callable[[], float]) -> Row:
    """Return the milliseconds of a spectrum from position to magnitudes: median, minimum and maximum of the repeats."""
    position = position.repeat(-(-BATCH_SIZE // len(position)), 1)[:BATCH_SIZE]
    taken = []
    for _ in range(1 + REPEATS):  # the first one warms up
        began = clock()
        synthesize(position)
        taken.append(1e3 * (clock() - began) / BATCH_SIZE)
    low, median, high = sorted(taken[1:])
    return {"median": median, "low": low, "high": high}


# -------------------------------------------------------------------------------------------------------------- studies


def scenes(config: Config) -> Iterator[tuple[str, Spectra, str]]:
    """Yield name, spectra and split of the measured scenes and of the built-in room, without them that of the room."""
    named: list[tuple[str, Callable[[], Spectra], str]] = [("simulated-room", simulated_room, "random")]
    if config.data is not None:
        named[:0] = [(name, partial(load_scene, config.data / name), split) for name, split in MEASURED]
    if config.study == "comparison":
        named.append(("simulated-room receiver", partial(simulated_room, moving="receiver"), "random"))
    for name, spectra, split in named:
        if not config.only or name.startswith(config.only):
            yield name, spectra(), split


def load_scene(folder: Path) -> Spectra:
    """Load spectra with the array that measured them."""
    data = read(folder)
    return replace(data, array=S23_ARRAY) if data.name.startswith("s23") else data


def fits(config: Config, methods: Sequence[str], data: Spectra, split: str, n: int | None = None) -> list[Fit]:
    """Return the fits of those methods that the data suffice for."""
    validation, found = "random" if split == "random" else "block", []
    for method in config.methods or methods:
        given: Row = {"seed": config.seed}
        if method == MEAN or not FIELD_MODELS[method].lacking(data):
            on_gpu = config.device == "cuda" and method in BY_GRADIENT
            given |= {"validation": validation} | (ON_GPU[method] if on_gpu else {})
            steps = 0 if method == MEAN else getattr(make_model(method).config, "steps", 0)
            if steps and (config.steps or config.quick):
                given["steps"] = config.steps or steps // QUICK_DIVISOR.get(config.study, 1)
            preset: Preset = "paper" if on_gpu else "quick"
            found.append(Fit(method, given, n, preset, config.device if on_gpu else "cpu"))
    return found


def coverage(config: Config) -> Iterator[Scene]:
    """The model with intervals on every scene."""
    for name, data, split in scenes(config):
        yield Scene(name, split, data.split(split, config.seed), fits(config, ("swiftwrf",), data, split))


def with_channels(config: Config) -> Iterator[Scene]:
    """The ray-traced rooms: models of paths by spectra alone, and by the channels behind them."""
    for name in ("newrf-conference", "newrf-bedroom", "newrf-office"):
        for known, subcarriers in (("spectra", None), ("channels", 1)):
            train, test = read((config.data or Path()) / name, subcarriers=subcarriers).split("random", config.seed)
            part = withhold(train, 0.3, config.seed)[0], test
            yield Scene(f"{name}, {known}", "random", part, [Fit(method) for method in ("geometry", "hybrid")])


def raytracing(config: Config) -> Iterator[Scene]:
    """The furnished rooms, either end moving. No model receives the geometry of the room, which is traced again."""
    methods = (MEAN, "swiftwrf", "geometry", "hybrid", "raytrace")
    for room in ROOMS:
        for moving in get_args(Moving):
            folder = (config.data or config.work) / str(RAYTRACED_POSITIONS) / f"{room}-{moving}"
            traced(folder, room, moving, RAYTRACED_POSITIONS, None, config.seed)
            data = read(folder, grid=AngularGrid.hemisphere(30, 120))
            known = described(room, data, folder)
            part = data.split("random")
            yield Scene(f"{room}, {moving}", "random", part, fits(config, methods, data, "random"), known)


def comparison(config: Config) -> Iterator[Scene]:
    """The paper's methods; on the first scene with fewer training spectra, too, and turbo learning with their spectra."""
    for number, (name, data, split) in enumerate(scenes(config)):
        if config.quick and not (number == 0 or name == "simulated-room"):
            continue
        train, test = data.split(split)
        test = test.subset(*subsample(torch.arange(len(test)), rows=N_COMPARED))
        chosen = fits(config, COMPARED, data, split) if "scenes" in config.parts else []
        if number == 0 and "counts" in config.parts:
            for n in QUICK_COMPARED_COUNTS if config.quick else COMPARED_COUNTS:
                chosen += fits(config, COMPARED, data, split, n) if n < len(train) else []
        yield Scene(name, split, (train, test), chosen)
    if "aoa" in config.parts and not config.quick and config.data is not None:
        estimate_angles(config, config.data / MEASURED[0][0])


def paper_scale(config: Config) -> Iterator[Scene]:
    """Every method on six scenes; on the first one with fewer training spectra, too, and angle of arrival."""
    assert config.data is not None
    positions = QUICK_POSITIONS if config.quick else PAPER_POSITIONS
    every = [(room, moving) for room in ("conference", "office", "bedroom") for moving in get_args(Moving)]
    for number, (room, moving) in enumerate(every[:1] if config.quick else every):
        name = f"{room}-{moving}"
        if config.only and not name.startswith(config.only):
            continue
        folder = config.data / str(positions) / name
        traced(folder, room, moving, positions, PAPER_HEIGHT_M, config.seed)
        data = read(folder)
        for split in config.splits:
            train, test = data.split(split, config.seed)
            test = test.subset(*subsample(torch.arange(len(test)), rows=N_AT_PAPER_SCALE)).in_memory()
            chosen = fits(config, AT_PAPER_SCALE, data, split) if "scenes" in config.parts else []
            if number == 0 and split == "random" and "counts" in config.parts:
                for n in QUICK_PAPER_COUNTS if config.quick else PAPER_COUNTS:
                    chosen += fits(config, ("swiftwrf",), data, split, n)
            yield Scene(name, split, (train, test), chosen, described(room, data, folder))
        if number == 0 and "aoa" in config.parts and not config.quick:
            estimate_angles(config, folder)


def traced(folder: Path, room: str, moving: Moving, positions: int, height: float | None, seed: int) -> None:
    """Trace a scene into the folder, unless it is there."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        (x, y, _), (far_x, far_y, _) = ROOMS[room].region
        region = None if height is None else (x, y, height, far_x, far_y, height)
        trace(ScenesConfig(room=room, moving=moving, positions=positions, out=str(folder), region=region, seed=seed))


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


def estimate_angles(config: Config, folder: Path) -> None:
    """Run turbo learning with the spectra of several field models, unless the runs are finished.

    Field models in closed form and those fitted by gradient descent have a run each: the same measured and test spectra.
    """
    by_gradient = tuple(name for name in config.synthesizers if name in BY_GRADIENT)
    closed_form = tuple(name for name in config.synthesizers if name not in BY_GRADIENT)
    work = config.work / config.result
    for name, synthesizers in (("aoa", closed_form), ("aoa_by_gradient", by_gradient)):
        out, stopped = work / name, work / f"{name}.partial"
        if synthesizers and not out.exists():
            given: Row = {"models": synthesizers, "extra": 0, "repeats": config.repeats, "out": str(out)}
            task = AoaConfig(FRACTIONS, str(folder), scheduler=config.scheduler, **given)
            set_threads(os.cpu_count() or 1)  # the run has a process for each
            run_aoa(task, stopped if stopped.exists() else None)
            set_threads(1)


def angles(work: Path) -> Row:
    """Return the errors of each method by measured fraction, those of the run with most repeats where runs share one."""
    found: Row = {}
    runs = [json.loads(file.read_text()) for file in sorted(work.glob("aoa*/metrics.json"), reverse=True)]
    for run in sorted(runs, key=lambda run: int(run["repeats"])):
        for fraction, mix in run["mixes"].items():
            for method, errors in mix["methods"].items():
                kept = {angle: errors[angle] for angle in ("elevation_deg", "azimuth_deg", "great_circle_deg")}
                found.setdefault(fraction, {})[method] = kept
    return found


def draw(rows: Sequence[Row]) -> None:
    """Draw SSIM against the number of training spectra."""
    colours = labels.colours(labels.FIELD_MODELS)
    curves: dict[str, dict[int, float]] = {}
    for row in rows:
        if (row["scene"], row["split"]) == MEASURED[0]:
            curves.setdefault(row["method"], {})[row["n_train"]] = row["ssim"]["median"]
    panel, ax = figures.panel(6, 3.4)
    for name, curve in curves.items():
        colour = labels.colour(colours, name)
        ax.plot(*zip(*sorted(curve.items()), strict=True), "o-", markersize=3, label=name, color=colour)
    numbers = sorted({n for curve in curves.values() for n in curve})
    ax.set(xscale="log", xlabel="training spectra", ylabel="median SSIM")
    ax.set_xticks(numbers, [str(n) for n in numbers])
    ax.minorticks_off()
    figures.legend_below(ax)
    (ROOT / "docs" / "figures" / "comparison_counts.svg").write_text(figures.as_svg(panel))


STUDIES: dict[str, Callable[[Config], Iterator[Scene]]] = {
    "coverage": coverage,
    "with_channels": with_channels,
    "raytracing": raytracing,
    "comparison": comparison,
    "paper_scale": paper_scale,
}

if __name__ == "__main__":
    main(options(Config))
