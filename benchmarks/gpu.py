"""Rates from positions to spectra, training seconds and limits of rendering on a GPU, in addition to `rasterize.py`.

Each call measures one part, so that a failure or timeout affects no other part. `gpu.sh` calls all parts. The result
contains targets and measurements. For a trial, everything also runs on a CPU, quickly with --quick.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import torch
import tyro
from rasterize import (
    CUTOFF,
    gpu_rates,
    kernel_values,
    model_of,
    positions,
    rate,
    rendered,
    scene,
    timed,
    with_gradients,
)
from record import RESULTS, options, write_result
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from augment import Mixed
from augment.estimators.aann import AANN, AANNConfig
from swiftwrf import (
    AngularGrid,
    Spectra,
    fit,
    simulated_room,
)
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.rasterize import rasterize_magnitude
from tasks.environment import choose_device

FORWARD = {10_000: (600e3, 1e6), 1000: (1.8e6, 1.8e6)}  # by N: spectra a second that drawing should reach, and the goal
WITH_GRADIENTS = {1000: (600e3, 600e3)}
WITHOUT_KERNEL = ("aten::empty.memory_format", "aten::new_empty", "aten::detach")  # besides views
END_TO_END = 0.8  # of the rate of drawing alone
COUNTERS = {  # of Nsight Compute: shares of the peak [%]
    "issue": "sm__inst_issued.avg.pct_of_peak_sustained_elapsed",
    "exponentials": "sm__inst_executed_pipe_xu.avg.pct_of_peak_sustained_elapsed",
    "memory": "gpu__dram_throughput.avg.pct_of_peak_sustained_elapsed",
    "occupancy": "sm__warps_active.avg.pct_of_peak_sustained_active",
}
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    part: tyro.conf.Positional[Literal["rates", "training", "profile", "launches", "draw"]]
    """what to measure; launches needs no GPU; draw measures nothing and is what a profiler looks at"""
    out: Path = RESULTS
    """folder of the result"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute; auto takes the GPU where there is one"""
    quick: bool = False
    """small grids, few primitives, few steps: to try it"""
    seconds: float = 0.5
    """time for the repeats of one rate; at least 3, at most 50 of them"""


def main(config: Config) -> None:
    """Measures one part and writes `gpu_<part>.json`."""
    device = choose_device(config.device)
    measure: Callable[[Config, torch.device], Row | None] = PARTS[config.part]
    found = measure(config, device)
    if found is not None:
        write_result(f"gpu_{config.part}", {"quick": config.quick, **found}, device, config.out)


def sizes(config: Config) -> tuple[AngularGrid, tuple[int, ...], tuple[int, ...]]:
    """Grid, numbers of primitives, batches."""
    if config.quick:
        return AngularGrid.hemisphere(8, 32), (16, 64), (4,)
    return AngularGrid.hemisphere(90, 360), (64, 1000, 10_000), (64, 1024, 4096)


def rates(config: Config, device: torch.device) -> Row:
    """Return spectra per second: rasterizer alone, with gradients, deformed primitives, and predictions of the model."""
    grid, numbers, batches = sizes(config)
    rows = []
    for n in numbers:
        model = model_of(n, grid, device)
        for batch in batches:
            inputs, position = scene(n, batch, device), positions(batch)
            calls = {
                "forward": partial(rasterize_magnitude, *inputs, grid, "auto", CUTOFF),
                "forward_backward": partial(with_gradients, inputs, grid, "auto"),
                "model": partial(rendered, model, position.to(device), grid),
                "synthesize": partial(model.synthesize, position),
            }
            row: Row = {"n": n, "batch": batch}
            for name, call in calls.items():
                with torch.set_grad_enabled(name == "forward_backward"):
                    row[f"{name}_per_s"] = rate(call, batch, device, config.seconds)
            print({key: f"{x['median']:.4g}" if isinstance(x, dict) else x for key, x in row.items()}, flush=True)
            rows.append(row)
    found = targets(rows)
    for target in found:
        print(target["what"], f"{target['measured']:.3g}", "met" if target["met"] else f"missed, {target['least']:.3g}")
    return {"grid": grid.shape, "cutoff": CUTOFF, "rows": rows, "targets": found}


def targets(rows: list[Row]) -> list[Row]:
    """Return the targets and the rates of the best batch size."""

    def best(n: int, name: str) -> float:
        return max(float(row[f"{name}_per_s"]["median"]) for row in rows if row["n"] == n)

    found = []
    for name, aims in (("forward", FORWARD), ("forward_backward", WITH_GRADIENTS)):
        for n, (least, goal) in aims.items():
            if any(row["n"] == n for row in rows):
                found.append({"what": f"{name}, N = {n}", "least": least, "goal": goal, "measured": best(n, name)})
    for n in sorted({row["n"] for row in rows}):
        for name in ("model", "synthesize"):
            share = best(n, name) / best(n, "forward")
            found.append({"what": f"{name}, of forward, N = {n}", "least": END_TO_END, "goal": 1.0, "measured": share})
    return [target | {"met": target["measured"] >= target["least"]} for target in found]


def training(config: Config, device: torch.device) -> Row:
    """Seconds of the fit by regression, of the paper's fit and of the network, on the built-in room."""
    steps, n = (4, 16) if config.quick else (200, 1000)
    grid = AngularGrid.hemisphere(8, 32) if config.quick else AngularGrid.hemisphere(90, 360)
    train, _ = simulated_room(n=40 if config.quick else 300, grid=grid).split()
    size = n if config.quick else "auto"
    paper = SwiftWRFPaper(n_primitives=n, steps=steps, batch=16, check_every=steps, max_azimuths=0)
    network = AANNConfig(steps=2, batch=4) if config.quick else AANNConfig()
    seconds = {
        "regression": timed(lambda: fit(train, n_primitives=size, device=device), device),
        f"swiftwrf_paper, N = {n}, {steps} steps": timed(lambda: paper.fit(train, device=device), device),
        f"network, {network.steps} steps": timed(
            lambda: AANN(network).fit(Mixed.measured(train), device=device), device
        ),
    }
    print(seconds, flush=True)
    return {"grid": grid.shape, "n_train": len(train), "seconds": seconds}


def scene_of(n: int, config: Config) -> Spectra:
    """Spectra of the built-in room."""
    grid, _, _ = sizes(config)
    return simulated_room(n=n, grid=grid)


def profiled(config: Config, device: torch.device) -> Row:
    """Return the rendering time by kernel, and the fraction of the exponential and memory bounds that is reached."""
    grid, numbers, batches = sizes(config)
    batch, rows = batches[-1], []
    machine = gpu_rates() if device.type == "cuda" else None
    for n in numbers:
        inputs, model, position = scene(n, batch, device), model_of(n, grid, device), positions(batch).to(device)
        with torch.no_grad():
            drawing = rate(partial(rasterize_magnitude, *inputs, grid, "auto", CUTOFF), batch, device, config.seconds)
            row: Row = {"n": n, "batch": batch, "forward_per_s": drawing["median"]}
            row["model"] = kernels_of(partial(rendered, model, position, grid), device)
        if machine is not None:
            row["share_of_bounds"] = {
                "exponentials": drawing["median"] * kernel_values(inputs, grid) / machine["exponentials_per_s"],
                "writing": drawing["median"] * 4 * grid.n_elevation * grid.n_azimuth / machine["bytes_per_s"],
            }
        row["limit"] = limit(row)
        print(row["limit"], flush=True)
        rows.append(row)
    return {"grid": grid.shape, "gpu": machine, "rows": rows, "counters": counters(config, device)}


def limit(row: Row) -> str:
    """The profile in a sentence."""
    kernels = row["model"]["kernels"]
    name, share = max(kernels.items(), key=lambda found: found[1]) if kernels else ("nothing", 0.0)
    text = f"N = {row['n']}: {name} takes {share:.0%} of the model's time, the device waits {row['model']['idle']:.0%} of it"
    if "share_of_bounds" in row:
        bounds = row["share_of_bounds"]
        nearest = max(bounds, key=lambda bound: bounds[bound])
        text += f"; drawing reaches {bounds[nearest]:.0%} of the bound of {nearest}, which is the nearest"
    return text


def kernels_of(call: Callable[[], Any], device: torch.device, calls: int = 5) -> Row:
    """Shares of the time of a call that its kernels take, the longest first, and in which the device waits."""
    gpu = device.type == "cuda"
    for _ in range(2):
        call()
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if gpu else [])]) as profiler:
        seconds = timed(lambda: [call() for _ in range(calls)], device)
    kind = DeviceType.CUDA if gpu else DeviceType.CPU
    spent: dict[str, float] = {}
    for event in profiler.key_averages():
        if event.device_type == kind:
            taken = event.self_device_time_total if gpu else event.self_cpu_time_total
            spent[event.key] = spent.get(event.key, 0.0) + 1e-6 * taken / seconds
    longest = sorted(spent.items(), key=lambda found: -found[1])[:8]
    return {"seconds": seconds / calls, "kernels": dict(longest), "idle": max(0.0, 1 - sum(spent.values()))}


def counters(config: Config, device: torch.device) -> Row | str:
    """Return the counters of Nsight Compute for the rendering kernel, or the reason why there are none."""
    ncu = shutil.which("ncu")
    if device.type != "cuda" or ncu is None:
        return "no GPU" if device.type != "cuda" else "Nsight Compute (ncu) is not installed"
    command = [ncu, "--csv", "--page=raw", "--kernel-name=rasterize", "--launch-skip=1", "--launch-count=1"]
    draw = [sys.executable, __file__, "draw", *(["--quick"] if config.quick else [])]
    done = subprocess.run(
        [*command, f"--metrics={','.join(COUNTERS.values())}", *draw], capture_output=True, text=True, check=False
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith('"')]
    if done.returncode or len(lines) < 3:  # names, units, values
        return (done.stdout + done.stderr)[-1000:]
    values = dict(zip(*list(csv.reader([lines[0], lines[2]])), strict=True))
    return {name: values.get(metric) for name, metric in COUNTERS.items()}


class Launches(TorchDispatchMode):
    """Count of the operations that compute, each of which is a kernel or more on a GPU; views are none."""

    count = 0

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.count += not (func.is_view or func.name() in WITHOUT_KERNEL)
        return func(*args, **kwargs or {})


def launches(config: Config, device: torch.device) -> Row:
    """Return the number of operations of a model before the rasterizer, for one batch, once what is kept is computed."""
    grid, (n, *_), (batch, *_) = sizes(config)
    model, position = model_of(n, grid, device), positions(batch).to(device)
    # values are checked on a CPU alone
    with torch.no_grad(), mock.patch("swiftwrf.rasterize._check"):
        rendered(model, position, grid)
        with Launches() as counter:
            rendered(model, position, grid)
    return {"operations": counter.count}


def draw(config: Config, device: torch.device) -> None:
    """The largest scene, three times."""
    grid, numbers, batches = sizes(config)
    inputs = scene(numbers[-1], batches[-1], device)
    for _ in range(3):
        rasterize_magnitude(*inputs, grid, "auto", CUTOFF)


PARTS = {
    "rates": rates,
    "training": training,
    "profile": profiled,
    "launches": launches,
    "draw": draw,
}

if __name__ == "__main__":
    main(options(Config))
