"""Magnitude |A| of a rasterized field, with gradient 0 where A = 0."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
# (torch does not type the signatures of autograd functions)

from __future__ import annotations

import torch
from torch import Tensor


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
