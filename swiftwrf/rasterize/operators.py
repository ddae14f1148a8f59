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

# Modules with the functions `field`, `magnitude`, `field_gradients` and `magnitude_gradients`, imported at the first call.
BACKENDS = {"cpu": "swiftwrf.rasterize.cpu", "cuda": "swiftwrf.rasterize.cuda"}
PRIMITIVES = "Tensor mean, Tensor cholesky, Tensor weight"
OPTIONS = (
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
        raise InputError(
            f"backend {device!r} needs the package {error.name}; install it or use backend='reference'"
        ) from error


def _operator(name: str, schema: str, fake: Callable[..., Any]) -> Any:
    """Return the operator `swiftwrf::rasterize_<name>`, which calls the function `name` of the device's backend."""
    qualified_name = f"swiftwrf::rasterize_{name}"

    n_tensors = schema.partition(")")[0].count("Tensor")

    def implement(device: str) -> None:
        def call(*arguments: Any) -> Any:
            grid = AngularGrid(*arguments[n_tensors : n_tensors + 5])
            return getattr(backend_module(device), name)(*arguments[:n_tensors], grid, *arguments[n_tensors + 5 :])

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


def _empty_magnitude(*arguments):
    *_, keep_phase = arguments
    field = _empty_field(*arguments[:-1])
    return field.new_empty(field.shape[0], *field.shape[2:]), field if keep_phase else field.new_empty(
        0, *field.shape[1:]
    )


def _empty_gradients(*arguments):
    primitives = [argument for argument in arguments if isinstance(argument, Tensor)][-3:]
    return tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in primitives)


GRADIENTS = "(Tensor, Tensor, Tensor)"
_field = _operator("field", f"({PRIMITIVES}, {OPTIONS}) -> Tensor", _empty_field)
_field_gradients = _operator(
    "field_gradients", f"(Tensor grad, {PRIMITIVES}, {OPTIONS}) -> {GRADIENTS}", _empty_gradients
)
_magnitude = _operator("magnitude", f"({PRIMITIVES}, {OPTIONS}, bool keep_phase) -> (Tensor, Tensor)", _empty_magnitude)
_magnitude_gradients = _operator(
    "magnitude_gradients", f"(Tensor grad, Tensor phase, {PRIMITIVES}, {OPTIONS}) -> {GRADIENTS}", _empty_gradients
)


def _save_field(ctx, inputs, output) -> None:
    ctx.options = inputs[3:]
    ctx.save_for_backward(*inputs[:3])


def _save_magnitude(ctx, inputs, output) -> None:
    ctx.options = inputs[3:]
    ctx.save_for_backward(output[1], *inputs[:3])
    ctx.set_materialize_grads(False)  # The phase has no gradient, so no zeros are needed for it.


def _field_backward(ctx, grad):
    return *_field_gradients(grad, *ctx.saved_tensors, *ctx.options), *(None for _ in ctx.options)


def _magnitude_backward(ctx, grad, grad_phase):
    gradients = _magnitude_gradients(grad, *ctx.saved_tensors, *ctx.options[:-1])  # all options but keep_phase
    return *gradients, *(None for _ in ctx.options)


torch.library.register_autograd(_field._schema.name, _field_backward, setup_context=_save_field)
torch.library.register_autograd(_magnitude._schema.name, _magnitude_backward, setup_context=_save_magnitude)


def _arguments(grid: AngularGrid, cutoff: float | None) -> tuple[float | None, ...]:
    axes = grid.elevation_start, grid.elevation_step, grid.n_elevation, grid.azimuth_start, grid.n_azimuth
    return *axes, cutoff


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
    rendered: Tensor = _field(mean, cholesky, weight, *_arguments(grid, cutoff))
    return rendered


def magnitude(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return the magnitude of the field, (B, n_elevation, n_azimuth), with gradient 0 where the field is 0.

    If a gradient is needed, the backend keeps A / |A| for the backward pass.
    """
    keep_phase = torch.is_grad_enabled() and any(x.requires_grad for x in (mean, cholesky, weight))
    rendered: Tensor = _magnitude(mean, cholesky, weight, *_arguments(grid, cutoff), keep_phase)[0]
    return rendered
