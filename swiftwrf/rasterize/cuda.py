"""The fast maker for NVIDIA GPUs: `rasterize.cu`, compiled at first use and launched on torch's current stream.

The kernels take angles and factors in radians and bring them to pixels themselves, because a chain of float64 tensors here
would cost as much memory traffic as drawing does. Nothing waits for the device, so calls can be captured in CUDA graphs
once the kernels have been built.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
# (the signatures of autograd functions are torch's)

from __future__ import annotations

import ctypes
import math
import warnings
from collections.abc import Callable
from ctypes import c_float, c_int, c_void_p
from dataclasses import astuple
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.rasterize.nvrtc import CudaUnavailable, Kernels

SOURCE = Path(__file__).with_name("rasterize.cu")

# as in rasterize.cu
_THREADS, _WARPS, _LANES = 256, 8, 32
_TILE_COLUMNS, _TILE_ROWS = 16, 8


class _Axis(ctypes.Structure):
    _fields_ = (("scale", c_float), ("scale_rest", c_float), ("start", c_float), ("start_rest", c_float))

    @classmethod
    def of(cls, start: float, step: float) -> _Axis:
        """pixel = angle * scale - start, each as a float32 and what it leaves; `start` a multiple of 1/2."""
        scale, pixels = 1 / step, start / step
        halves = round(2 * pixels) / 2
        return cls(scale, scale - c_float(scale).value, halves, pixels - halves)


class _Grid(ctypes.Structure):
    _fields_ = (("azimuth", _Axis), ("elevation", _Axis), ("n_azimuth", c_int), ("n_elevation", c_int))

    @classmethod
    def of(cls, grid: AngularGrid) -> _Grid:
        azimuth = _Axis.of(grid.azimuth_start, grid.azimuth_step)
        return cls(azimuth, _Axis.of(grid.elevation_start, grid.elevation_step), grid.n_azimuth, grid.n_elevation)


class _Cutoff(ctypes.Structure):
    _fields_ = (("least", c_float), ("reach", c_float))

    @classmethod
    def of(cls, cutoff: float | None) -> _Cutoff:
        # with subnormals flushed, float32 has nothing but zero below 2^-126
        least = -126.0 if cutoff is None else math.log2(cutoff)
        return cls(least, math.sqrt(-2 * math.log(2) * least))


@cache
def kernels(device: torch.device) -> Kernels:
    """The kernels, built for the GPU at its first use and kept.

    Raises:
        CudaUnavailable: no driver, no NVRTC, or a GPU too old.
    """
    return Kernels(SOURCE.read_text(), device)


def _constant(function: Callable[[torch.device], bool]) -> Callable[[torch.device], bool]:
    """Asked while torch.compile traces, it is not traced itself. To say so imports torch's compiler, a third of what it
    takes to import this package: not where no GPU can be asked about."""
    return torch.compiler.assume_constant_result(function) if torch.cuda.is_available() else function


@_constant
def available(device: torch.device) -> bool:
    """Whether the kernels can be built for the GPU; warns, once, where they cannot."""
    return _available(device)


@cache
def _available(device: torch.device) -> bool:
    try:
        kernels(device)
    except CudaUnavailable as error:
        warnings.warn(f"drawing with the slow maker 'reference': {error}", stacklevel=2)
        return False
    return True


def _checked(*tensors: Tensor) -> list[Tensor]:
    """The tensors as the kernels read them: float32, contiguous, pairs of floats aligned."""
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device != tensors[0].device:
            raise InputError(f"expected float32 tensors on {tensors[0].device}, got {tensor.dtype} on {tensor.device}")
    ready = (tensor.contiguous() for tensor in tensors)
    return [tensor if tensor.data_ptr() % 8 == 0 else tensor.clone() for tensor in ready]


def _pointer(tensor: Tensor | None) -> c_void_p:
    return c_void_p(tensor.data_ptr() if tensor is not None and tensor.numel() else None)


def _draw(
    mean: Tensor, cholesky: Tensor, weight: Tensor,
    elevation_start: float, elevation_step: float, n_elevation: int, azimuth_start: float, n_azimuth: int,
    cutoff: float | None,
) -> Tensor:  # fmt: skip
    field = mean.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)
    grid = AngularGrid(elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth)
    _launch(mean, cholesky, weight, grid, cutoff, field, None)
    return field


def _draw_magnitude(
    mean: Tensor, cholesky: Tensor, weight: Tensor,
    elevation_start: float, elevation_step: float, n_elevation: int, azimuth_start: float, n_azimuth: int,
    cutoff: float | None, keep_phase: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """|A|, and A / |A| for the backward pass, empty where it is not kept."""
    batch = mean.shape[0]
    magnitude = mean.new_empty(batch, n_elevation, n_azimuth)
    phase = mean.new_empty(batch if keep_phase else 0, 2, n_elevation, n_azimuth)
    grid = AngularGrid(elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth)
    _launch(mean, cholesky, weight, grid, cutoff, phase, magnitude)
    return magnitude, phase


def _launch(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None,
    field: Tensor, magnitude: Tensor | None,
) -> None:  # fmt: skip
    """Draws into field and magnitude."""
    batch, n = mean.shape[:2]
    if not batch:
        return
    mean, cholesky, weight = _checked(mean, cholesky, weight)
    common = c_int(n), c_int(cholesky.dim() == 3), _Grid.of(grid), _Cutoff.of(cutoff)
    across, down = -(-grid.n_azimuth // _TILE_COLUMNS), -(-grid.n_elevation // _TILE_ROWS)
    words = -(-n // _LANES)
    reached = torch.empty(batch, across + down, words, dtype=torch.int32, device=mean.device)
    launch = kernels(mean.device).launch
    if n:
        launch(
            "find_reach", batch * -(-words // _WARPS), _THREADS,
            _pointer(mean), _pointer(cholesky), _pointer(reached), *common,
        )  # fmt: skip
    launch(
        "rasterize", -(-batch * across * down // _WARPS), _THREADS,
        *(_pointer(x) for x in (mean, cholesky, weight, reached, field, magnitude)), c_int(batch), *common,
    )  # fmt: skip


def _draw_backward(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor,
    elevation_start: float, elevation_step: float, n_elevation: int, azimuth_start: float, n_azimuth: int,
    cutoff: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    grid = AngularGrid(elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth)
    return _gather("rasterize_backward", [grad], mean, cholesky, weight, grid, cutoff)


def _draw_magnitude_backward(
    grad: Tensor, phase: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor,
    elevation_start: float, elevation_step: float, n_elevation: int, azimuth_start: float, n_azimuth: int,
    cutoff: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    grid = AngularGrid(elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth)
    return _gather("magnitude_backward", [grad, phase], mean, cholesky, weight, grid, cutoff)


def _gather(
    kernel: str, incoming: list[Tensor], mean: Tensor, cholesky: Tensor, weight: Tensor,
    grid: AngularGrid, cutoff: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients by mean, Cholesky factor and weight from those that come in."""
    *incoming, mean, cholesky, weight = _checked(*incoming, mean, cholesky, weight)
    batch, n = mean.shape[:2]
    d_mean, d_weight = torch.empty_like(mean), torch.empty_like(weight)
    d_cholesky = cholesky.new_empty(batch, n, 3)
    if mean.numel():
        # threads for a primitive: about as many as its footprint has columns where N primitives share the grid
        pixels = grid.n_elevation * grid.n_azimuth / n
        group = 8 if pixels < 10 else 16 if pixels < 60 else 32
        kernels(mean.device).launch(
            kernel, batch * -(-n * group // _THREADS), _THREADS,
            *(_pointer(x) for x in (*incoming, mean, cholesky, weight, d_mean, d_cholesky, d_weight)),
            c_int(n), c_int(group), c_int(cholesky.dim() == 3), _Grid.of(grid), _Cutoff.of(cutoff),
        )  # fmt: skip
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


def _operator(name: str, function: Callable[..., Any]) -> Any:
    return torch.library.custom_op(f"swiftwrf::{name}", function, mutates_args=(), device_types="cuda")


_rasterize = _operator("rasterize_cuda", _draw)
_rasterize_backward = _operator("rasterize_cuda_backward", _draw_backward)
_magnitude = _operator("magnitude_cuda", _draw_magnitude)
_magnitude_backward = _operator("magnitude_cuda_backward", _draw_magnitude_backward)


@_rasterize.register_fake
def _(mean, cholesky, weight, elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth, cutoff):
    return mean.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)


@_magnitude.register_fake
def _(
    mean, cholesky, weight, elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth, cutoff, keep_phase
):
    batch = mean.shape[0]
    phase = mean.new_empty(batch if keep_phase else 0, 2, n_elevation, n_azimuth)
    return mean.new_empty(batch, n_elevation, n_azimuth), phase


@_rasterize_backward.register_fake
def _(grad, mean, cholesky, weight, *settings):
    return tuple(x.new_empty(x.shape) for x in (mean, cholesky, weight))


@_magnitude_backward.register_fake
def _(grad, phase, mean, cholesky, weight, *settings):
    return tuple(x.new_empty(x.shape) for x in (mean, cholesky, weight))


def _keep_inputs(ctx, inputs, output) -> None:
    mean, cholesky, weight, *ctx.settings = inputs
    ctx.save_for_backward(mean, cholesky, weight)


def _keep_inputs_and_phase(ctx, inputs, output) -> None:
    mean, cholesky, weight, *ctx.settings = inputs
    ctx.save_for_backward(output[1], mean, cholesky, weight)
    ctx.set_materialize_grads(False)  # no zeros for the phase, which nobody differentiates


def _backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
    return (*_rasterize_backward(grad, *ctx.saved_tensors, *ctx.settings), *(None for _ in ctx.settings))


def _backward_magnitude(ctx, grad: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
    gradients = _magnitude_backward(grad, *ctx.saved_tensors, *ctx.settings[:-1])  # all but keep_phase
    return (*gradients, *(None for _ in ctx.settings))


_rasterize.register_autograd(_backward, setup_context=_keep_inputs)
_magnitude.register_autograd(_backward_magnitude, setup_context=_keep_inputs_and_phase)


def rasterize(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """See `swiftwrf.rasterize`: mean (B, N, 2), cholesky (N, 3) or (B, N, 3), weight (B, N, 2), all float32 on one GPU,
    to (B, 2, n_elevation, n_azimuth)."""
    drawn: Tensor = _rasterize(mean, cholesky, weight, *astuple(grid), cutoff)
    return drawn


def magnitude(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """See `swiftwrf.rasterize.rasterize_magnitude`: as `rasterize`, to (B, n_elevation, n_azimuth) without the field ever
    being written. Where a gradient will be asked for, A / |A| is kept: with it the backward pass needs no root a
    primitive and pixel."""
    keep_phase = torch.is_grad_enabled() and any(x.requires_grad for x in (mean, cholesky, weight))
    drawn: Tensor = _magnitude(mean, cholesky, weight, *astuple(grid), cutoff, keep_phase)[0]
    return drawn
