"""CPU backend: spread the compiled kernels of `cpu_kernels` over torch's threads."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.rasterize.cpu_kernels import render, render_backward
from swiftwrf.runtime.threads import threads_kept

MAX_SQUARED_DISTANCE = 210.0  # exp(-x / 2) is 0 in float32 beyond it


@threads_kept()
def _threads() -> int:
    """Give numba as many threads as torch has, and return their number. Numba starts its threads at the first call."""
    number: int = min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(number)
    return number


def _inputs(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> tuple[Any, ...]:
    """Return the first arguments of both kernels."""
    tensors = mean, cholesky if cholesky.dim() == 3 else cholesky[None], weight
    squared = MAX_SQUARED_DISTANCE if cutoff is None else -2 * math.log(cutoff)
    origin, step = (grid.elevation_start, grid.azimuth_start), (grid.elevation_step, grid.azimuth_step)
    return *(tensor.detach().contiguous().numpy() for tensor in tensors), origin, step, grid.shape, np.float32(squared)


def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return real and imaginary part of the field, (B, 2, n_elevation, n_azimuth); see `operators.field`."""
    rendered = weight.new_empty(mean.shape[0], 2, *grid.shape)
    threads = _threads()
    n_bands = 1 if mean.shape[0] >= threads else min(threads, grid.n_elevation)
    with threads_kept():
        render(*_inputs(mean, cholesky, weight, grid, cutoff), n_bands, rendered.flatten(2).numpy())
    return rendered


def field_gradients(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of mean, factor and weight for a gradient (B, 2, n_elevation, n_azimuth) of the field."""
    batch, n = mean.shape[:2]
    derivatives = mean.new_empty(batch, n, 2), cholesky.new_empty(batch, n, 3), weight.new_empty(batch, n, 2)
    threads = _threads()
    block = max(1, n if batch >= threads else -(-n // threads))
    incoming = grad.detach().contiguous().flatten(2).numpy()
    with threads_kept():
        inputs = _inputs(mean, cholesky, weight, grid, cutoff)
        render_backward(incoming, *inputs, block, *(derivative.numpy() for derivative in derivatives))
    d_mean, d_cholesky, d_weight = derivatives
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


def magnitude(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None, keep_phase: bool
) -> tuple[Tensor, Tensor]:
    """Return |A|, (B, n_elevation, n_azimuth), and A / |A|, (B, 2, n_elevation, n_azimuth), empty without `keep_phase`."""
    rendered = field(mean, cholesky, weight, grid, cutoff)
    length = torch.hypot(*rendered.unbind(1))
    if not keep_phase:
        return length, rendered.new_empty(0, *rendered.shape[1:])
    return length, rendered.div_(torch.where(length == 0, 1.0, length).unsqueeze(1))


def magnitude_gradients(
    grad: Tensor, phase: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients for a gradient (B, n_elevation, n_azimuth) of the magnitude."""
    return field_gradients(grad.unsqueeze(1) * phase, mean, cholesky, weight, grid, cutoff)
