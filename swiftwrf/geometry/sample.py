"""Draws instead of means: what a spectrum may look like, given how well the planes explain the measured ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.geometry.images import Scene, Sequence, field, image_gain, images

DIFFUSE = 8  # further paths in a draw
SEED = 0
CALIBRATION = 12  # bisections of the further paths' strength


@dataclass(frozen=True)
class Residual:
    """What the planes leave.

    Args:
        visible: share of the positions at which a reflection helps to explain the spectrum.
        direct: the same for the direct path.
        diffuse: amplitude of further paths, relative to the field of the planes.
    """

    visible: float = 1.0
    direct: float = 1.0
    diffuse: float = 0.0


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
    """One field a position, complex64 (n, K): planes (1, P, 3), (1, P) moved once for all positions within their
    covariance [m^2], each path there or not, further paths from anywhere."""
    n, k = len(scene), len(scene.element)
    direct = (torch.rand(n, 1, generator=generator) < residual.direct).float()
    total = direct * scene.wave(scene.transmitter)
    if sequence:
        root = torch.linalg.eigh(covariance)
        spread = root.eigenvectors * root.eigenvalues.clamp_min(0).sqrt()
        moved = offset + spread @ torch.randn(offset.shape[1], dtype=torch.float64, generator=generator)
        wave = scene.wave(images(scene, normal, moved, sequence))[0]
        bounces = torch.tensor([len(s) for s in sequence])
        there = torch.rand(len(sequence), n, generator=generator) < residual.visible ** bounces[:, None]
        strength = image_gain(gain, sequence)[0][:, None] * there
        total = total + (wave * strength[..., None]).sum(0)
    mean = field(scene, normal, offset, gain, sequence)[0] + scene.wave(scene.transmitter)
    scale = mean.abs().square().mean(-1, keepdim=True).sqrt()
    direction = torch.nn.functional.normalize(torch.randn(n, DIFFUSE, 3, generator=generator), dim=-1)
    amplitude = torch.complex(*torch.randn(2, n, DIFFUSE, generator=generator)) / math.sqrt(2 * DIFFUSE)
    phase = direction @ scene.element.T
    further = (amplitude[..., None] * torch.polar(torch.ones_like(phase), phase)).sum(1)
    drawn: Tensor = total + residual.diffuse * scale * further
    # a position may lose all its paths; what is left must still have a phase
    return torch.where(drawn.abs().sum(-1, keepdim=True) > 0, drawn, mean).reshape(n, k)


def residual_statistics(scene: Scene, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence]) -> Residual:
    """How often paths are there, and how strong further paths must be that draws agree with the mean as much as the
    observed channels do."""
    direct = scene.wave(scene.transmitter)
    total = direct + field(scene, normal, offset, gain, sequence)[0]
    with_all = scene.coherence(total)
    seen_direct = _share(with_all, scene.coherence(total - direct)) if sequence else 1.0
    visible = 1.0
    if sequence:
        wave = scene.wave(images(scene, normal, offset, sequence))[0] * image_gain(gain, sequence)[0][:, None, None]
        once = [row for row, s in enumerate(sequence) if len(s) == 1]
        visible = sum(_share(with_all, scene.coherence(total - wave[row])) for row in once) / len(once)
    aim = float(with_all.mean())
    low, high = 0.0, 4.0
    for _ in range(CALIBRATION):
        middle = (low + high) / 2
        generator = torch.Generator().manual_seed(SEED)
        trial = Residual(visible, seen_direct, middle)
        covariance = torch.zeros(offset.shape[1], offset.shape[1], dtype=torch.float64)
        drawn = draw(scene, normal, offset, gain, sequence, covariance, trial, generator)
        match = ((drawn / drawn.abs().clamp_min(1e-12)).conj() * (total / total.abs().clamp_min(1e-12))).mean(-1)
        low, high = (middle, high) if float(match.abs().square().mean()) > aim else (low, middle)
    return Residual(visible, seen_direct, (low + high) / 2)


def _share(with_path: Tensor, without: Tensor) -> float:
    """Positions that a path helps, of those where it matters; half of them help by chance where it is never there."""
    gain = with_path - without
    matters = gain.abs() > 0.02
    if int(matters.sum()) < 10:
        return 1.0
    helped = float((gain[matters] > 0).double().mean())
    return min(1.0, max(0.0, 2 * helped - 1))
