"""|A| of a rasterized spectrum, with gradient 0 where A = 0."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
# (the signatures of autograd functions are torch's)

from __future__ import annotations

import torch
from torch import Tensor


class _Magnitude(torch.autograd.Function):
    """One pass each way; torch's vector norm over a strided dimension costs more than drawing the spectrum."""

    @staticmethod
    def forward(ctx, field):
        magnitude = torch.hypot(*field.unbind(-3))
        ctx.save_for_backward(field, magnitude)
        return magnitude

    @staticmethod
    def backward(ctx, grad):
        field, magnitude = ctx.saved_tensors
        scale = torch.where(magnitude > 0, grad / magnitude, torch.zeros_like(grad))
        return field * scale.unsqueeze(-3)


def magnitude(field: Tensor) -> Tensor:
    """Magnitude (..., H, W) of real and imaginary part (..., 2, H, W); differentiable, with gradient 0 where it is 0."""
    result: Tensor = _Magnitude.apply(field)
    return result
