"""Draws instead of means: what a spectrum may look like, given how well the planes explain the measured ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import Scene, Sequence, field, image_gain, images, visibility
from swiftwrf.runtime.validation import Fraction, NonNegativeFloat, configuration

DIFFUSE = 8  # further paths in a draw
SEED = 0
CALIBRATION = 12  # bisections of the further paths' strength


@configuration
class Residual:
    """Statistics of the paths that the planes do not predict.

    Args:
        direct: Fraction of the positions with a line of sight.
        diffuse: Amplitude of diffuse paths, relative to the sum of the direct and the reflected paths.
    """

    direct: Fraction = 1.0
    diffuse: NonNegativeFloat = 0.0


def draw(
    scene: Scene,
    normal: Tensor,
    offset: Tensor,
    gain: Tensor,
    sequence: list[Sequence],
    covariance: Tensor,
    residual: Residual,
    generator: torch.Generator,
) -> Tensor:
    """One field a position, complex64 (n, K): planes (1, P, 3), (1, P) moved once a call within their covariance
    [m^2], each path there or not, further paths from anywhere."""
    n, k = len(scene), len(scene.element)
    direct = (torch.rand(n, 1, generator=generator) < residual.direct).float()
    total = direct * scene.wave(scene.transmitter)
    if sequence:
        root = torch.linalg.eigh(covariance)
        # the symmetric root, which does not turn with eigenvectors that rounding turns
        spread = (root.eigenvectors * root.eigenvalues.clamp_min(0).sqrt()) @ root.eigenvectors.T
        moved = offset + spread @ torch.randn(offset.shape[1], dtype=torch.float64, generator=generator)
        source = images(scene, normal, moved, sequence)
        wave = scene.wave(source)[0] * visibility(scene, normal, moved, sequence)[0, ..., None]
        full, share = _visibility(gain)
        there = torch.rand(len(sequence), n, generator=generator) < image_gain(share, sequence)[0][:, None]
        strength = image_gain(full, sequence)[0][:, None] * there
        total = total + (wave * strength[..., None]).sum(0)
    mean = scene.wave(scene.transmitter) + field(scene, normal, offset, gain, sequence)[0]
    scale = mean.abs().square().mean(-1, keepdim=True).sqrt()
    direction = torch.nn.functional.normalize(torch.randn(n, DIFFUSE, 3, generator=generator), dim=-1)
    amplitude = torch.complex(*torch.randn(2, n, DIFFUSE, generator=generator)) / math.sqrt(2 * DIFFUSE)
    phase = direction @ scene.element.T
    further = (amplitude[..., None] * torch.polar(torch.ones_like(phase), phase)).sum(1)
    drawn: Tensor = total + residual.diffuse * scale * further
    # a position may lose all its paths; what is left must still have a phase
    return torch.where(drawn.abs().sum(-1, keepdim=True) > 0, drawn, mean).reshape(n, k)


def _visibility(gain: Tensor) -> tuple[Tensor, Tensor]:
    """Gains (1, P) split into what a plane reflects and how often it does: all planes are taken to reflect like the
    stronger ones, and the weaker to be hidden at times, which a fitted gain cannot tell apart."""
    full = gain.abs().flatten().sort().values[len(gain.flatten()) // 2 :].median().clamp_min(1e-6)
    share = (gain.abs() / full).clamp_max(1)
    return gain / share.clamp_min(1e-6), share


def residual_statistics(
    scene: Scene, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence], direct: float
) -> Residual:
    """How strong further paths must be that draws agree with the mean as much as the observed channels do.

    Args:
        direct: share of the positions with a line of sight.
    """
    mean = scene.wave(scene.transmitter) + field(scene, normal, offset, gain, sequence)[0]
    aim, phase = float(scene.coherence(mean).mean()), mean.sgn()
    still = torch.zeros(offset.shape[1], offset.shape[1], dtype=torch.float64)
    low, high = 0.0, 4.0
    for _ in range(CALIBRATION):
        middle = (low + high) / 2
        generator = torch.Generator().manual_seed(SEED)
        drawn = draw(scene, normal, offset, gain, sequence, still, Residual(direct, middle), generator)
        match = (drawn.sgn().conj() * phase).mean(-1).abs().square().mean()
        low, high = (middle, high) if float(match) > aim else (low, middle)
    return Residual(direct, (low + high) / 2)
