"""Repeat the paper's comparison on public data: every method on every scene, few training spectra, and turbo learning.

The hours of work can be stopped at any time: each measured row is kept in the folder `--work`, and unfinished fits and
runs continue from their state. With `--scheduler` the workers of a Dask cluster measure the rows; each row contains its
machine, because seconds of different machines do not compare.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
import tyro
from committed import ROOT
from record import write_result
from synthesis import load
from torch import Tensor

from augment.turbo.condition import conditions_of
from swiftwrf import FieldModel, Spectra, make_model, simulated_room
from swiftwrf.data.splits import validation_for
from swiftwrf.gp import subsample
from swiftwrf.metrics import l1, psnr, ssim, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.runtime.durable import write_text
from tasks import labels
from tasks.aoa.experiment import run
from tasks.aoa.options import AoaConfig
from tasks.environment import machine
from tasks.page import figures
from tasks.page.figures import Palette
from tasks.workers import Workers, connected

MEASURED = (("s23-200", "random"), ("s23-200", "block"), ("newrf-bedroom", "random"), ("newrf-office", "random"))
MEAN = "mean"  # the mean training spectrum
BASELINES = (MEAN, "nearest", "gp", "coarray")
LEARNT = ("swiftwrf", "nerf2", "wrfgs", "vae", "dcgan")
COUNTS = (20, 40, 80)  # training spectra of s23-200 random; all of them are in the table of scenes
SHARES = (0.1, 0.3, 0.5, 0.7)
TURBO = ("swiftwrf", "nerf2", "wrfgs")
JUDGES = 50  # test spectra of a scene, evenly chosen: a neural field takes seconds to draw one
QUICK_DIVISOR = 5  # of the steps of a fit by gradient under --quick
BATCH, REPEATS = 8, 3  # spectra a call, and calls, of which a rate is the median
CPU = torch.device("cpu")
Row = dict[str, Any]
Table = dict[str, dict[str, dict[str, Row]]]  # by scene, number of training spectra and method


@dataclass(frozen=True)
class Config:
    data: Path
    """the folder that holds s23-200, newrf-bedroom and newrf-office"""
    only: tuple[str, ...] = ()
    """of the scenes, those whose name begins so; all unless given"""
    parts: tuple[Literal["scenes", "counts", "turbo"], ...] = ("scenes", "counts", "turbo")
    """all methods on all scenes; with fewer training spectra; networks trained with their spectra"""
    quick: bool = False
    """under ten minutes: s23-200 at random and the simulated room, fits by gradient a fifth as long, one number of training
    spectra, no networks"""
    work: Path = Path("runs/comparison")
    """folder of what is measured so far"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers measure the rows and train the networks (extra: cluster)"""


def main(config: Config) -> None:
    """Measure the missing rows and write `results/comparison.json` (`comparison_quick.json`) and the figures."""
    rows = config.work / ("quick" if config.quick else "rows")
    rows.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    with connected(config.scheduler, CPU) as cluster:
        for job, found in measured(jobs(config, rows), cluster):
            print(job.file.name, f"{found['psnr_db']['median']:.2f} dB, {found['fit_seconds']:.0f} s", flush=True)
            write_text(Path(f"{job.file}.json"), json.dumps(found))
            job.state.unlink(missing_ok=True)
    if "turbo" in config.parts and not config.quick:
        train_networks(config)
    if config.quick:
        write_result("comparison_quick", {"scenes": gathered(rows), "seconds": time.perf_counter() - began})
        return
    found = gathered(rows)
    write_result("comparison", {"scenes": found, "turbo": turbo(config.work)})
    draw(found)


def scenes(config: Config) -> Iterator[tuple[str, Spectra, str]]:
    """Yield name, spectra and split of each scene."""
    measured = MEASURED[:1] if config.quick else MEASURED
    yield from ((f"{name} {split}", load(config.data / name), split) for name, split in measured)
    yield "simulated-room random", simulated_room(), "random"
    if not config.quick:
        yield "simulated-room receiver random", simulated_room(moving="receiver"), "random"


def numbers(scene: str, everything: int, config: Config) -> list[int]:
    """Return the numbers of training spectra to measure."""
    found = [everything] if "scenes" in config.parts else []
    if scene == "s23-200 random" and "counts" in config.parts:
        found += COUNTS[1:2] if config.quick else COUNTS
    return found


@dataclass(frozen=True)
class Job:
    """A row to measure.

    Args:
        file: File of the row, without suffix.
        method: Name of the method.
        n: Number of training spectra.
        split: Split of the scene.
        quick: Whether fits by gradient are shortened.
    """

    file: Path
    method: str
    n: int
    split: str
    quick: bool

    @property
    def state(self) -> Path:
        """File with the state of an unfinished fit."""
        return Path(f"{self.file}.state")

    def measure(self, train: Spectra, test: Spectra, state: Path) -> Row:
        """Return the row and the machine that measured it."""
        some = train.subset(torch.randperm(len(train), generator=torch.Generator().manual_seed(0))[: self.n])
        return row(self.method, some, test, self.split, self.quick, state) | {"machine": machine(CPU)}


def jobs(config: Config, rows: Path) -> Iterator[tuple[Spectra, Spectra, list[Job]]]:
    """Yield training and test spectra of each scene, with its missing rows."""
    for scene, data, split in scenes(config):
        if config.only and not scene.startswith(config.only):
            continue
        train, test = data.split(split)
        test = test.subset(*subsample(torch.arange(len(test)), rows=JUDGES))
        methods = [
            method for method in (*BASELINES, *LEARNT) if method == MEAN or not FIELD_MODELS[method].lacking(data)
        ]
        wanted = [
            Job(rows / f"{scene} {n} {method}", method, n, split, config.quick)
            for n in numbers(scene, len(train), config)
            for method in methods
        ]
        yield train, test, [job for job in wanted if not Path(f"{job.file}.json").exists()]


def measured(jobs: Iterable[tuple[Spectra, Spectra, list[Job]]], cluster: Workers | None) -> Iterator[tuple[Job, Row]]:
    """Yield each row when it is measured, here or on a cluster, where an interrupted fit starts from the beginning."""
    if cluster is None:
        for train, test, some in jobs:
            yield from ((job, job.measure(train, test, job.state)) for job in some)
        return
    pending: dict[Future[Any], Job] = {}
    for train, test, some in jobs:
        function = cluster.hold(partial(measure_away, train, test))
        pending |= {cluster.submit(function, job): job for job in some}
    while pending:
        future, found = cluster.next(pending)
        yield pending.pop(future), found


def measure_away(train: Spectra, test: Spectra, job: Job) -> Row:
    """Measure a row on a worker."""
    with TemporaryDirectory(prefix="swiftwrf-") as folder:
        return job.measure(train, test, Path(folder) / "fit.state")


def gathered(rows: Path) -> Table:
    """Return all measured rows."""
    found: Table = {}
    for file in rows.glob("*.json"):
        scene, n, method = file.stem.rsplit(" ", 2)
        found.setdefault(scene, {}).setdefault(n, {})[method] = json.loads(file.read_text())
    order = [*BASELINES, *LEARNT]
    return {
        scene: {
            n: dict(sorted(by_method.items(), key=lambda item: order.index(item[0])))
            for n, by_method in sorted(by_count.items(), key=lambda item: -int(item[0]))
        }
        for scene, by_count in sorted(found.items())
    }


def row(method: str, train: Spectra, test: Spectra, split: str, quick: bool, state: Path) -> Row:
    """Return the scores of a method at the test positions, the seconds of its fit and of a spectrum, and its size."""
    began, earlier = time.perf_counter(), 0.0

    def on_record(record: Row) -> None:
        """Add the seconds of earlier sessions, whose records a resumed fit repeats first."""
        nonlocal earlier
        earlier = max(earlier, record.get("elapsed", 0.0) - (time.perf_counter() - began))

    if method == MEAN:
        mean = train.spectrum.mean(dim=0)
        size = {"parameters": mean.numel(), "megabytes": 4e-6 * mean.numel()}

        def synthesize(position: Tensor) -> Tensor:
            return mean.repeat(len(position), 1, 1)
    else:
        model = make_model(method, **FIELD_MODELS[method].supported({"validation": validation_for(split)}))
        if quick and getattr(model.config, "steps", 0):
            model = type(model)(model.config, steps=model.config.steps // QUICK_DIVISOR)
        model.fit(train, checkpoint=state, on_record=on_record)
        synthesize, size = model.synthesize, weight(model, train, state.with_suffix(".model"))
    fit_seconds = time.perf_counter() - began + earlier
    predicted = synthesize(test.position)
    scores = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
    found: Row = {name: summary(score(predicted, test.spectrum)) for name, score in scores.items()}
    return (
        found | {"fit_seconds": fit_seconds, "ms": milliseconds(synthesize, test.position), "n_test": len(test)} | size
    )


def weight(model: FieldModel, train: Spectra, file: Path) -> Row:
    """Return the number of fitted values and the megabytes on disk; a model that stores the spectra has their size."""
    if isinstance(model, MemoryModel):
        return {"parameters": train.spectrum.numel(), "megabytes": 4e-6 * train.spectrum.numel()}
    model.save(file)
    megabytes = file.stat().st_size / 1e6
    file.unlink()
    fitted = tuple(model.parameters()) or tuple(model.state()[0].values())
    return {"parameters": sum(tensor.numel() for tensor in fitted), "megabytes": megabytes}


def milliseconds(
    synthesize: Callable[[Tensor], Tensor], position: Tensor, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the milliseconds of a spectrum from position to magnitudes: median, minimum and maximum of the repeats."""
    position = position.repeat(-(-BATCH // len(position)), 1)[:BATCH]
    taken = []
    for _ in range(1 + REPEATS):  # the first one warms up
        began = clock()
        synthesize(position)
        taken.append(1e3 * (clock() - began) / BATCH)
    low, median, high = sorted(taken[1:])
    return {"median": median, "low": low, "high": high}


def train_networks(config: Config) -> None:
    """Run turbo learning with the spectra of several methods, unless the run is finished."""
    out = config.work / "turbo"
    stopped = out.with_name("turbo.partial")
    if not out.exists():
        task = AoaConfig(
            SHARES, str(config.data / "s23-200"), synthesizer=TURBO, extra=0, out=str(out), scheduler=config.scheduler
        )
        run(task, stopped if stopped.exists() else None)


def turbo(work: Path) -> Row | None:
    """Return the errors of the network on each training set by measured fraction. None if the run is not finished."""
    file = work / "turbo" / "metrics.json"
    if not file.exists():
        return None
    return {
        share: {
            name: {angle: mix["methods"][name][angle] for angle in ("elevation_deg", "azimuth_deg")}
            for name, condition in conditions_of(mix["methods"]).items()
            if condition.is_network
        }
        for share, mix in json.loads(file.read_text())["mixes"].items()
    }


def draw(found: Table) -> None:
    """Draw speed against error on each scene, and SSIM against the number of training spectra."""
    folder, palette = (
        ROOT / "docs" / "figures",
        Palette.of(labels.FIELD_MODELS),
    )
    panels, axes = figures.new_figure(-(-len(found) // 2), min(2, len(found)), 10, 3.4 * -(-len(found) // 2))
    for ax, (scene, by_count) in zip(axes, found.items(), strict=False):
        rows = next(iter(by_count.values()))  # all training spectra
        points = {name: (r["ms"]["median"], 10 ** (-r["psnr_db"]["median"] / 20)) for name, r in rows.items()}
        figures.speed(ax, palette, points, f"milliseconds a spectrum, {scene}", "RMS error", list(points))
    for ax in axes[len(found) :]:
        ax.set_axis_off()
    (folder / "comparison_speed.svg").write_text(figures.as_svg(panels))
    curves = found.get("s23-200 random", {})
    if len(curves) > 1:
        numbers = sorted(map(int, curves))
        panel, axes = figures.new_figure(1, 1, 6, 3.4)
        for name in next(iter(curves.values())):
            at = [curves[str(n)][name]["ssim"] for n in numbers if name in curves[str(n)]]
            own = [n for n in numbers if name in curves[str(n)]]
            axes[0].plot(own, [s["median"] for s in at], "o-", markersize=3, label=name, color=palette.colour(name))
        axes[0].set(xscale="log", xlabel="training spectra", ylabel="median SSIM")
        axes[0].set_xticks(numbers, [str(n) for n in numbers])
        axes[0].minorticks_off()
        figures.legend_below(panel, axes[0])
        (folder / "comparison_counts.svg").write_text(figures.as_svg(panel))


if __name__ == "__main__":
    main(tyro.cli(Config))
