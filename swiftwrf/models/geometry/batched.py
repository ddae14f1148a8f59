"""Fields of many candidate rooms, in the order of memory that makes their sums and scores fast.

The fields of C candidates are float32 (n, 2 K, C): at each of n positions the real parts at K elements, then the imaginary
parts, and the candidates last. `images.field` and `PhaseObservations.score` define the values.
"""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import PhaseObservations, Sequence, image_gain, images, visibility

BATCH_WAVES = 2**15  # waves that are summed at a time


def batched(field: Tensor) -> Tensor:
    """Return the field of one room, complex64 (n, K), as one candidate, (n, 2 K, 1)."""
    return torch.cat([field.real, field.imag], dim=1)[..., None]


def batched_field(
    scene: PhaseObservations, normal: Tensor, offset: Tensor, gain: Tensor, sequence: list[Sequence]
) -> Tensor:
    """Return the fields of candidates with planes (C, P, 3), offsets [m] and gains (C, P), float32 (n, 2 K, C)."""
    ray = (images(scene, normal, offset, sequence) - scene.receiver).permute(3, 1, 2, 0).float().contiguous()
    strength = image_gain(gain, sequence)[..., None] * visibility(scene, normal, offset, sequence)
    strength = strength.permute(1, 2, 0)
    size = max(1, BATCH_WAVES // max(1, ray[0, 0].numel()))  # there may be no candidates
    total = torch.zeros(())
    for some, part in zip(ray.split(size, dim=1), strength.split(size), strict=True):
        total = total + torch.view_as_real(scene.waves(some, part)).sum(1)
    return total.permute(1, 3, 0, 2).flatten(1, 2)


def batched_score(scene: PhaseObservations, field: Tensor) -> Tensor:
    """Return 1 - the mean coherence of each candidate's field (n, 2 K, C), (C,)."""
    size = field.shape[1] // 2
    real, imaginary = field[:, :size], field[:, size:]
    inverse = (real * real).addcmul_(imaginary, imaginary).clamp_min_(1e-30).rsqrt_()
    observed = scene.channel
    match = torch.cat([observed.real, -observed.imag], dim=1) @ (real * inverse)
    match += torch.cat([observed.imag, observed.real], dim=1) @ (imaginary * inverse)
    power = match.square_().unflatten(1, (2, -1)).sum(1)
    score: Tensor = 1 - power.amax(1).mean(0) / size**2
    return score
