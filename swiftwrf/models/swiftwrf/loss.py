"""The loss between predicted and measured spectra (paper, equation of the loss)."""

from __future__ import annotations

from torch import Tensor

from swiftwrf.metrics import ssim
from swiftwrf.models.swiftwrf.config import PixelLoss
from swiftwrf.runtime.validation import Fraction, checked


@checked
def spectrum_loss(
    predicted: Tensor, measured: Tensor, ssim_weight: Fraction = 0.3, pixel_loss: PixelLoss = "l1"
) -> Tensor:
    """Return (1 - w) pixel loss + w (1 - SSIM), averaged over spectra.

    Args:
        predicted: Predicted magnitudes (B, H, W).
        measured: Measured magnitudes (B, H, W).
        ssim_weight: Weight w of the SSIM term, in [0, 1].
        pixel_loss: "l1" for the absolute error, "l2" for the squared error.

    Returns:
        A scalar; differentiable.

    Raises:
        InputError: A weight or pixel loss outside its range.

    Example:
        >>> import torch
        >>> float(spectrum_loss(torch.zeros(1, 9, 9), torch.zeros(1, 9, 9)))
        0.0
    """
    error = predicted - measured
    pixels = error.abs() if pixel_loss == "l1" else error.square()
    return (1 - ssim_weight) * pixels.mean() + ssim_weight * (1 - ssim(predicted, measured).mean())
