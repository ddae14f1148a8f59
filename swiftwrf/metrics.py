"""Errors of spectra and angles as the papers of this field define them, and the factor of calibrated intervals.

SSIM is scikit-image's default (7 x 7 uniform window, sample covariance, borders cropped) with data_range 1; PSNR is
10 log10(1 / MSE) of each spectrum. Other conventions move SSIM by up to 0.07, so tables name this one.
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.angles import angular_distance, to_direction, wrap
from swiftwrf.errors import InputError

WINDOW = 7
LEVEL = 0.8  # probability of every interval and region that held-out places calibrate
HALF_WIDTH = NormalDist().inv_cdf((1 + LEVEL) / 2)  # of the interval of a normal variable, in standard deviations


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # what is kept must also serve calls that await gradients
def _window_mean(size: int, width: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Banded matrix (size - 6, size) that averages 7 neighbours: two products replace a convolution, 15 times faster."""
    rows = size - width + 1
    offset = torch.arange(size, device=device) - torch.arange(rows, device=device)[:, None]
    return ((offset >= 0) & (offset < width)).to(dtype) / width


def too_small(shape: tuple[int, int]) -> bool:
    """Return True if `ssim` is not defined for images of this height and width.

    Example:
        >>> too_small((1, 72)), too_small((2, 72)), too_small((7, 6))
        (False, True, True)
    """
    return 1 < shape[0] < WINDOW or shape[1] < WINDOW


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the structural similarity of each pair of images (..., H, W) in [0, 1], differentiable, (...).

    Equal to `skimage.metrics.structural_similarity(a, b, data_range=1)`. Images of one row have a window of 1 x 7.

    Raises:
        InputError: Images smaller than the window.

    Example:
        >>> image = torch.rand(2, 30, 120)
        >>> ssim(image, image)
        tensor([1., 1.])
    """
    height, width = a.shape[-2:]
    if too_small((height, width)):
        raise InputError(
            f"SSIM needs images of at least {WINDOW} x {WINDOW} pixels or of a row of {WINDOW}, got {height} x {width}"
        )
    window = min(height, WINDOW)
    down = _window_mean(height, window, a.device, a.dtype)
    across = _window_mean(width, WINDOW, a.device, a.dtype).T

    mean_a, mean_b, aa, bb, ab = (down @ x @ across for x in (a, b, a * a, b * b, a * b))
    sample = window * WINDOW / (window * WINDOW - 1)
    variance_a, variance_b = sample * (aa - mean_a * mean_a), sample * (bb - mean_b * mean_b)
    covariance = sample * (ab - mean_a * mean_b)
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a * mean_a + mean_b * mean_b + c1) * (variance_a + variance_b + c2)
    )
    return similarity.mean(dim=(-2, -1))


def spectrum_loss(predicted: Tensor, measured: Tensor, ssim_weight: float = 0.3) -> Tensor:
    """Return (1 - w) L1 + w (1 - SSIM), averaged over spectra: the loss of the paper.

    Args:
        predicted: Predicted magnitudes (B, H, W).
        measured: Measured magnitudes (B, H, W).
        ssim_weight: Weight w of the SSIM term, in [0, 1].

    Returns:
        A scalar; differentiable.

    Example:
        >>> float(spectrum_loss(torch.zeros(1, 9, 9), torch.zeros(1, 9, 9)))
        0.0
    """
    pixels = (predicted - measured).abs().mean()
    return (1 - ssim_weight) * pixels + ssim_weight * (1 - ssim(predicted, measured).mean())


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Return 10 log10(1 / MSE) of each pair of images (..., H, W) in [0, 1] [dB], (...).

    Example:
        >>> round(float(psnr(torch.zeros(9, 9), torch.full((9, 9), 0.1))))
        20
    """
    return -10 * torch.log10((a - b).square().mean(dim=(-2, -1)).clamp_min(1e-20))


def l1(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean absolute difference of each pair of images (..., H, W), (...).

    Example:
        >>> float(l1(torch.zeros(9, 9), torch.full((9, 9), 0.5)))
        0.5
    """
    return (a - b).abs().mean(dim=(-2, -1))


def covered(mean: Tensor, std: Tensor, measured: Tensor) -> Tensor:
    """Return the fraction of the pixels of each spectrum (..., H, W) inside their 80 % intervals, (...).

    It is 0.8 if the standard deviations are right.

    Example:
        >>> measured = torch.randn(100, 100, generator=torch.Generator().manual_seed(0))
        >>> round(float(covered(torch.zeros(100, 100), torch.ones(100, 100), measured)), 1)
        0.8
    """
    return ((mean - measured).abs() <= HALF_WIDTH * std).float().mean(dim=(-2, -1))


def interval_factor(score: Tensor, place: Tensor) -> float:
    """Return the factor of 80 % intervals or regions with which they contain 80 % of the values at new places.

    Places are exchangeable, rows of one place are not. So all places have equal weight, and one more, the new one, has
    scores above all others (hierarchical conformal prediction: Y. Lee, R. F. Barber and R. Willett, arXiv:2306.06342, 2023).
    With one row a place the factor is number ceil(0.8 (n + 1)) of n ascending scores, or the last one if there are fewer.

    Args:
        score: Errors of held-out rows relative to the half-widths of their intervals, or to the radii of their regions,
            (n, ...). Those that are not finite have no part.
        place: Number of the place of each row, int64 (n,).

    Example:
        >>> interval_factor(torch.arange(1.0, 10.0), torch.arange(9))
        8.0
    """
    score = score.reshape(len(score), -1)
    usable = score.isfinite()
    count = place.bincount(usable.sum(dim=1).double())
    value, order = score[usable].sort()
    weight = (1 / count[place])[:, None].expand_as(score)[usable][order]
    needed = LEVEL * (int((count > 0).sum()) + 1) - 1e-9
    return float(value[(weight.cumsum(dim=0) < needed).sum().clamp_max(len(value) - 1)])


def angle_errors(estimate: Tensor | NDArray[np.floating], truth: Tensor | NDArray[np.floating]) -> dict[str, Tensor]:
    """Return absolute errors (n,) [rad] of azimuth (modulo 2 pi) and elevation, and the angular error (great-circle).

    Args:
        estimate: Estimated azimuth and elevation [rad], tensor or array (n, 2).
        truth: True azimuth and elevation [rad], tensor or array (n, 2).

    Example:
        >>> errors = angle_errors(torch.tensor([[0.1, 0.0]]), torch.tensor([[6.2, 0.0]]))
        >>> round(float(errors["azimuth"]), 2), round(float(errors["great_circle"]), 2)
        (0.18, 0.18)
    """
    estimated, true = (torch.as_tensor(given, dtype=torch.float64) for given in (estimate, truth))
    return {
        "azimuth": wrap(estimated[:, 0] - true[:, 0]).abs(),
        "elevation": (estimated[:, 1] - true[:, 1]).abs(),
        "great_circle": angular_distance(to_direction(*estimated.unbind(-1)), to_direction(*true.unbind(-1))),
    }
