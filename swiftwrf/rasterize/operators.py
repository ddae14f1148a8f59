"""Autograd functions of the rasterizer: the field by the fast backend of a device, and its magnitude."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
# (torch does not type the signatures of autograd functions)

from __future__ import annotations

from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError

# Modules with the functions `field` and `field_gradients`, "cuda" also `magnitude`, imported at the first call.
BACKENDS = {"cpu": "swiftwrf.contrib.rasterize.cpu", "cuda": "swiftwrf.contrib.rasterize.cuda"}


def backend_module(device: str) -> ModuleType:
    """Return the module of the fast backend of a device type.

    Raises:
        InputError: A package that the backend needs is missing.
    """
    try:
        return import_module(BACKENDS[device])
    except ModuleNotFoundError as error:
        remedy = "pip install 'swiftwrf-tasks[paper]'" if error.name == "numba" else "install it"
        raise InputError(
            f"backend {device!r} needs the package {error.name}; {remedy}, or use backend='reference'"
        ) from error


class _Field(torch.autograd.Function):
    @staticmethod
    def forward(ctx, mean, cholesky, weight, grid, cutoff):
        ctx.backend, ctx.options = backend_module(mean.device.type), (grid, cutoff)
        ctx.save_for_backward(mean, cholesky, weight)
        return ctx.backend.field(mean, cholesky, weight, *ctx.options)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return *ctx.backend.field_gradients(grad, *ctx.saved_tensors, *ctx.options), None, None


def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return the field of primitives by the fast backend of the tensors' device, differentiable.

    Args:
        mean: Azimuth and elevation [rad], float32, (B, N, 2).
        cholesky: Cholesky factors [rad], (N, 3) or (B, N, 3).
        weight: Real and imaginary part, (B, N, 2).
        grid: Directions to render.
        cutoff: Least kernel value, or None.

    Returns:
        Real and imaginary part, (B, 2, n_elevation, n_azimuth).
    """
    rendered: Tensor = _Field.apply(mean, cholesky, weight, grid, cutoff)
    return rendered


class _FieldMagnitude(torch.autograd.Function):
    @staticmethod
    def forward(ctx, mean, cholesky, weight, grid, cutoff):
        ctx.backend, ctx.options = backend_module(mean.device.type), (grid, cutoff)
        keep_phase = any(ctx.needs_input_grad)
        rendered, phase = ctx.backend.magnitude(mean, cholesky, weight, grid, cutoff, keep_phase)
        ctx.save_for_backward(mean, cholesky, weight, phase)
        return rendered

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        *primitives, phase = ctx.saved_tensors
        return *ctx.backend.field_gradients(grad, *primitives, *ctx.options, phase), None, None


def field_magnitude(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return |A|, (B, n_elevation, n_azimuth), from the arguments of `field`, differentiable. Only for CUDA.

    The kernels draw it in one pass over memory: with `magnitude` after `field`, rendering takes a quarter longer on an H100.
    """
    rendered: Tensor = _FieldMagnitude.apply(mean, cholesky, weight, grid, cutoff)
    return rendered


class _Magnitude(torch.autograd.Function):
    """A pass forward and a pass backward: faster than torch's vector norm and absolute value of complex numbers."""

    @staticmethod
    def forward(ctx, field):
        magnitude = torch.hypot(*field.unbind(-3))
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(field / torch.where(magnitude == 0, 1.0, magnitude).unsqueeze(-3))
        return magnitude

    @staticmethod
    def backward(ctx, grad):
        (phase,) = ctx.saved_tensors
        return grad.unsqueeze(-3) * phase


def magnitude(field: Tensor) -> Tensor:
    """Return |A|, differentiable, with gradient 0 where A = 0.

    Args:
        field: Real and imaginary part of A, (..., 2, n_elevation, n_azimuth).

    Returns:
        Magnitude, (..., n_elevation, n_azimuth).

    Example:
        >>> import torch
        >>> magnitude(torch.tensor([3.0, 4.0]).reshape(2, 1, 1)).item()
        5.0
    """
    result: Tensor = _Magnitude.apply(field)
    return result
