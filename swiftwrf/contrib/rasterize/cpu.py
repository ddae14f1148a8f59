"""CPU backend, compiled by numba: each primitive visits only the pixels within its cutoff.

The exponent of a kernel is a parabola along a row. The vector lanes of the processor evaluate 2^t for the columns of a row
by a polynomial. Threads share positions and, if positions are few, bands of rows (forward) or blocks of primitives
(backward). No sum depends on this division, so results have the same bits for any number of threads and any batch size.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, call-arg, no-any-return"
# (numba infers the types of the compiled functions)

from __future__ import annotations

import math
import os
from functools import cache
from typing import Any

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.runtime.threads import threads_kept

BASE2 = np.float32(-0.5 / math.log(2))  # exp(-x / 2) = 2^(BASE2 x)

_FAST = {"contract", "nsz", "arcp", "reassoc"}  # Without nnan and ninf, so that values that are not finite propagate.
_inline = njit(inline="always", fastmath=_FAST)


def _jit(function):
    """Compile a function at its first use, and cache the result on disk if numba finds a folder that it can write to."""
    try:
        return njit(parallel=True, fastmath=_FAST, cache=True)(function)
    except RuntimeError:
        return njit(parallel=True, fastmath=_FAST)(function)


@_inline
def _pixels(mean, cholesky, origin, step, n_azimuth):
    """Return column, row and Cholesky factor in pixels, the column within the grid.

    The mean is float64: float32 would lose the fraction of a pixel of far columns and of means many turns away.
    """
    x, y = (mean[0] - origin[1]) / step[1], (mean[1] - origin[0]) / step[0]
    l1, l2, l3 = cholesky[0] / step[1], cholesky[1] / step[0], cholesky[2] / step[0]
    return x - math.floor(x / n_azimuth) * n_azimuth, y, np.float32(l1), np.float32(l2), np.float32(l3)


@_inline
def _rows(y, l2, l3, reach2, top, bottom):
    """Return the first row, and the row after the last, of [top, bottom) within the cutoff of a kernel on row `y`."""
    extent = math.sqrt(reach2 * (l2 * l2 + l3 * l3))
    first = max(top, math.ceil(max(y - extent, -1.0)))
    last = min(bottom - 1, math.floor(min(y + extent, float(bottom))))
    return (int(first), int(last) + 1) if last >= first else (0, 0)


@_inline
def _quadratic(l1, l2, l3):
    """Return inv1, inv3, shear, curvature, lean, steepness of a Cholesky factor.

    u = inv1 dx and v = inv3 dy - shear dx, so that u^2 + v^2 = steepness dy^2 + curvature (dx - lean dy)^2.
    """
    inv1, inv3 = np.float32(1) / l1, np.float32(1) / l3
    shear = l2 * inv1 * inv3
    curvature = inv1 * inv1 + shear * shear
    return inv1, inv3, shear, curvature, shear * inv3 / curvature, np.float32(1) / (l2 * l2 + l3 * l3)


@_inline
def _columns(x, dy, curvature, lean, steepness, reach2, n_azimuth):
    """Return the first column, the column after the last, and the distance of the first from the row's own centre.

    The columns are those within the cutoff of a kernel centred on column `x`, on the row `dy` above its centre. They cover
    at most the turn centred on the mean, so that a direction half a turn away counts once.
    """
    remain = reach2 - steepness * dy * dy
    if remain < 0:
        return 0, 0, np.float32(0)
    half, middle = math.sqrt(remain / curvature), x + lean * dy
    low, high = middle - half, middle + half
    half_turn = 0.5 * n_azimuth
    if low < x - half_turn:
        low = x - half_turn
    if high > x + half_turn:
        high = x + half_turn
    first = np.int64(np.ceil(low))
    return first, min(np.int64(np.floor(high)) + 1, first + n_azimuth), np.float32(first - middle)


@_inline
def _exp2(t):
    """Return 2^t with a relative error of 3e-7, and at least the smallest normal number."""
    t = np.float32(-126) if t < np.float32(-126) else t  # nan stays nan
    whole = np.floor(t + np.float32(0.5))
    x = t - whole
    power = np.float32(1.3276470e-3)  # minimax polynomial of the relative error on [-1/2, 1/2]
    power = power * x + np.float32(9.6755410e-3)
    power = power * x + np.float32(5.5507135e-2)
    power = power * x + np.float32(2.4022120e-1)
    power = power * x + np.float32(6.9314694e-1)
    power = power * x + np.float32(1.0000001)
    exponent = np.int32((np.int32(whole) + 127) << 23)
    return power * np.int32(exponent).view(np.float32)


@_inline
def _kernel(start, n_columns, drop, bend, kernel):
    """Write 2^(drop + bend d^2) for the distances d = start, start + 1, ... from the row's centre into `kernel`."""
    for k in range(n_columns):
        d = start + np.float32(np.int32(k))
        kernel[k] = _exp2(drop + bend * d * d)


@_inline
def _add(kernel, begin, end, weight_re, weight_im, re, im, pixel):
    """Add the kernel values from `begin` to `end`, times the weight, to the pixels from `pixel` on."""
    for k in range(end - begin):
        g = kernel[begin + k]
        re[pixel + k] += weight_re * g
        im[pixel + k] += weight_im * g


@_inline
def _sums(kernel, begin, end, start, weight_re, weight_im, re, im, pixel):
    """Return sums over a part of a row: kernel times derivative (real, imaginary), and their weighted sum times d, d^2."""
    zero = np.float32(0)
    d_re, d_im, z_d, z_dd = zero, zero, zero, zero
    for k in range(end - begin):
        g = kernel[begin + k]
        g_re, g_im = g * re[pixel + k], g * im[pixel + k]
        d_re += g_re
        d_im += g_im
        d = start + np.float32(np.int32(begin + k))
        z = d * (weight_re * g_re + weight_im * g_im)
        z_d += z
        z_dd += d * z
    return d_re, d_im, z_d, z_dd


@_jit
def render(mean, cholesky, weight, origin, step, shape, reach2, n_bands, out):
    """Write the field into `out`, (B, 2, n_elevation n_azimuth).

    Args:
        mean: Azimuth and elevation [rad], (B, N, 2).
        cholesky: Cholesky factors [rad], (1, N, 3) or (B, N, 3).
        weight: Real and imaginary part, (B, N, 2).
        origin: Elevation and azimuth of the first pixel [rad].
        step: Distance of pixels in elevation and azimuth [rad].
        shape: Number of rows and columns.
        reach2: Squared distance of the cutoff [standard deviations].
        n_bands: Number of bands of rows that threads share.
        out: Output.
    """
    n_position, n = mean.shape[0], mean.shape[1]
    n_elevation, n_azimuth = shape
    shared = cholesky.shape[0] == 1
    band = (n_elevation + n_bands - 1) // n_bands
    for task in prange(n_position * n_bands):
        kernel = np.empty(n_azimuth, np.float32)
        b = task // n_bands
        top = min((task % n_bands) * band, n_elevation)
        bottom = min(top + band, n_elevation)
        re, im = out[b, 0], out[b, 1]
        re[top * n_azimuth : bottom * n_azimuth] = np.float32(0)
        im[top * n_azimuth : bottom * n_azimuth] = np.float32(0)
        c = 0 if shared else b
        for i in range(n):
            x, y, l1, l2, l3 = _pixels(mean[b, i], cholesky[c, i], origin, step, n_azimuth)
            weight_re, weight_im = weight[b, i, 0], weight[b, i, 1]
            _, _, _, curvature, lean, steepness = _quadratic(l1, l2, l3)
            whole = np.int64(math.floor(x))
            fraction = x - whole  # in float64, because a kernel may be far narrower than a pixel
            first_row, end_row = _rows(y, l2, l3, reach2, top, bottom)
            for row in range(first_row, end_row):
                dy = np.float32(row - y)
                first, end, start = _columns(fraction, dy, curvature, lean, steepness, reach2, n_azimuth)
                if end <= first:
                    continue
                _kernel(start, end - first, BASE2 * steepness * dy * dy, BASE2 * curvature, kernel)
                column = (whole + first) % n_azimuth
                wrap = min(end - first, n_azimuth - column)
                _add(kernel, 0, wrap, weight_re, weight_im, re, im, row * n_azimuth + column)
                _add(kernel, wrap, end - first, weight_re, weight_im, re, im, row * n_azimuth)


@_jit
def render_backward(grad, mean, cholesky, weight, origin, step, shape, reach2, block, d_mean, d_cholesky, d_weight):
    """Write the gradients (B, N, 2), (B, N, 3), (B, N, 2) for `grad`, (B, 2, n_elevation n_azimuth), of the field.

    The other arguments are those of `render`; `block` is the number of primitives of a task.
    """
    n_position, n = mean.shape[0], mean.shape[1]
    n_elevation, n_azimuth = shape
    shared = cholesky.shape[0] == 1
    n_blocks = (n + block - 1) // block
    for task in prange(n_position * n_blocks):
        kernel = np.empty(n_azimuth, np.float32)
        b = task // n_blocks
        begin = (task % n_blocks) * block
        re, im = grad[b, 0], grad[b, 1]
        c = 0 if shared else b
        for i in range(begin, min(begin + block, n)):
            x, y, l1, l2, l3 = _pixels(mean[b, i], cholesky[c, i], origin, step, n_azimuth)
            weight_re, weight_im = weight[b, i, 0], weight[b, i, 1]
            inv1, inv3, shear, curvature, lean, steepness = _quadratic(l1, l2, l3)
            whole = np.int64(math.floor(x))
            fraction = x - whole  # in float64, because a kernel may be far narrower than a pixel
            d_re, d_im = 0.0, 0.0
            # Sums over the footprint of z, the kernel times its derivative, times u, v, u^2, u v, v^2.
            z_u, z_v, z_uu, z_uv, z_vv = 0.0, 0.0, 0.0, 0.0, 0.0
            first_row, end_row = _rows(y, l2, l3, reach2, 0, n_elevation)
            for row in range(first_row, end_row):
                dy = np.float32(row - y)
                first, end, start = _columns(fraction, dy, curvature, lean, steepness, reach2, n_azimuth)
                if end <= first:
                    continue
                _kernel(start, end - first, BASE2 * steepness * dy * dy, BASE2 * curvature, kernel)
                column = (whole + first) % n_azimuth
                wrap = min(end - first, n_azimuth - column)
                near = _sums(kernel, 0, wrap, start, weight_re, weight_im, re, im, row * n_azimuth + column)
                far = _sums(kernel, wrap, end - first, start, weight_re, weight_im, re, im, row * n_azimuth)
                s_re, s_im, z_d, z_dd = near[0] + far[0], near[1] + far[1], near[2] + far[2], near[3] + far[3]
                d_re += s_re
                d_im += s_im
                # Along the row u and v are linear in d: u + inv1 d, v - shear d.
                z = weight_re * s_re + weight_im * s_im
                u = lean * dy * inv1
                v = (dy - l2 * u) * inv3
                z_u += u * z + inv1 * z_d
                z_v += v * z - shear * z_d
                z_uu += u * u * z + 2 * u * inv1 * z_d + inv1 * inv1 * z_dd
                z_uv += u * v * z + (v * inv1 - u * shear) * z_d - inv1 * shear * z_dd
                z_vv += v * v * z - 2 * v * shear * z_d + shear * shear * z_dd
            d_mean[b, i, 0] = (inv1 * z_u - shear * z_v) / step[1]
            d_mean[b, i, 1] = inv3 * z_v / step[0]
            d_cholesky[b, i, 0] = (inv1 * z_uu - shear * z_uv) / step[1]
            d_cholesky[b, i, 1] = inv3 * z_uv / step[0]
            d_cholesky[b, i, 2] = inv3 * z_vv / step[0]
            d_weight[b, i, 0] = d_re
            d_weight[b, i, 1] = d_im


_first_process = cache(os.getpid)


def _threads() -> int:
    """Give numba as many threads as torch has, and return their number. Numba starts its threads at the first call."""
    if _first_process() != os.getpid():  # which lacks these threads, and OpenMP would end it
        raise InputError(
            "the compiled rasterizer does not work in a process forked from one that used it; start processes by spawn: "
            'ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
    number: int = min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(number)
    return number


def _inputs(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> tuple[Any, ...]:
    """Return the first arguments of both kernels."""
    tensors = mean, cholesky if cholesky.dim() == 3 else cholesky[None], weight
    squared = 210.0 if cutoff is None else -2 * math.log(cutoff)  # beyond, exp(-x / 2) is 0 in float32
    origin, step = (grid.elevation_start, grid.azimuth_start), (grid.elevation_step, grid.azimuth_step)
    return *(tensor.detach().contiguous().numpy() for tensor in tensors), origin, step, grid.shape, np.float32(squared)


@threads_kept()
def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return real and imaginary part of the field, (B, 2, n_elevation, n_azimuth); see `operators.field`."""
    rendered = weight.new_empty(mean.shape[0], 2, *grid.shape)
    threads = _threads()
    n_bands = 1 if mean.shape[0] >= threads else min(threads, grid.n_elevation)
    render(*_inputs(mean, cholesky, weight, grid, cutoff), n_bands, rendered.flatten(2).numpy())
    return rendered


@threads_kept()
def field_gradients(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of mean, factor and weight for a gradient (B, 2, n_elevation, n_azimuth) of the field."""
    batch, n = mean.shape[:2]
    derivatives = mean.new_empty(batch, n, 2), cholesky.new_empty(batch, n, 3), weight.new_empty(batch, n, 2)
    threads = _threads()
    block = max(1, n if batch >= threads else -(-n // threads))
    incoming = grad.detach().contiguous().flatten(2).numpy()
    inputs = _inputs(mean, cholesky, weight, grid, cutoff)
    render_backward(incoming, *inputs, block, *(derivative.numpy() for derivative in derivatives))
    d_mean, d_cholesky, d_weight = derivatives
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight
