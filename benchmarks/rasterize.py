"""Spectra per second of each maker, against the definition in the same run, and the error that the speed costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from record import write_result
from torch import Tensor

from swiftwrf import AngularGrid, rasterize

GRID = AngularGrid.hemisphere(90, 360)
NUMBERS = (50, 200, 1000)
BATCH = 8
REPEATS = 5


def scene(n: int, batch: int) -> list[Tensor]:
    """Random primitives that cover the grid alike whatever their number."""
    generator = torch.Generator().manual_seed(0)
    mean = torch.rand(batch, n, 2, generator=generator) * torch.tensor([2 * torch.pi, torch.pi / 2])
    width = torch.tensor([2 * torch.pi, 0.0, torch.pi / 2]) / n**0.5 / 2
    cholesky = width.repeat(n, 1)
    cholesky[:, 1] = 0.3 * width[2] * torch.randn(n, generator=generator)
    return [mean, cholesky, torch.randn(batch, n, 2, generator=generator)]


def rate(draw: Callable[[], Any], batch: int, repeats: int) -> dict[str, float]:
    """Spectra per second: median, least and most of the repeats after one warm-up."""
    draw()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        draw()
        seconds.append(time.perf_counter() - began)
    return {"median": batch / float(np.median(seconds)), "low": batch / max(seconds), "high": batch / min(seconds)}


def forward_backward(inputs: list[Tensor], maker: str, cutoff: float | None) -> None:
    """One drawing and its gradients."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    rasterize(*leaves, GRID, maker=maker, cutoff=cutoff).square().sum().backward()


def main() -> None:
    """Measures forward and forward + backward."""
    rows = []
    for n in NUMBERS:
        inputs = scene(n, BATCH)
        exact = rasterize(
            *(x[:1] if x.dim() == 3 else x for x in (t.double() for t in inputs)), GRID, "reference", None
        )
        scale = float(inputs[2][:1].norm(dim=-1).sum())
        for maker, cutoff, batch, repeats in (
            ("reference", None, 1, 3),
            ("cpu", None, BATCH, REPEATS),
            ("cpu", 1e-4, BATCH, REPEATS),
        ):
            few = [x[:batch] if x.dim() == 3 else x for x in inputs]
            drawn = rasterize(*few, GRID, maker=maker, cutoff=cutoff)
            row = {
                "maker": maker,
                "cutoff": cutoff,
                "n": n,
                "batch": batch,
                "forward_per_s": rate(
                    lambda f=few, m=maker, c=cutoff: rasterize(*f, GRID, maker=m, cutoff=c), batch, repeats
                ),
                "forward_backward_per_s": rate(
                    lambda f=few, m=maker, c=cutoff: forward_backward(f, m, c), batch, repeats
                ),
                "value_error_of_sum_weight": float((drawn[:1] - exact).abs().max()) / scale,
            }
            rows.append(row)
            print(
                maker, cutoff, n, {k: round(v["median"], 1) for k, v in row.items() if isinstance(v, dict)}, flush=True
            )
    ratio = {
        f"n{n}": {
            key: next(r for r in rows if r["n"] == n and r["maker"] == "cpu" and r["cutoff"])[key]["median"]
            / next(r for r in rows if r["n"] == n and r["maker"] == "reference")[key]["median"]
            for key in ("forward_per_s", "forward_backward_per_s")
        }
        for n in NUMBERS
    }
    write_result(
        "rasterize", {"grid": GRID.shape, "threads": torch.get_num_threads(), "cpu_over_reference": ratio, "rows": rows}
    )


if __name__ == "__main__":
    main()
