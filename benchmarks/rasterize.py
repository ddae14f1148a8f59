"""Spectra per second: each backend alone and the whole model, on the machine's GPU where there is one, else on its CPU.

Rates are of magnitudes |A|: medians over repeats with minimum and maximum. Backends are compared within one run. On a GPU
every rate is also given as a share of two bounds: the exponentials of the pixels inside the cutoff (16 a clock and
multiprocessor), and the writing of the magnitude at the speed of a measured copy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numba
import numpy as np
import torch
from record import RESULTS, options, write_result
from torch import Tensor

from swiftwrf import AngularGrid, SwiftWRF, rasterize
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.models import swiftwrf as model_module
from swiftwrf.rasterize import Backend, rasterize_magnitude
from tasks.environment import choose_device

Rate = dict[str, float]
CUTOFF = 1e-3
RANK = 32  # components of the model
LARGEST_DENSE = 5e7  # kernel values of one spectrum: the definition keeps several such tensors
LARGEST_OUTPUT = 2**31  # bytes of the spectra of one call


@dataclass(frozen=True)
class Config:
    quick: bool = False
    """few primitives, small grids, one batch size"""
    seconds: float = 1.0
    """time for the repeats of one rate; at least 3, at most 50 of them"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to draw; auto takes the GPU where there is one"""
    out: Path = RESULTS
    """folder of the result"""


def main(config: Config) -> None:
    """Measures every combination and writes `rasterize_<cpu or GPU>.json`."""
    device = choose_device(config.device)
    sizes = {"n": [50, 200], "grid": [(16, 16), (90, 360)], "batch": [8]}
    if not config.quick:
        batch = [1, 8] if device.type == "cpu" else [1, 16, 256, 4096]
        sizes = {"n": [50, 200, 1000, 10_000], "grid": [(16, 16), (90, 360), (180, 720)], "batch": batch}
    machine = gpu_rates() if device.type == "cuda" else None
    rows = []
    for shape in sizes["grid"]:
        for n in sizes["n"]:
            for batch in sizes["batch"]:
                if batch * 8 * shape[0] * shape[1] <= LARGEST_OUTPUT:
                    rows.append(measure(AngularGrid.hemisphere(*shape), n, batch, device, machine, config.seconds))
                    report(rows[-1])
    name = torch.cuda.get_device_name().replace(" ", "-").lower() if device.type == "cuda" else "cpu"
    threads = {"torch": torch.get_num_threads(), "numba": numba.get_num_threads()}
    content = {"cutoff": CUTOFF, "quick": config.quick, "threads": threads, "gpu": machine, "rows": rows}
    write_result(f"rasterize_{name}", content, device, config.out)


def measure(
    grid: AngularGrid, n: int, batch: int, device: torch.device, machine: Rate | None, seconds: float
) -> dict[str, Any]:
    """Return one row: every backend alone, forward and with gradients, and the model from positions to magnitudes."""
    inputs = scene(n, batch, device)
    exact = exact_spectrum(inputs, grid)
    backends: dict[str, Any] = {}
    for backend in ("reference", "cuda" if device.type == "cuda" else "cpu"):
        # the definition draws one position at a time: its rate does not grow with the batch
        few = [x[:1] if x.dim() == 3 else x for x in inputs] if backend == "reference" else inputs
        if backend == "reference" and exact is None:
            continue
        drawn = rasterize(*few, grid, backend, CUTOFF)
        backends[backend] = {
            "forward_per_s": rate(
                lambda f=few, b=backend: rasterize_magnitude(*f, grid, b, CUTOFF), len(few[0]), device, seconds
            ),
            "forward_backward_per_s": rate(
                lambda f=few, b=backend: with_gradients(f, grid, b), len(few[0]), device, seconds
            ),
            "error_of_sum_weight": None if exact is None else value_error(drawn[:1], exact, inputs[2][:1]),
        }
    row: dict[str, Any] = {"grid": grid.shape, "n": n, "batch": batch, "backends": backends}
    fast = backends["cuda" if device.type == "cuda" else "cpu"]
    if "reference" in backends:
        row["over_reference"] = {
            key: fast[key]["median"] / backends["reference"][key]["median"]
            for key in ("forward_per_s", "forward_backward_per_s")
        }
    row["end_to_end_per_s"] = end_to_end(n, batch, grid, device, seconds)
    row["end_to_end_share"] = row["end_to_end_per_s"]["median"] / fast["forward_per_s"]["median"]
    if machine is not None:
        row["share_of_bounds"] = {
            "exponentials": fast["forward_per_s"]["median"] * kernel_values(inputs, grid) / machine["exponentials_per_s"],
            "writing": fast["forward_per_s"]["median"] * 4 * grid.n_elevation * grid.n_azimuth / machine["bytes_per_s"],
        }  # fmt: skip
        row["peak_memory_bytes"] = torch.cuda.max_memory_allocated()
        torch.cuda.reset_peak_memory_stats()
    return row


def scene(n: int, batch: int, device: torch.device) -> list[Tensor]:
    """Random primitives of which each pixel sees equally many whatever their number: standard deviations of one degree
    for 10,000, as in a published model with that many."""
    generator = torch.Generator().manual_seed(0)
    mean = torch.rand(batch, n, 2, generator=generator) * torch.tensor([2 * torch.pi, torch.pi / 2])
    cholesky = np.radians(100) / n**0.5 * torch.exp(0.35 * torch.randn(n, 3, generator=generator))
    cholesky[:, 1] *= 0.5 * torch.randn(n, generator=generator)
    return [x.to(device) for x in (mean, cholesky, torch.randn(batch, n, 2, generator=generator))]


def exact_spectrum(inputs: list[Tensor], grid: AngularGrid) -> Tensor | None:
    """The first position in float64 without a cutoff; None where the definition would not fit in memory."""
    if inputs[0].shape[1] * grid.n_elevation * grid.n_azimuth > LARGEST_DENSE:
        return None
    return rasterize(*(x[:1] if x.dim() == 3 else x for x in (t.double() for t in inputs)), grid, "reference", None)


def value_error(drawn: Tensor, exact: Tensor, weight: Tensor) -> float:
    """Largest difference as a share of sum |weight|."""
    return float((drawn - exact).abs().max() / weight.norm(dim=-1).sum())


def kernel_values(inputs: list[Tensor], grid: AngularGrid) -> float:
    """Pixels inside the cutoff of a primitive, summed over the primitives of one position, drawn with weight 1."""
    mean, cholesky, _ = (x[:1] if x.dim() == 3 else x for x in inputs)
    total = 0
    for i in range(0, mean.shape[1], 256):  # one primitive a position
        one = mean[0, i : i + 256, None]
        drawn = rasterize(one, cholesky[i : i + 256, None], torch.ones_like(one), grid, "auto", CUTOFF)
        total += int(torch.count_nonzero(drawn[:, 0]))
    return float(total)


def with_gradients(inputs: list[Tensor], grid: AngularGrid, backend: Backend) -> None:
    """One drawing of |A| and the gradients of everything."""
    leaves = [x.detach().requires_grad_() for x in inputs]
    drawn = rasterize_magnitude(*leaves, grid, backend, CUTOFF)
    torch.autograd.grad(drawn, leaves, torch.ones_like(drawn))


def end_to_end(n: int, batch: int, grid: AngularGrid, device: torch.device, seconds: float) -> Rate:
    """Return the rate from positions to magnitudes without cached kernels."""
    model, position = model_of(n, grid, device), positions(batch).to(device)
    with torch.no_grad():
        return rate(lambda: rendered(model, position, grid), batch, device, seconds)


def rendered(model: SwiftWRF, position: Tensor, grid: AngularGrid) -> Tensor:
    """Return magnitudes at positions, without cached kernels."""
    return rasterize_magnitude(*model.primitives(position), grid, cutoff=CUTOFF)


def model_of(n: int, grid: AngularGrid, device: torch.device) -> SwiftWRF:
    """Return a model of 32 components with the primitives of `scene`."""
    model_module.CUTOFF = CUTOFF  # of all rates
    generator = torch.Generator().manual_seed(0)
    model, (mean, cholesky, _) = SwiftWRF(n_primitives=n), scene(n, 1, torch.device("cpu"))
    known, value = positions(200).double(), torch.randn(200, RANK, generator=generator, dtype=torch.float64)
    model.grid, model.bounds = grid, torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64)
    model.mean, model.cholesky, model.spread = mean[0], cholesky, torch.ones(grid.shape)
    model.weight, model.component = torch.randn(1 + RANK, n, generator=generator), torch.zeros(1 + RANK, *grid.shape)
    model.process = GaussianProcess(Kernel(), known, value)
    model._move(device)
    return model


def positions(n: int) -> Tensor:
    """In a cube of a metre."""
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(0))


def timed(call: Callable[[], Any], device: torch.device) -> float:
    """Seconds of one call, until the device has done it."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    began = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began


def rate(draw: Callable[[], Any], batch: int, device: torch.device, seconds: float) -> Rate:
    """Spectra per second after two warm-up calls: median, least and most of the repeats."""

    timed(draw, device)
    repeats = int(np.clip(seconds / timed(draw, device), 3, 50))
    taken = [timed(draw, device) for _ in range(repeats)]
    return {"median": batch / float(np.median(taken)), "low": batch / max(taken), "high": batch / min(taken)}


def gpu_rates() -> Rate:
    """Return peak rates of the GPU: exponentials from its clock, bytes written (and read) from a copy of 1 GiB."""
    properties = torch.cuda.get_device_properties(0)
    source = torch.empty(2**28, device="cuda")
    target = torch.empty_like(source)
    copies = rate(lambda: target.copy_(source), 1, torch.device("cuda"), 0.5)["median"]
    return {
        "exponentials_per_s": 16.0 * properties.multi_processor_count * properties.clock_rate * 1e3,
        "bytes_per_s": 2 * 2.0**30 * copies,
    }


def report(row: dict[str, Any]) -> None:
    """One line."""
    rates = {
        name: {k: f"{v['median']:.4g}" for k, v in m.items() if k.endswith("_s")} for name, m in row["backends"].items()
    }
    print(row["grid"], "N", row["n"], "batch", row["batch"], rates, f"end to end {row['end_to_end_per_s']['median']:.4g}",
          row.get("share_of_bounds", ""), flush=True)  # fmt: skip


if __name__ == "__main__":
    main(options(Config))
