"""Operators of torch for the fast backends: one schema, one kernel per device, gradients, and shapes for torch.compile.

The functions of `torch.library` register them in place of its `custom_op`. An operator of `custom_op` imports torch's
compiler at its first call, which takes longer than most fits of RSSI.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
# (torch does not type the context of autograd)

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError

# Modules with the functions `field` and `field_gradients`, imported at the first call.
BACKENDS = {"cpu": "swiftwrf.rasterize.cpu", "cuda": "swiftwrf.rasterize.cuda"}
ARGUMENTS = (
    "Tensor mean, Tensor cholesky, Tensor weight, "
    "float elevation_start, float elevation_step, int n_elevation, float azimuth_start, int n_azimuth, float? cutoff"
)


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


def _operator(name: str, schema: str, fake: Callable[..., Any]) -> Any:
    """Return the operator `swiftwrf::rasterize_<name>`, which calls the function `name` of the device's backend."""
    qualified_name = f"swiftwrf::rasterize_{name}"

    def implement(device: str) -> None:
        def call(*arguments: Any) -> Any:
            *tensors_and_axes, cutoff = arguments
            tensors, axes = tensors_and_axes[:-5], tensors_and_axes[-5:]
            return getattr(backend_module(device), name)(*tensors, AngularGrid(*axes), cutoff)

        torch.library.impl(qualified_name, device, call)

    torch.library.define(qualified_name, schema, tags=torch.Tag.pt2_compliant_tag)
    for device in BACKENDS:
        implement(device)
    torch.library.register_fake(qualified_name, fake)
    return getattr(torch.ops.swiftwrf, f"rasterize_{name}").default


def _empty_field(
    mean, cholesky, weight, elevation_start, elevation_step, n_elevation, azimuth_start, n_azimuth, cutoff
):
    return mean.new_empty(mean.shape[0], 2, n_elevation, n_azimuth)


def _empty_gradients(grad, *arguments):
    return tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in arguments[:3])


_field = _operator("field", f"({ARGUMENTS}) -> Tensor", _empty_field)
_gradients = _operator("field_gradients", f"(Tensor grad, {ARGUMENTS}) -> (Tensor, Tensor, Tensor)", _empty_gradients)


def _save(ctx, inputs, output) -> None:
    ctx.options = inputs[3:]
    ctx.save_for_backward(*inputs[:3])


def _backward(ctx, grad):
    return *_gradients(grad, *ctx.saved_tensors, *ctx.options), *(None for _ in ctx.options)


torch.library.register_autograd(_field._schema.name, _backward, setup_context=_save)


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
    axes = grid.elevation_start, grid.elevation_step, grid.n_elevation, grid.azimuth_start, grid.n_azimuth
    rendered: Tensor = _field(mean, cholesky, weight, *axes, cutoff)
    return rendered
