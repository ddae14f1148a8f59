"""Channels that a room predicts at positions and subcarriers, and how well they agree with measured ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import LinkAt, PlaneSet, images, visibility


def coherence(observed: Tensor, predicted: Tensor) -> Tensor:
    """Return |x^H h|^2 / (|x|^2 |h|^2) of channels (n, F, K), with an unknown phase of each of the F snapshots, (n,)."""
    match = (observed.conj() * predicted).sum(-1).abs().square().sum(-1)
    power = (observed.abs().square().sum(-1) * predicted.abs().square().sum(-1)).sum(-1)
    value: Tensor = match / power.clamp_min(1e-30)
    return value


def ends(number: int) -> list[int]:
    """Return the numbers of the first and the last of some snapshots."""
    return sorted({0, number - 1})


def superposed(gain: Tensor, wave: Tensor) -> Tensor:
    """Return the sums of waves (n, 1 + S, F, K) with gains (n, 1 + S), complex64 (n, F, K)."""
    total: Tensor = (gain.to(wave.dtype)[:, None] @ wave.flatten(2))[:, 0].unflatten(1, wave.shape[2:])
    return total


def waves(planes: PlaneSet, scene: LinkAt, frequency: Tensor) -> Tensor:
    """Return the waves of the direct path and of each image, complex64 (n, 1 + S, F, K).

    Args:
        planes: Planes of one room.
        scene: Positions.
        frequency: Frequencies relative to the carrier, (F,).
    """
    there = torch.ones(1, 1)
    if planes.sequence:
        exists = visibility(scene, planes)[0]
        there = torch.cat([torch.ones_like(exists[:1]), exists])
    return (scene.waves(sources(planes, scene), frequency) * there[..., None, None]).transpose(0, 1)


def sources(planes: PlaneSet, scene: LinkAt) -> Tensor:
    """Return the transmitter and its images in the planes of one room, float64 (1 + S, n or 1, 3) [m]."""
    direct = scene.transmitter[None]
    return torch.cat([direct, images(scene, planes)[0]]) if planes.sequence else direct


@dataclass(frozen=True, eq=False)
class Channels:
    """Measured channels at n positions.

    Args:
        scene: Positions.
        value: Channels of F snapshots, complex64 (n, F, K).
        frequency: Their frequencies relative to the carrier, (F,).
    """

    scene: LinkAt
    value: Tensor
    frequency: Tensor

    def subset(self, rows: Tensor) -> Channels:
        """Return the given positions."""
        return replace(self, scene=self.scene.subset(rows), value=self.value[rows])

    def coherence(self, planes: PlaneSet, gain: Tensor) -> Tensor:
        """Return the coherence with the field of gains (n, 1 + S) at each position, (n,)."""
        return coherence(self.value, superposed(gain, waves(planes, self.scene, self.frequency)))
