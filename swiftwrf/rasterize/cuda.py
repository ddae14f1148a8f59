"""CUDA backend: pack the arguments of the kernels in `rasterize.cu` and launch them on torch's current stream.

The kernels convert radians to pixels themselves: tensor operations in float64 would cost as much memory traffic as the
rendering. Nothing waits for the device, so calls can be captured in CUDA graphs once the kernels are compiled.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.rasterize.cuda_kernels import kernels

# These equal the constants of rasterize.cu.
THREADS_PER_BLOCK, WARPS_PER_BLOCK, THREADS_PER_WARP = 256, 8, 32
TILE_COLUMNS, TILE_ROWS = 16, 8
GATHERING_WARPS = 16

SMALL = 1024  # number of primitives up to which half as many warps a block are faster, on an H100


def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return real and imaginary part of the field, (B, 2, n_elevation, n_azimuth); see `operators.field`."""
    rendered = mean.new_empty(mean.shape[0], 2, *grid.shape)
    _render(mean, cholesky, weight, grid, cutoff, rendered, None)
    return rendered


def magnitude(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None, keep_phase: bool
) -> tuple[Tensor, Tensor]:
    """Return |A|, (B, n_elevation, n_azimuth), and A / |A|, (B, 2, n_elevation, n_azimuth), empty without `keep_phase`."""
    batch = mean.shape[0]
    length, phase = mean.new_empty(batch, *grid.shape), mean.new_empty(batch if keep_phase else 0, 2, *grid.shape)
    _render(mean, cholesky, weight, grid, cutoff, phase, length)
    return length, phase


def field_gradients(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of mean, factor and weight for a gradient (B, 2, n_elevation, n_azimuth) of the field."""
    return _gradients("rasterize_backward", [grad], mean, cholesky, weight, grid, cutoff)


def magnitude_gradients(
    grad: Tensor, phase: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients for a gradient (B, n_elevation, n_azimuth) of the magnitude."""
    return _gradients("magnitude_backward", [grad, phase], mean, cholesky, weight, grid, cutoff)


def _render(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None,
    field: Tensor, magnitude: Tensor | None,
) -> None:  # fmt: skip
    """Write into `field` and `magnitude`."""
    batch, n = mean.shape[:2]
    if not batch:
        return
    mean, cholesky, weight = _aligned(mean, cholesky, weight)
    common = n, cholesky.dim() == 3, _grid(grid), _cutoff(cutoff)
    across, down = -(-grid.n_azimuth // TILE_COLUMNS), -(-grid.n_elevation // TILE_ROWS)
    words = -(-n // THREADS_PER_WARP)
    reached = torch.empty(batch, across + down, words, dtype=torch.int32, device=mean.device)
    launch = kernels(mean.device).launch
    if n:
        launch("find_reach", batch * -(-words // WARPS_PER_BLOCK), THREADS_PER_BLOCK, mean, cholesky, reached, *common)
    blocks = -(-batch * across * down // WARPS_PER_BLOCK)
    launch("rasterize", blocks, THREADS_PER_BLOCK, mean, cholesky, weight, reached, field, magnitude, batch, *common)


def _gradients(
    kernel: str, incoming: list[Tensor], mean: Tensor, cholesky: Tensor, weight: Tensor,
    grid: AngularGrid, cutoff: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    *incoming, mean, cholesky, weight = _aligned(*incoming, mean, cholesky, weight)
    batch, n = mean.shape[:2]
    d_mean, d_weight, d_cholesky = torch.empty_like(mean), torch.empty_like(weight), cholesky.new_empty(batch, n, 3)
    if mean.numel():
        # Small blocks wait less for each other, large ones read the incoming gradient less often.
        warps = GATHERING_WARPS // 2 if n <= SMALL else GATHERING_WARPS
        per_warp = min(-(-n // warps), THREADS_PER_WARP)
        kernels(mean.device).launch(
            kernel, batch * -(-n // (warps * per_warp)), warps * THREADS_PER_WARP,
            *incoming, mean, cholesky, weight, d_mean, d_cholesky, d_weight,
            n, per_warp, cholesky.dim() == 3, _grid(grid), _cutoff(cutoff),
        )  # fmt: skip
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


def _aligned(*tensors: Tensor) -> list[Tensor]:
    """Return the tensors as the kernels read them: float32, contiguous, aligned to pairs of floats."""
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device != tensors[0].device:
            raise InputError(f"expected float32 tensors on {tensors[0].device}, got {tensor.dtype} on {tensor.device}")
    contiguous = (tensor.contiguous() for tensor in tensors)
    return [tensor if tensor.data_ptr() % 8 == 0 else tensor.clone() for tensor in contiguous]


def _grid(grid: AngularGrid) -> np.ndarray:
    """Return the structure `Grid` of the kernels."""
    axes = (grid.azimuth_start, grid.azimuth_step), (grid.elevation_start, grid.elevation_step)
    conversion = [value for start, step in axes for value in _axis(start, step)]
    return np.array((conversion, (grid.n_azimuth, grid.n_elevation)), "8f4, 2i4")


def _axis(start: float, step: float) -> tuple[float, float, float, float]:
    """Return the structure `Axis` for pixel = angle * scale - start.

    Each factor is a float32 and its rounding error; the float32 of `start` is a multiple of 1/2.
    """
    scale, pixels = 1 / step, start / step
    halves = round(2 * pixels) / 2
    return scale, scale - float(np.float32(scale)), halves, pixels - halves


def _cutoff(cutoff: float | None) -> np.ndarray:
    """Return the structure `Cutoff`: log2 of the least kernel value, and its distance in standard deviations."""
    log2 = -126.0 if cutoff is None else math.log2(cutoff)  # Smaller float32 numbers are flushed to zero.
    return np.array([log2, math.sqrt(-2 * math.log(2) * log2)], np.float32)
