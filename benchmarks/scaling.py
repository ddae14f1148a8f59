"""Measure time and memory against the number of spectra, on a dense walk through the simulated room.

Every stage of every size runs in a separate process, for its own peak of memory. `rss_gib` is the peak of resident
memory. It includes the pages of the memory-mapped file of spectra, which the system reclaims when needed. `anonymous_gib`
is the peak of memory that it cannot reclaim.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import torch
from matplotlib.figure import Figure
from record import ROOT, kept, options, write_result

from augment import Mixed
from augment.estimators.aann import AANN
from swiftwrf import AngularGrid, Spectra, load_spectra, make_model, simulated_room
from swiftwrf.data.simulated import REGION
from swiftwrf.data.store import stored
from swiftwrf.data.writing import write_spectra
from swiftwrf.metrics import psnr
from tasks.page import figures

GRID = AngularGrid.hemisphere(90, 360)
SIZES = (300, 1_000, 10_000, 100_000)
MODELS = ("swiftwrf", "coarray", "gp")
STEP = 0.01  # [m] between two spectra: a person who walks, a hundred spectra a second
TURNS = (0.91, 0.37, 0.73)  # [rad / m] of the walk along x, y and z, which never comes back to its beginning
BATCH_SIZE = 2048  # spectra that are simulated together
DRAWN = 1_000  # positions between those of the walk that spectra are synthesized at
TRAINING_STEPS = 5
SAMPLED = 0.02  # [s] between two looks at the memory
GIB = 2**20  # in kibibytes
MAX_GIB = 6  # that any stage may take


@dataclass(frozen=True)
class Config:
    sizes: tuple[int, ...] = SIZES
    """numbers of spectra. Earlier results of other sizes are kept"""
    folder: Path | None = None
    """folder for the data, with space for three times their size. Defaults to a temporary one"""


def main(config: Config) -> None:
    """Measure each stage of each size, write `results/scaling.json` and draw the figure."""
    rows = {row["n"]: row for row in kept("scaling", "rows")}
    for n in config.sizes:
        with tempfile.TemporaryDirectory(dir=config.folder) as folder:
            rows[n] = {"n": n, "stages": {stage: run(stage, n, folder) for stage in STAGES}}
        ordered = [rows[n] for n in sorted(rows)]
        write_result(
            "scaling", {"threads": torch.get_num_threads(), "rows": ordered, "slopes": slopes(ordered)}, rows=[rows[n]]
        )
        draw(ordered)


def run(stage: str, n: int, folder: str) -> dict[str, float]:
    """Run one stage in a separate process."""
    os.environ["XDG_CACHE_HOME"] = folder
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
        found = fresh.submit(measure, stage, Path(folder), n).result()
    print(n, stage, found, flush=True)
    return found


def slopes(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the exponent of the growth of each stage's seconds between neighbouring sizes; 1 is linear."""
    found: dict[str, dict[str, float]] = {}
    for small, large in pairwise(rows):
        for stage, values in large["stages"].items():
            for part in [key for key in values if key.endswith("seconds")]:
                growth = np.log(values[part] / small["stages"][stage][part]) / np.log(large["n"] / small["n"])
                found.setdefault(f"{stage}, {part}", {})[f"{small['n']} to {large['n']}"] = round(float(growth), 2)
    return found


def draw(rows: list[dict[str, Any]]) -> None:
    """Draw seconds and peak memory of the stages against the number of spectra."""
    with matplotlib.style.context(figures.STYLE):
        panels = Figure(figsize=(9, 3.4), layout="constrained")
        time_axis, memory_axis = panels.subplots(1, 2)
    sizes = [row["n"] for row in rows]
    for number, stage in enumerate(STAGES):
        found = [row["stages"][stage] for row in rows]
        style = {"marker": "o", "color": f"C{number}"}
        for part in [key for key in found[0] if key.endswith("seconds")]:
            line, label = (
                "--" if part.startswith("synthesize") else "-",
                f"{stage} {part.removesuffix('seconds')}".strip(),
            )
            time_axis.plot(sizes, [values[part] for values in found], line, label=label, **style)
        memory_axis.plot(sizes, [values["rss_gib"] for values in found], **style)
    memory_axis.axhline(MAX_GIB, color=figures.RULE)
    for axis, label in ((time_axis, "seconds of a processor"), (memory_axis, "peak resident memory [GiB]")):
        axis.set(xscale="log", xlabel="spectra of 90 x 360 pixels", ylabel=label)
    time_axis.set(yscale="log")
    figures.legend_below(time_axis)
    (ROOT / "docs" / "figures" / "scaling.svg").write_text(figures.as_svg(panels))


def walk(at: torch.Tensor) -> torch.Tensor:
    """Return positions (n, 3) [m] in the room's region at spectrum numbers (n,) of the walk."""
    low, high = torch.tensor(REGION, dtype=torch.float64)
    turned = at.double()[:, None] * STEP * torch.tensor(TURNS, dtype=torch.float64)
    return (low + high) / 2 + (high - low) / 2 * torch.sin(turned)


def simulated(at: torch.Tensor) -> Spectra:
    """Return spectra of the walk in the eight bits of images, simulated in batches directly into their store."""
    position = walk(at)
    parts = position.split(BATCH_SIZE)

    def batches() -> Iterator[torch.Tensor]:
        for seed, some in enumerate(parts):
            yield (simulated_room(position=some, seed=seed, grid=GRID).spectrum * 255).round().to(torch.uint8)

    coarse = simulated_room(position=position, grid=AngularGrid.hemisphere(2, 8))
    store = stored((len(at), *GRID.shape), torch.uint8, lambda: repr((len(at), float(at[0]))), batches)
    return replace(coarse, store=store, grid=GRID)


def between(n: int) -> torch.Tensor:
    """Return spectrum numbers of the test positions: evenly along the walk, half-way between measured ones."""
    return torch.linspace(0, n - 2, DRAWN).floor() + 0.5


@contextmanager
def measuring(found: dict[str, float], part: str = "") -> Iterator[None]:
    """Record processor time and peak memory of the context."""
    began, before = time.perf_counter(), time.process_time()
    ended = threading.Event()
    peak = [0]

    def look() -> None:
        while not ended.wait(SAMPLED):
            peak[0] = max(peak[0], status("RssAnon"))

    thread = threading.Thread(target=look)
    thread.start()
    yield
    found[f"{part}seconds"], found[f"{part}elapsed"] = time.process_time() - before, time.perf_counter() - began
    ended.set()
    thread.join()
    found["anonymous_gib"] = max(found.get("anonymous_gib", 0.0), max(peak[0], status("RssAnon")) / GIB)
    found["rss_gib"] = status("VmHWM") / GIB


def status(name: str) -> int:
    """Return an entry of the status of this process [KiB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def generate(folder: Path, n: int, found: dict[str, float]) -> None:
    """Write the walk, and the spectra between its positions."""
    with measuring(found):
        for name, at in (("walk", torch.arange(n)), ("between", between(n))):
            (folder / name).mkdir()
            write_spectra(simulated(at), folder / name)


def open_walk(folder: Path, n: int, found: dict[str, float]) -> None:
    """Open the walk."""
    with measuring(found):
        assert len(load_spectra(folder / "walk")) == n


def predicting(name: str) -> Callable[[Path, int, dict[str, float]], None]:
    """Return the stage that fits one field model and predicts with it."""

    def stage(folder: Path, n: int, found: dict[str, float]) -> None:
        data, unseen = load_spectra(folder / "walk"), load_spectra(folder / "between")
        model = make_model(name)
        with measuring(found, "fit "):
            model.fit(data)
        with measuring(found, "synthesize "):
            predicted = model.synthesize(unseen.position)
        found["psnr_db"] = float(psnr(predicted, unseen.spectrum).median())

    return stage


def train(folder: Path, n: int, found: dict[str, float]) -> None:
    """Train the network for a few steps."""
    data = load_spectra(folder / "walk")
    network = AANN(steps=TRAINING_STEPS)
    with measuring(found):
        network.fit(Mixed.measured(data))


STAGES: dict[str, Callable[[Path, int, dict[str, float]], None]] = {
    "generate": generate,
    "load first": open_walk,
    "load again": open_walk,
    **{name: predicting(name) for name in MODELS},
    "train": train,
}


def measure(stage: str, folder: Path, n: int) -> dict[str, float]:
    """Return times and memory peaks of a stage, in this process."""
    found: dict[str, float] = {}
    STAGES[stage](folder, n, found)
    return {key: round(value, 3) for key, value in found.items()}


if __name__ == "__main__":
    main(options(Config))
