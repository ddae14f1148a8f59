"""Random channels whose deviation from the prediction is that of the observed channels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import PhaseObservations, Sequence, field, image_gain, images, visibility
from swiftwrf.runtime.validation import Fraction, NonNegativeFloat, configuration

N_DIFFUSE_PATHS = 8
N_BISECTIONS = 12  # of the amplitude of the diffuse paths
CALIBRATION_SEED = 0


@configuration
class Residual:
    """Statistics of the paths that the planes do not predict.

    Args:
        direct: Fraction of the positions with a line of sight.
        diffuse: Amplitude of diffuse paths, relative to the sum of the direct and the reflected paths.
    """

    direct: Fraction = 1.0
    diffuse: NonNegativeFloat = 0.0


def sample_field(
    scene: PhaseObservations,
    normal: Tensor,
    offset: Tensor,
    gain: Tensor,
    sequence: list[Sequence],
    covariance: Tensor,
    residual: Residual,
    generator: torch.Generator,
) -> Tensor:
    """Return one random field for each position, complex64 (n, K).

    Planes (1, P, 3), (1, P) are moved once a call within their covariance [m^2]. Each path exists at random, and diffuse
    paths arrive from random directions.
    """
    n, k = len(scene), len(scene.element)
    direct = (torch.rand(n, 1, generator=generator) < residual.direct).float()
    total = direct * scene.wave(scene.transmitter)
    if sequence:
        root = torch.linalg.eigh(covariance)
        # the symmetric root does not depend on the eigenvectors of equal eigenvalues, which follow rounding
        spread = (root.eigenvectors * root.eigenvalues.clamp_min(0).sqrt()) @ root.eigenvectors.T
        moved = offset + spread @ torch.randn(offset.shape[1], dtype=torch.float64, generator=generator)
        source = images(scene, normal, moved, sequence)
        wave = scene.wave(source)[0] * visibility(scene, normal, moved, sequence)[0, ..., None]
        full, share = _split_gain(gain)
        exists = torch.rand(len(sequence), n, generator=generator) < image_gain(share, sequence)[0][:, None]
        strength = image_gain(full, sequence)[0][:, None] * exists
        total = total + (wave * strength[..., None]).sum(0)
    mean = scene.wave(scene.transmitter) + field(scene, normal, offset, gain, sequence)[0]
    scale = mean.abs().square().mean(-1, keepdim=True).sqrt()
    direction = torch.nn.functional.normalize(torch.randn(n, N_DIFFUSE_PATHS, 3, generator=generator), dim=-1)
    amplitude = torch.complex(*torch.randn(2, n, N_DIFFUSE_PATHS, generator=generator)) / math.sqrt(2 * N_DIFFUSE_PATHS)
    phase = direction @ scene.element.T
    diffuse = (amplitude[..., None] * torch.polar(torch.ones_like(phase), phase)).sum(1)
    drawn: Tensor = total + residual.diffuse * scale * diffuse
    # the field of a position without any path would have no phase
    return torch.where(drawn.abs().sum(-1, keepdim=True) > 0, drawn, mean).reshape(n, k)


def _split_gain(gain: Tensor) -> tuple[Tensor, Tensor]:
    """Split gains (1, P) into a reflection gain and the fraction of positions at which the plane reflects.

    A fitted gain determines only their product. All planes are assumed to reflect like the stronger ones.
    """
    full = gain.abs().flatten().sort().values[len(gain.flatten()) // 2 :].median().clamp_min(1e-6)
    share = (gain.abs() / full).clamp_max(1)
    return gain / share.clamp_min(1e-6), share


def residual_statistics(
    scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence], direct: float
) -> Residual:
    """Return the statistics with which samples have the same coherence with the prediction as the observed channels.

    Args:
        scene: Observed phases.
        normal: Normals of the planes (1, P, 3).
        offset: Offsets of the planes (1, P) [m].
        gain: Gains of the planes (1, P).
        sequence: Sequences of reflections.
        direct: Fraction of the positions with a line of sight.
    """
    mean = scene.wave(scene.transmitter) + field(scene, normal, offset, gain, sequence)[0]
    aim, phase = float(scene.coherence(mean).mean()), mean.sgn()
    still = torch.zeros(offset.shape[1], offset.shape[1], dtype=torch.float64)
    low, high = 0.0, 4.0
    for _ in range(N_BISECTIONS):
        middle = (low + high) / 2
        generator = torch.Generator().manual_seed(CALIBRATION_SEED)
        drawn = sample_field(scene, normal, offset, gain, sequence, still, Residual(direct, middle), generator)
        match = (drawn.sgn().conj() * phase).mean(-1).abs().square().mean()
        low, high = (middle, high) if float(match) > aim else (low, middle)
    return Residual(direct, (low + high) / 2)
