"""The fast maker for CPUs: each primitive visits only the pixels its kernel reaches, rows advance by two multiplications.

Along a row the exponent is a quadratic in the column, so neighbouring kernel values have a ratio r that itself changes by a
constant ratio s: g *= r, r *= s. Rounding grows with the square of the number of steps, hence both are computed anew
every `ANCHOR` columns (every column where cutoff is None). Work is spread over positions and, where there are few, over
bands of rows (forward) or blocks of primitives (backward); no sum depends on how it was spread, so the bits are the same
for any number of threads and any batch size.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, call-arg, no-any-return"
# (the jitted functions take NumPy arrays and scalars; numba types them itself)

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from swiftwrf.angles import AngularGrid
from swiftwrf.threads import threads_kept

ANCHOR = 16  # columns between two exact exponentials: 16^2 / 2 roundings stay under 1e-5 of the kernel

_FAST = {"contract", "nsz", "arcp"}  # not reassoc or nnan: sums keep their order, and what is not finite stays visible
_inline = njit(inline="always", fastmath=_FAST)


def _jit(function):
    """Compiled at first use, and kept for the next process where there is a place to keep it: neither an installation that
    may not be written nor a user without a home is one."""
    try:
        return njit(parallel=True, fastmath=_FAST, cache=True)(function)
    except RuntimeError:
        return njit(parallel=True, fastmath=_FAST)(function)


@_inline
def _rows(y, l2, l3, reach2, top, bottom):
    """First row and one past the last of [top, bottom) that a kernel centred on row `y` reaches."""
    extent = math.sqrt(reach2 * (l2 * l2 + l3 * l3))
    first = max(top, math.ceil(max(y - extent, -1.0)))
    last = min(bottom - 1, math.floor(min(y + extent, float(bottom))))
    return (int(first), int(last) + 1) if last >= first else (0, 0)


@_inline
def _columns(x, dy, l2, l3, inv1, inv3, reach2, n_azimuth):
    """First column and one past the last that a kernel centred on column `x` reaches on the row `dy` above its centre.

    Completing the square: u^2 + v^2 = dy^2 / (l2^2 + l3^2) + curvature (dx - lean dy)^2. Never more than the turn centred
    on the mean (the nearest image), and a direction half a turn away is drawn once.
    """
    shear = l2 * inv1 * inv3
    curvature = inv1 * inv1 + shear * shear
    remain = reach2 - dy * dy / (l2 * l2 + l3 * l3)
    if remain < 0:
        return 0, 0
    half = math.sqrt(remain / curvature)
    middle = x + shear * inv3 / curvature * dy
    half_turn = 0.5 * n_azimuth
    first = math.ceil(max(middle - half, x - half_turn))
    last = math.floor(min(middle + half, x + half_turn))
    return int(first), min(int(last) + 1, int(first) + n_azimuth)


@_jit
def _draw(mean, cholesky, weight, reach2, anchor, n_bands, out):
    n_position, n = mean.shape[0], mean.shape[1]
    n_elevation, n_azimuth = out.shape[2], out.shape[3]
    shared = cholesky.shape[0] == 1
    band = (n_elevation + n_bands - 1) // n_bands
    half = np.float32(0.5)
    for task in prange(n_position * n_bands):
        b = task // n_bands
        top = min((task % n_bands) * band, n_elevation)
        bottom = min(top + band, n_elevation)
        re, im = out[b, 0], out[b, 1]
        re[top:bottom] = np.float32(0)
        im[top:bottom] = np.float32(0)
        c = 0 if shared else b
        for i in range(n):
            l1, l2, l3 = cholesky[c, i, 0], cholesky[c, i, 1], cholesky[c, i, 2]
            x, y = mean[b, i, 0], mean[b, i, 1]
            weight_re, weight_im = weight[b, i, 0], weight[b, i, 1]
            inv1, inv3 = np.float32(1) / l1, np.float32(1) / l3
            shear = l2 * inv1 * inv3
            curvature = inv1 * inv1 + shear * shear
            s = math.exp(-curvature)
            first_row, end_row = _rows(y, l2, l3, reach2, top, bottom)
            for row in range(first_row, end_row):
                dy = np.float32(row - y)
                first, end = _columns(x, dy, l2, l3, inv1, inv3, reach2, n_azimuth)
                column = first % n_azimuth
                for start in range(first, end, anchor):
                    u = np.float32(start - x) * inv1
                    v = (dy - l2 * u) * inv3
                    g = math.exp(-half * (u * u + v * v))
                    r = math.exp(v * shear - u * inv1 - half * curvature)
                    for _ in range(start, min(start + anchor, end)):
                        re[row, column] += weight_re * g
                        im[row, column] += weight_im * g
                        g *= r
                        r *= s
                        column += 1
                        if column == n_azimuth:
                            column = 0


@_jit
def _draw_backward(grad, mean, cholesky, weight, reach2, anchor, block, d_mean, d_cholesky, d_weight):
    n_position, n = mean.shape[0], mean.shape[1]
    n_elevation, n_azimuth = grad.shape[2], grad.shape[3]
    shared = cholesky.shape[0] == 1
    n_blocks = (n + block - 1) // block
    half, zero = np.float32(0.5), np.float32(0)
    for task in prange(n_position * n_blocks):
        b = task // n_blocks
        begin = (task % n_blocks) * block
        re, im = grad[b, 0], grad[b, 1]
        c = 0 if shared else b
        for i in range(begin, min(begin + block, n)):
            l1, l2, l3 = cholesky[c, i, 0], cholesky[c, i, 1], cholesky[c, i, 2]
            x, y = mean[b, i, 0], mean[b, i, 1]
            weight_re, weight_im = weight[b, i, 0], weight[b, i, 1]
            inv1, inv3 = np.float32(1) / l1, np.float32(1) / l3
            shear = l2 * inv1 * inv3
            curvature = inv1 * inv1 + shear * shear
            s = math.exp(-curvature)
            d_re, d_im = zero, zero
            # sums of z, the kernel times the derivative by it, over the footprint with u, v, u^2, u v, v^2
            z_u, z_v, z_uu, z_uv, z_vv = zero, zero, zero, zero, zero
            first_row, end_row = _rows(y, l2, l3, reach2, 0, n_elevation)
            for row in range(first_row, end_row):
                dy = np.float32(row - y)
                first, end = _columns(x, dy, l2, l3, inv1, inv3, reach2, n_azimuth)
                column = first % n_azimuth
                for start in range(first, end, anchor):
                    u = np.float32(start - x) * inv1
                    v = (dy - l2 * u) * inv3
                    g = math.exp(-half * (u * u + v * v))
                    r = math.exp(v * shear - u * inv1 - half * curvature)
                    for _ in range(start, min(start + anchor, end)):
                        grad_re, grad_im = re[row, column], im[row, column]
                        d_re += g * grad_re
                        d_im += g * grad_im
                        z = g * (weight_re * grad_re + weight_im * grad_im)
                        zu, zv = z * u, z * v
                        z_u += zu
                        z_v += zv
                        z_uu += zu * u
                        z_uv += zu * v
                        z_vv += zv * v
                        g *= r
                        r *= s
                        u += inv1
                        v -= shear
                        column += 1
                        if column == n_azimuth:
                            column = 0
            d_mean[b, i, 0] = inv1 * z_u - shear * z_v
            d_mean[b, i, 1] = inv3 * z_v
            d_cholesky[b, i, 0] = inv1 * z_uu - shear * z_uv
            d_cholesky[b, i, 1] = inv3 * z_uv
            d_cholesky[b, i, 2] = inv3 * z_vv
            d_weight[b, i, 0] = d_re
            d_weight[b, i, 1] = d_im


def _arguments(mean: Tensor, cholesky: Tensor, weight: Tensor, cutoff: float | None) -> tuple[object, ...]:
    """What both kernels take first; `REACH2` of cutoff None is where exp(-reach2 / 2) is 0 in float32."""
    reach2 = np.float32(210.0 if cutoff is None else -2 * math.log(cutoff))
    per_position = cholesky if cholesky.dim() == 3 else cholesky[None]
    arrays = (t.detach().contiguous().numpy() for t in (mean, per_position, weight))
    return (*arrays, reach2, 1 if cutoff is None else ANCHOR)


@threads_kept()
def _threads() -> int:
    """Of numba, which starts them when it is first asked for their number."""
    number: int = numba.get_num_threads()
    return number


@torch.library.custom_op("swiftwrf::rasterize_cpu", mutates_args=(), device_types="cpu")
def _rasterize(
    mean: Tensor, cholesky: Tensor, weight: Tensor, n_elevation: int, n_azimuth: int, cutoff: float | None
) -> Tensor:
    out = weight.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)
    threads = _threads()
    n_bands = 1 if mean.shape[0] >= threads else min(threads, n_elevation)
    with threads_kept():
        _draw(*_arguments(mean, cholesky, weight, cutoff), n_bands, out.numpy())
    return out


@torch.library.custom_op("swiftwrf::rasterize_cpu_backward", mutates_args=(), device_types="cpu")
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
        _draw_backward(grad.contiguous().numpy(), *arguments, block, *derivatives)
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


@_rasterize.register_fake
def _(mean: Tensor, cholesky: Tensor, weight: Tensor, n_elevation: int, n_azimuth: int, cutoff: float | None) -> Tensor:
    return weight.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)


@_rasterize_backward.register_fake
def _(grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, cutoff: float | None) -> tuple[Tensor, ...]:
    return torch.empty_like(mean), torch.empty_like(cholesky), torch.empty_like(weight)


def _setup_context(ctx, inputs, output) -> None:
    *tensors, _, _, ctx.cutoff = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
    return (*_rasterize_backward(grad, *ctx.saved_tensors, ctx.cutoff), None, None, None)


_rasterize.register_autograd(_backward, setup_context=_setup_context)


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
    return _rasterize(pixel, factor, weight, *grid.shape, cutoff)
