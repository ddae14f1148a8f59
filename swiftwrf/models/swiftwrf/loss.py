"""How far drawn spectra are from measured ones, as fits count it (paper, equation of the loss)."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from swiftwrf.metrics import ssim


def spectrum_loss(
    drawn: Tensor, measured: Tensor, ssim_weight: float = 0.3, pixel_loss: Literal["l1", "l2"] = "l1"
) -> Tensor:
    """0.7 L1 + 0.3 (1 - SSIM) at the default weight, over spectra (B, H, W); a scalar."""
    error = drawn - measured
    pixels = error.abs() if pixel_loss == "l1" else error.square()
    return (1 - ssim_weight) * pixels.mean() + ssim_weight * (1 - ssim(drawn, measured).mean())
