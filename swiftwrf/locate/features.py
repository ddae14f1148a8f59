"""Features of spectra and channels, and their predictions by the room that was found.

A spectrum of K elements is exactly a few dozen co-array numbers, and its channel's phases follow from these by phase
retrieval. Both are compared with predictions straight from the channel; no spectrum is rendered. A measured channel is
compared with its amplitudes and subcarriers. Where channels are measured densely, a Gaussian process of their co-array
numbers about those of the room predicts what the room does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import unit_power
from swiftwrf.array.planar import PlanarArray
from swiftwrf.gp import GaussianProcess
from swiftwrf.models.geometry.channels import sources, superposed, waves
from swiftwrf.models.geometry.model import GeometryModel, kept_snapshots
from swiftwrf.models.geometry.path_gains import PathGains
from swiftwrf.models.geometry.phase_retrieval import autocorrelation, coarray_numbers, retrieve_phases

CARRIER = torch.ones(1, dtype=torch.float64)  # frequency relative to the carrier


@dataclass(frozen=True, eq=False)
class SpectrumFeatures:
    """Features of the channel that a spectrum determines, and the channel itself where it is measured.

    Args:
        coarray: Real and imaginary parts of the co-array numbers, float32 (n, F), of channels with amplitudes.
        phases: Element phasors of unit modulus of spectra and their indistinguishable aliases, complex64 (n, T, K). T is 2
            if there are aliases.
        channel: Measured channels, scaled to unit power, complex64 (n, F, K).
    """

    coarray: Tensor
    phases: Tensor | None = None
    channel: Tensor | None = None

    @classmethod
    def of(cls, spectra: Iterable[Tensor], array: PlanarArray, grid: AngularGrid, seed: int = 0) -> SpectrumFeatures:
        """Compute the features of spectra, batches (b, H, W) of magnitudes."""
        numbers = coarray_numbers(spectra, array, grid)
        channel, _ = retrieve_phases(numbers, array, seed)
        opposite = array.opposite
        aliases = [channel] if opposite is None else [channel, channel.conj()[:, opposite]]
        return cls(real_parts(numbers), torch.stack(aliases, dim=1).to(torch.complex64))

    @classmethod
    def of_channels(cls, channel: Tensor, array: PlanarArray) -> SpectrumFeatures:
        """Compute the features of channels (n, S, K)."""
        kept = unit_power(channel[:, kept_snapshots(channel.shape[1])])
        return cls(channel_numbers(kept, array), channel=kept)

    def subset(self, rows: Tensor) -> SpectrumFeatures:
        """Return the features of some of the spectra."""
        phases, channel = (None if x is None else x[rows] for x in (self.phases, self.channel))
        return SpectrumFeatures(self.coarray[rows], phases, channel)

    def __len__(self) -> int:
        return len(self.coarray)


def real_parts(numbers: Tensor) -> Tensor:
    """Return complex numbers (..., P) as float32 (..., 2 P)."""
    return torch.view_as_real(numbers).flatten(-2).float()


def channel_numbers(channel: Tensor, array: PlanarArray) -> Tensor:
    """Return the mean co-array numbers of the snapshots of channels (n, F, K), scaled to unit power, float32 (n, 2 P)."""
    power = channel.abs().square().mean((1, 2), keepdim=True).clamp_min(1e-30)
    return real_parts(autocorrelation(channel * power.rsqrt(), array).mean(dim=1))


@dataclass(frozen=True, eq=False)
class PathWaves:
    """Waves of the paths of a room at candidate positions, which all likelihoods share.

    Args:
        position: Candidate positions, float64 (m, 3) [m].
        wave: Wave of the direct path and of each image at each frequency and element, complex64 (m, 1 + S, F, K).
        gain: Gains of the paths, (m, 1 + S).
        frequency: Frequencies relative to the carrier, (F,).
    """

    position: Tensor
    wave: Tensor
    gain: Tensor
    frequency: Tensor

    @classmethod
    def at(cls, room: GeometryModel, position: Tensor, frequency: Tensor = CARRIER) -> PathWaves:
        """Compute the waves at positions (m, 3) [m] and frequencies (F,) relative to the carrier."""
        scene = room.link_at(position)
        return cls(position, waves(room.reflectors, scene, frequency), room.gains(scene), frequency)

    @cached_property
    def channel(self) -> Tensor:
        """Channel of each element by the room's path gains, complex64 (m, F, K)."""
        return superposed(self.gain, self.wave)


def channels_beside(room: GeometryModel, position: Tensor, away: Tensor, frequency: Tensor) -> Tensor:
    """Return channels near positions, with path lengths to first order in the distance and gains that do not change.

    This takes a small part of the time of `PathWaves`, and suffices to choose candidates.

    Args:
        room: Room with S images.
        position: Positions, float64 (m, 3) [m].
        away: Vectors from each of them to C positions near it, float64 (C, 3) [m].
        frequency: Frequencies relative to the carrier, (F,).

    Returns:
        Channels, complex64 (m C, F, K).
    """
    here = PathWaves.at(room, position, frequency)

    def rays(at: Tensor) -> Tensor:
        scene = room.link_at(at)
        return sources(room.reflectors, scene) - scene.receiver

    ray = rays(position)
    unit = ray / ray.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    steps = torch.eye(3, dtype=torch.float64)
    slope = torch.stack([((rays(position + step) - ray) * unit).sum(-1) for step in steps], dim=-1)  # (1 + S, m, 3)
    phase = -math.tau / room.array.wavelength * (slope @ away.T).permute(1, 2, 0).float()
    turned = torch.polar(here.gain[:, None].expand_as(phase).contiguous(), phase)
    channel: Tensor = (turned @ here.wave.flatten(2)).flatten(0, 1).unflatten(1, here.wave.shape[2:])
    return channel


Features = Callable[[PathWaves], tuple[Tensor, Tensor]]
"""from waves of m positions to co-array numbers, float32 (m, F), and relative standard deviations of their errors, (m,)"""


def gain_features(array: PlanarArray, gains: PathGains) -> tuple[Features, Features]:
    """Return co-array numbers by constant and by position-dependent path gains, as functions of waves."""

    def constant(waves: PathWaves) -> tuple[Tensor, Tensor]:
        return real_parts(autocorrelation(waves.channel[:, 0].sgn(), array)), torch.ones(len(waves.position))

    def varying(waves: PathWaves) -> tuple[Tensor, Tensor]:
        channel = (waves.gain[:, None] + gains.change(waves.position)) @ waves.wave[:, :, 0]
        return real_parts(autocorrelation(channel.sgn(), array).mean(dim=1)), torch.ones(len(waves.position))

    return constant, varying


def nearby_features(array: PlanarArray, process: GaussianProcess) -> Features:
    """Return co-array numbers of channels by constant path gains and measured channels nearby, as a function of waves."""
    return lambda waves: nearby_numbers(waves.channel, waves.position, array, process)


def nearby_numbers(
    channel: Tensor, position: Tensor, array: PlanarArray, process: GaussianProcess
) -> tuple[Tensor, Tensor]:
    """Return co-array numbers of predicted channels, corrected by measured channels nearby.

    Args:
        channel: Predicted channels (m, F, K).
        position: Their positions (m, 3) [m].
        array: Array of the channels.
        process: Process of the differences of measured from predicted numbers.

    Returns:
        Numbers, float32 (m, 2 P), and the relative standard deviations of their errors, (m,).
    """
    mean, variance = process.mean_and_variance(position)
    return channel_numbers(channel, array) + mean.float(), (variance + process.kernel.noise).sqrt().float()
