"""Fit field models, and estimators of directions, and score them at unseen positions.

python benchmarks/fields.py STUDY --data DATA

synthesis: field models on measured scenes and in the built-in room, all training spectra measured.
model_size: fits with fixed numbers of primitives beside the number that the fit chooses.
ablation: primitives, training spectra and resolution, as in the paper. ablation_large: one scene, the folder `--data`.
measured_spectra: field models and estimators on every measured set, places held out in turn.
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
from pareto import speed
from record import CPU, ROOT, kept, load, options, provenance, write_result
from scipy.cluster.hierarchy import fclusterdata
from sklearn.model_selection import GroupKFold
from torch import Tensor

from augment import Mixed
from augment.estimators import ESTIMATORS, make_estimator
from augment.turbo.condition import NETWORKS
from swiftwrf import AngularGrid, FieldModel, FitError, InputError, Spectra, SwiftWRF, make_model, simulated_room
from swiftwrf import load_spectra as read
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.data.raytraced import ROOMS
from swiftwrf.data.splits import validation_for
from swiftwrf.gp import subsample
from swiftwrf.metrics import angle_errors, covered, l1, psnr, ssim, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.coarray import project
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.positions import Neighbours
from swiftwrf.runtime.durable import write_text
from swiftwrf.runtime.threads import set_threads
from swiftwrf.runtime.validation import Preset
from tasks import labels
from tasks.aoa.experiment import run as run_aoa
from tasks.aoa.options import AoaConfig
from tasks.page import figures
from tasks.scenes.options import ScenesConfig
from tasks.scenes.run import run as trace
from tasks.workers import connected

Study = Literal[
    "synthesis",
    "model_size",
    "ablation",
    "ablation_large",
    "measured_spectra",
    "raytracing",
    "comparison",
    "paper_scale",
]
S23_ARRAY = PlanarArray.square(4, 915e6, spacing=0.16)  # the files of s23-200 do not describe it
MEASURED = (("s23-200", "random"), ("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
WSR = tuple(f"wsr-{sight}-a-tx{number}" for sight in ("los", "nlos") for number in (2, 3, 4))
SETS = {"s23-200": ("random", "block")} | dict.fromkeys(WSR, ("places",))  # measured sets and their splits
ESTIMATED = ("peak", "constant", "nearest_spectrum", "kernel_regression", NETWORKS["quick"])
PLACE_M, FOLDS = 0.1, 5  # measurements closer than this are one place [m]; folds of the places
MEAN, PROJECTED = "mean", "swiftwrf, projected"  # the mean training spectrum; onto what the array can produce
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
        name: Name of the row.
        method: Name of the field model or of the estimator, or `MEAN`.
        options: Options of the method.
        n: Number of training spectra, chosen at random. None: all.
        preset: Preset of the method.
        device: Device of the fit.
    """

    name: str
    method: str
    options: Row = field(default_factory=dict)
    n: int | None = None
    preset: Preset = "quick"
    device: str = "cpu"


@dataclass(frozen=True)
class Scene:
    """Spectra and the fits to them. Scores are over the test spectra of all parts.

    Args:
        name: Name of the scene.
        split: Name of the split.
        parts: Training and test spectra.
        fits: Methods.
        described: What is known of the scene.
    """

    name: str
    split: str
    parts: Sequence[Part]
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
            files = [work / f"{scene.name} {scene.split} {fit.n or 'all'} {fit.name}" for fit in scene.fits]
            missing = [n for n, file in enumerate(files) if not Path(f"{file}.json").exists()]
            fits = [scene.fits[n] for n in missing]
            found: Iterator[Row] = (
                cluster.map(partial(measure_away, scene.parts), fits)
                if cluster
                else (measure(scene.parts, scene.fits[n], Path(f"{files[n]}.state")) for n in missing)
            )
            for n, fit, row in zip(missing, fits, found, strict=True):
                write_text(Path(f"{files[n]}.json"), json.dumps(row))
                print(scene.name, scene.split, fit.n or "", fit.name, in_words(row), flush=True)
            for fit, file in zip(scene.fits, files, strict=True):
                row = {"scene": scene.name, "split": scene.split, "method": fit.name}
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
    name = "psnr_db" if "psnr_db" in row else "angle_deg"
    return f"{name} {row[name]['median']:.2f}, {row['fit_seconds']:.0f} s"


# -------------------------------------------------------------------------------------------------------------- one row


def measure_away(parts: Sequence[Part], fit: Fit) -> Row:
    """Measure a row on a worker, where an interrupted fit starts from the beginning."""
    with TemporaryDirectory(prefix="swiftwrf-") as folder:
        return measure(parts, fit, Path(folder) / "fit.state")


def measure(parts: Sequence[Part], fit: Fit, state: Path) -> Row:
    """Return scores over the test spectra of all parts, seconds and size of a method, or the reason of its refusal."""
    scores: dict[str, list[Tensor]] = {}
    row: Row = {"n_train": fit.n or len(parts[0][0]), "n_test": sum(len(test) for _, test in parts), "fit_seconds": 0.0}
    try:
        for train, test in parts:
            found, numbers = scored(train, test, fit, state)
            row |= numbers | {"fit_seconds": row["fit_seconds"] + numbers["fit_seconds"]}
            for name, score in found.items():
                scores.setdefault(name, []).append(score)
    except (InputError, FitError) as error:
        row["refusal"] = str(error)
    if "covered_by_80" in scores:
        row["covered_by_80"] = float(torch.cat(scores.pop("covered_by_80")).mean())
    row |= {name: summary(torch.cat(score)) for name, score in scores.items()}
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
    if fit.method in ESTIMATORS:
        estimator = make_estimator(fit.method, len(train), **fit.options).fit(Mixed.measured(train))
        error = angle_errors(estimator.estimate(test), test.label)["great_circle"].rad2deg()
        return {"angle_deg": error}, {"fit_seconds": clock() - began}

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
            drawn = model.synthesize(position).cpu()
            if fit.name == PROJECTED and train.array is not None:
                stretched = train.name.startswith("s23")
                return project(drawn, train.array, train.grid, stretched=stretched)
            return drawn

        prediction = model.predict(test.position)
        predicted = synthesize(test.position) if fit.name == PROJECTED else prediction.mean.cpu()
        std = None if fit.name == PROJECTED else prediction.std
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


def load_scene(folder: Path, grid: AngularGrid | None = None) -> Spectra:
    """Load spectra with the array that measured them."""
    data = read(folder, grid=grid)
    return replace(data, array=S23_ARRAY) if data.name.startswith("s23") else data


def fits(config: Config, methods: Sequence[str], data: Spectra, split: str, n: int | None = None) -> list[Fit]:
    """Return the fits of those methods that the data suffice for."""
    validation = "random" if split == "places" else validation_for(split)
    found = []
    for name in config.methods or methods:
        method = name.partition(",")[0]
        given: Row = {"seed": config.seed}
        if method in ESTIMATORS:
            found.append(Fit(name, method, given, n))
        elif method == MEAN or not FIELD_MODELS[method].lacking(data):
            on_gpu = config.device == "cuda" and method in BY_GRADIENT
            given |= {"validation": validation} | (ON_GPU[method] if on_gpu else {})
            steps = 0 if method == MEAN else getattr(make_model(method).config, "steps", 0)
            if steps and (config.steps or config.quick):
                given["steps"] = config.steps or steps // QUICK_DIVISOR.get(config.study, 1)
            preset: Preset = "paper" if on_gpu else "quick"
            found.append(Fit(name, method, given, n, preset, config.device if on_gpu else "cpu"))
    return found


def synthesis(config: Config) -> Iterator[Scene]:
    """Every field model on every scene."""
    for name, data, split in scenes(config):
        methods = (MEAN, "nearest", "idw", "gp", "coarray", "swiftwrf", *([PROJECTED] if data.array else []))
        yield Scene(name, split, [data.split(split, config.seed)], fits(config, methods, data, split))


def model_size(config: Config) -> Iterator[Scene]:
    """Fits of every number of primitives, and of the number that the fit chooses."""
    for name, data, split in scenes(config):
        default = {"validation": validation_for(split), "seed": config.seed}
        sizes = {str(n): default | {"n_primitives": n} for n in (16, 32, 64, 128, 256, 512, 1024)} | {"auto": default}
        chosen = [Fit(size, "swiftwrf", options) for size, options in sizes.items()]
        yield Scene(name, split, [data.split(split, config.seed)], chosen)


def ablation(config: Config) -> Iterator[Scene]:
    """One option or part of the data changed at a time. Ray paths are rendered at another resolution, too."""
    measured: list[tuple[str, Path | None, str]] = [("simulated-room", None, "random")]
    if config.data is not None and config.study == "ablation_large":
        measured = [(config.data.name, config.data, "random")]
    elif config.data is not None:
        measured = [(name, config.data / name, split) for name, split in MEASURED[1:]]
    for name, folder, split in measured:
        data = read(folder) if folder else simulated_room()
        train, test = data.split(split)
        default = {"validation": validation_for(split)}
        some = [
            Fit("default", "swiftwrf", default),
            *(Fit(f"{n} primitives", "swiftwrf", default | {"n_primitives": n}) for n in (16, 64, 256)),
            Fit("fitted on all pixels", "swiftwrf", default | {"max_azimuths": 0}),
            *(Fit(f"{f:.0%} of the training spectra", "swiftwrf", default, round(f * len(train))) for f in FRACTIONS),
        ]
        yield Scene(name, split, [(train, test)], some)
        if data.array is not None and folder:
            fine = read(folder, grid=AngularGrid.hemisphere(180, 720))
            yield Scene(name, split, [fine.split(split)], [Fit("seen at 0.5 degrees", "swiftwrf", default)])


def measured_spectra(config: Config) -> Iterator[Scene]:
    """Every measured set. Each place is held out once, with all repeats of its measurement, unless a split is published."""
    assert config.data is not None
    methods = (MEAN, "nearest", "idw", "gp", "coarray", "swiftwrf", *ESTIMATED)
    for name, splits in SETS.items():
        data = load_scene(config.data / name)
        for split in splits:
            parts = [data.split(split, config.seed)] if split != "places" else list(by_place(data))
            yield Scene(name, split, parts, fits(config, methods, data, split), {"n": len(data), "moving": data.moving})


def by_place(data: Spectra) -> Iterator[Part]:
    """Yield training and test spectra of each fold of the places."""
    place = fclusterdata(data.position.double().numpy(), PLACE_M, "distance")
    for train, test in GroupKFold(FOLDS).split(place, groups=place):
        yield data.subset(torch.from_numpy(train)), data.subset(torch.from_numpy(test))


def raytracing(config: Config) -> Iterator[Scene]:
    """The furnished rooms, either end moving. No model receives the geometry of the room, which is traced again."""
    methods = (MEAN, "nearest", "gp", "coarray", "swiftwrf", "geometry", "hybrid", "raytrace")
    for room in ROOMS:
        for moving in get_args(Moving):
            folder = (config.data or config.work) / str(RAYTRACED_POSITIONS) / f"{room}-{moving}"
            traced(folder, room, moving, RAYTRACED_POSITIONS, None, config.seed)
            data = read(folder, grid=AngularGrid.hemisphere(30, 120))
            known = described(room, data, folder)
            parts = [data.split("random")]
            yield Scene(f"{room}, {moving}", "random", parts, fits(config, methods, data, "random"), known)


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
        yield Scene(name, split, [(train, test)], chosen)
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
            yield Scene(name, split, [(train, test)], chosen, described(room, data, folder))
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
            given: Row = {"synthesizer": synthesizers, "extra": 0, "repeats": config.repeats, "out": str(out)}
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
    """Draw speed against error on each scene, and SSIM against the number of training spectra."""
    folder, palette = ROOT / "docs" / "figures", figures.Palette.of(labels.FIELD_MODELS)
    by_scene: dict[str, list[Row]] = {}
    for row in rows:
        by_scene.setdefault(f"{row['scene']} {row['split']}", []).append(row)
    panels, axes = figures.new_figure(-(-len(by_scene) // 2), min(2, len(by_scene)), 10, 3.4 * -(-len(by_scene) // 2))
    for ax, (scene, own) in zip(axes, by_scene.items(), strict=False):
        most = max(row["n_train"] for row in own)
        points = {
            row["method"]: (row["ms"]["median"], 10 ** (-row["psnr_db"]["median"] / 20))
            for row in own
            if row["n_train"] == most
        }
        speed(ax, palette, points, f"milliseconds a spectrum, {scene}", "RMS error", list(points))
    for ax in axes[len(by_scene) :]:
        ax.set_axis_off()
    (folder / "comparison_speed.svg").write_text(figures.as_svg(panels))
    curves: dict[str, dict[int, float]] = {}
    for row in by_scene.get("s23-200 random", []):
        curves.setdefault(row["method"], {})[row["n_train"]] = row["ssim"]["median"]
    panel, (ax,) = figures.new_figure(1, 1, 6, 3.4)
    for name, curve in curves.items():
        ax.plot(*zip(*sorted(curve.items()), strict=True), "o-", markersize=3, label=name, color=palette.colour(name))
    numbers = sorted({n for curve in curves.values() for n in curve})
    ax.set(xscale="log", xlabel="training spectra", ylabel="median SSIM")
    ax.set_xticks(numbers, [str(n) for n in numbers])
    ax.minorticks_off()
    figures.legend_below(panel, ax)
    (folder / "comparison_counts.svg").write_text(figures.as_svg(panel))


STUDIES: dict[str, Callable[[Config], Iterator[Scene]]] = {
    "synthesis": synthesis,
    "model_size": model_size,
    "ablation": ablation,
    "ablation_large": ablation,
    "measured_spectra": measured_spectra,
    "raytracing": raytracing,
    "comparison": comparison,
    "paper_scale": paper_scale,
}

if __name__ == "__main__":
    main(options(Config))
