"""How far drawn spectra are from measured ones, as the fit counts it (paper, equation of the loss)."""

from __future__ import annotations

from torch import Tensor

from swiftwrf.fitting.config import FitConfig
from swiftwrf.metrics import ssim


def spectrum_loss(drawn: Tensor, measured: Tensor, config: FitConfig) -> Tensor:
    """0.7 L1 + 0.3 (1 - SSIM) at the default weight, over spectra (B, H, W); a scalar."""
    weight, error = config.ssim_weight, drawn - measured
    pixels = error.abs() if config.pixel_loss == "l1" else error.square()
    return (1 - weight) * pixels.mean() + weight * (1 - ssim(drawn, measured).mean())
