"""The fast maker for CPUs: its kernels as operators of torch, with their gradient."""

# mypy: disable-error-code="no-untyped-def"
# (of the context that autograd hands over)

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.rasterize.cpu_kernels import draw, draw_backward
from swiftwrf.runtime.threads import threads_kept


def _arguments(mean: Tensor, cholesky: Tensor, weight: Tensor, cutoff: float | None) -> tuple[object, ...]:
    """What both kernels take first; `reach2` of cutoff None is where exp(-reach2 / 2) is 0 in float32."""
    reach2 = np.float32(210.0 if cutoff is None else -2 * math.log(cutoff))
    per_position = cholesky if cholesky.dim() == 3 else cholesky[None]
    arrays = (t.detach().contiguous().numpy() for t in (mean, per_position, weight))
    return (*arrays, reach2)


@threads_kept()
def _threads() -> int:
    """Of numba, which starts them when it is first asked for their number."""
    number: int = numba.get_num_threads()
    return number


def _operator(name: str) -> Callable[[Callable[..., Any]], Any]:
    """A function as an operator of torch: what `torch.library.custom_op` does, whose operators import torch's compiler when
    they first run. That takes three seconds, more than most fits of RSSI."""

    def register(function: Callable[..., Any]) -> Any:
        schema = torch.library.infer_schema(function, mutates_args=())
        torch.library.define(f"swiftwrf::{name}", schema, tags=torch.Tag.pt2_compliant_tag)
        torch.library.impl(f"swiftwrf::{name}", "cpu", function)
        return getattr(torch.ops.swiftwrf, name).default

    return register


@_operator("rasterize_cpu")
def _rasterize(
    mean: Tensor, cholesky: Tensor, weight: Tensor, n_elevation: int, n_azimuth: int, cutoff: float | None
) -> Tensor:
    out = weight.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)
    threads = _threads()
    n_bands = 1 if mean.shape[0] >= threads else min(threads, n_elevation)
    with threads_kept():
        draw(*_arguments(mean, cholesky, weight, cutoff), n_elevation, n_azimuth, n_bands, out.flatten(2).numpy())
    return out


@_operator("rasterize_cpu_backward")
def _rasterize_backward(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    d_mean, d_weight = torch.empty_like(mean), torch.empty_like(weight)
    d_cholesky = cholesky.new_empty(*mean.shape[:2], 3)
    threads = _threads()
    block = max(1, mean.shape[1] if mean.shape[0] >= threads else -(-mean.shape[1] // threads))
    arguments = _arguments(mean, cholesky, weight, cutoff)
    derivatives = (d_mean.numpy(), d_cholesky.numpy(), d_weight.numpy())
    with threads_kept():
        draw_backward(grad.contiguous().flatten(2).numpy(), *arguments, *grad.shape[2:], block, *derivatives)
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


torch.library.register_fake(
    "swiftwrf::rasterize_cpu",
    lambda mean, cholesky, weight, rows, columns, cutoff: weight.new_empty(mean.shape[0], 2, rows, columns),
)
torch.library.register_fake(
    "swiftwrf::rasterize_cpu_backward",
    lambda grad, mean, cholesky, weight, cutoff: tuple(torch.empty_like(x) for x in (mean, cholesky, weight)),
)


def _setup_context(ctx, inputs, output) -> None:
    *tensors, _, _, ctx.cutoff = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
    return (*_rasterize_backward(grad, *ctx.saved_tensors, ctx.cutoff), None, None, None)


torch.library.register_autograd("swiftwrf::rasterize_cpu", _backward, setup_context=_setup_context)


def rasterize(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """See `swiftwrf.rasterize`: mean (B, N, 2), cholesky (N, 3) or (B, N, 3), weight (B, N, 2), all float32 on the CPU,
    to (B, 2, n_elevation, n_azimuth). Angles are brought to pixels here, so the kernels know nothing of grids."""
    step = torch.tensor([grid.azimuth_step, grid.elevation_step], dtype=torch.float64)
    start = torch.tensor([grid.azimuth_start, grid.elevation_start], dtype=torch.float64)
    # in float64: far columns and means many turns away would lose the fraction of a pixel in float32
    pixel = (mean.double() - start) / step
    turns = torch.floor(pixel.detach()[..., :1] / grid.n_azimuth) * grid.n_azimuth
    pixel = pixel - torch.cat([turns, torch.zeros_like(turns)], dim=-1)
    columns, rows = (float(x) for x in step)
    factor = cholesky / cholesky.new_tensor([columns, rows, rows])
    drawn: Tensor = _rasterize(pixel, factor, weight, *grid.shape, cutoff)
    return drawn
