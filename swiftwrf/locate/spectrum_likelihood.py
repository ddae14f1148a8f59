"""Likelihoods of spectra by the room that was found: co-array numbers, and element phases under uncertain path gains.

A spectrum of K elements is exactly a few dozen co-array numbers, and its channel's phases follow from these by phase
retrieval. Both are compared with predictions straight from the channel; no spectrum is rendered. Searching the position
whose predicted field matches the observed one is matched-field processing (A. B. Baggeroer, W. A. Kuperman and
P. N. Mikhalevsky, IEEE J. Oceanic Eng. 18, 1993; with uncertain surroundings: A. M. Richardson and L. W. Nolte,
J. Acoust. Soc. Am. 89, 1991).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray
from swiftwrf.locate.likelihood import Likelihood, ResidualDistribution
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.path_gains import PathGains, paths
from swiftwrf.models.geometry.phase_retrieval import autocorrelation, coarray_numbers, retrieve_phases

CHUNK = 50_000  # candidates whose channels are computed together
PHASE_CHUNK = 4_000  # candidates whose covariances are factorised together


@dataclass(frozen=True, eq=False)
class SpectrumFeatures:
    """What a spectrum determines about the channel.

    Args:
        coarray: Real and imaginary parts of the co-array numbers, float32 (n, F).
        phases: Element phasors of unit modulus and their indistinguishable twins, complex64 (n, T, K), T = 1 or 2.
    """

    coarray: Tensor
    phases: Tensor

    @classmethod
    def of(cls, spectra: Iterable[Tensor], array: PlanarArray, grid: AngularGrid, seed: int = 0) -> SpectrumFeatures:
        """Compute the features of spectra, batches (b, H, W) of magnitudes."""
        numbers = coarray_numbers(spectra, array, grid)
        channel, _ = retrieve_phases(numbers, array, seed)
        opposite = array.opposite
        twins = [channel] if opposite is None else [channel, channel.conj()[:, opposite]]
        return cls(real_parts(numbers), torch.stack(twins, dim=1).to(torch.complex64))

    def subset(self, rows: Tensor) -> SpectrumFeatures:
        """Return the features of some of the spectra."""
        return SpectrumFeatures(self.coarray[rows], self.phases[rows])

    def __len__(self) -> int:
        return len(self.coarray)


def real_parts(numbers: Tensor) -> Tensor:
    """Return complex numbers (..., P) as float32 (..., 2 P)."""
    return torch.view_as_real(numbers).flatten(-2).float()


def room_features(room: GeometryModel) -> Callable[[Tensor], Tensor]:
    """Return a function from positions (m, 3) to co-array numbers by constant path gains, float32 (m, F)."""
    return lambda position: _chunked(
        lambda some: real_parts(autocorrelation(room.channel(some).sgn(), room.array)), position, CHUNK
    )


def gain_features(room: GeometryModel, gains: PathGains) -> Callable[[Tensor], Tensor]:
    """Return a function from positions (m, 3) to co-array numbers by position-dependent path gains, float32 (m, F)."""

    def features(some: Tensor) -> Tensor:
        channel = gains.channel(room, some).sgn()
        return real_parts(autocorrelation(channel, room.array).mean(dim=1))

    return lambda position: _chunked(features, position, CHUNK // 8)


def _chunked(function: Callable[[Tensor], Tensor], position: Tensor, size: int) -> Tensor:
    return torch.cat([function(some) for some in position.split(size)])


class CoarrayLikelihood(Likelihood):
    """Student likelihood of the co-array numbers, with the covariance of held-out residuals.

    Args:
        features: Function from positions (m, 3) [m] to predicted co-array numbers (m, F).
        residual: Held-out residuals (n, F), predicted minus observed.
        power: Mean square of the observed numbers.
    """

    name = "coarray"

    def __init__(self, features: Callable[[Tensor], Tensor], residual: Tensor, power: float) -> None:
        self.features = features
        self.distribution = ResidualDistribution.fit(residual, power)

    def whitened(self, position: Tensor) -> Tensor:
        """Return whitened predictions (m, F) at positions (m, 3)."""
        return self.features(position) @ self.distribution.whitening

    def from_whitened(self, predicted: Tensor, observed: SpectrumFeatures) -> Tensor:
        """Return log-likelihoods (n, m) of whitened predictions (m, F) that all observations share."""
        target = observed.coarray @ self.distribution.whitening
        distance = target.square().sum(1)[:, None] + predicted.square().sum(1) - 2 * target @ predicted.T
        return self.distribution.log_density(distance.clamp_min(0))

    def log_likelihood(self, position: Tensor, observed: SpectrumFeatures) -> Tensor:
        predicted = self.whitened(position.reshape(-1, 3))
        if len(position) == 1:
            return self.from_whitened(predicted, observed)
        target = observed.coarray @ self.distribution.whitening
        away = predicted.reshape(*position.shape[:2], -1) - target[:, None]
        return self.distribution.log_density(away.square().sum(dim=2))


@dataclass(frozen=True, eq=False)
class PathStatistics:
    """Variances of path gains and of what no path explains, relative to the power of the direct path's mean gain.

    Args:
        direct: Variance of the direct path's gain.
        plane: Variance of a first-order gain in each plane, (P,).
        order: Variance of a path of higher order, relative to the product of its planes' variances and squared gains.
        diffuse: Power of scattering from all directions, relative to that of the channel.
        floor: Variance of each element's phasor, relative to its power.
    """

    direct: Tensor
    plane: Tensor
    order: Tensor
    diffuse: Tensor
    floor: Tensor

    @classmethod
    def fit(cls, room: GeometryModel, position: Tensor, phases: Tensor) -> PathStatistics:
        """Fit the variances by the marginal likelihood of phasors (n, T, K) at known positions (n, 3)."""
        planes = len(room.planes)
        raw = torch.cat([torch.tensor([-3.0]), torch.full((planes,), -2.0), torch.tensor([0.0, -2.0, -2.0])])
        raw.requires_grad_()
        optimiser = torch.optim.Adam([raw], lr=0.15)
        wave = paths(room, room.scene(position))
        with torch.enable_grad():
            for _ in range(STATISTICS_STEPS):
                model = PhaseLikelihood(room, cls.of(raw))
                loss = -model.paired_from(*wave, phases).mean() + 0.01 * raw.square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        return cls.of(raw.detach())

    @property
    def raw(self) -> Tensor:
        """Logarithms of all variances, (4 + P,)."""
        rest = torch.stack([self.order, self.diffuse, self.floor])
        return torch.cat([self.direct[None], self.plane, rest]).log()

    @classmethod
    def of(cls, raw: Tensor) -> PathStatistics:
        """Return the statistics of logarithms (4 + P,)."""
        value, planes = raw.exp(), len(raw) - 4
        return cls(value[0], value[1 : 1 + planes], value[1 + planes], value[2 + planes], value[3 + planes])

    def of_paths(self, room: GeometryModel) -> Tensor:
        """Return the variance of each path's gain, (1 + S,): direct, then images in their order."""
        found = room.tensors()
        second = found.gain[0].square() + self.plane
        variance = [self.direct]
        for planes in found.sequence:
            if len(planes) == 1:
                variance.append(self.plane[planes[0]])
            else:
                variance.append(self.order * torch.stack([second[i] for i in planes]).prod())
        return torch.stack(variance)


class PhaseLikelihood(Likelihood):
    """Marginal likelihood of the element phases if path gains vary about their mean by a complex normal distribution.

    The phase of the whole channel is unknown and integrated over.

    Args:
        room: Room with its paths.
        statistics: Variances of path gains.
    """

    name = "phases"

    def __init__(self, room: GeometryModel, statistics: PathStatistics) -> None:
        self.room, self.statistics = room, statistics
        self._variance = statistics.of_paths(room)
        self._diffuse = _isotropic(room)

    def log_likelihood(self, position: Tensor, observed: SpectrumFeatures) -> Tensor:
        n, m = len(observed), position.shape[1]
        flat = position.expand(n, -1, -1).reshape(-1, 3)
        owner = torch.arange(n).repeat_interleave(m)
        parts = [
            self.paired_from(*paths(self.room, self.room.scene(some)), observed.phases[rows])
            for some, rows in zip(flat.split(PHASE_CHUNK), owner.split(PHASE_CHUNK), strict=True)
        ]
        return torch.cat(parts).reshape(n, m)

    def paired_from(self, wave: Tensor, gain: Tensor, phases: Tensor) -> Tensor:
        """Return log-likelihoods (m,) of phasors (m, T, K) with paths (m, 1 + S, K) of mean gains (1 + S,)."""
        mean = torch.einsum("s,msk->mk", gain.to(wave.dtype), wave)
        power = (self._variance[:, None] * wave.abs().square()).sum(dim=1).mean(dim=1) + mean.abs().square().mean(dim=1)
        total = power * (1 + self.statistics.diffuse + self.statistics.floor)
        weighted = wave * self._variance.sqrt()[:, None]
        covariance = torch.einsum("msk,msl->mkl", weighted, weighted.conj()) / total[:, None, None]
        rest = self.statistics.diffuse * self._diffuse + self.statistics.floor * torch.eye(wave.shape[2])
        covariance = covariance + rest * (power / total)[:, None, None]
        mean = mean / total.sqrt()[:, None]
        root = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(root, torch.cat([mean[:, :, None], phases.mT], dim=2), upper=False)
        m, x = white[..., :1], white[..., 1:]
        match = 2 * (m.conj() * x).sum(dim=1).abs()
        misfit = x.abs().square().sum(dim=1) + m.abs().square().sum(dim=1)
        density = match + torch.special.i0e(match).log() - misfit
        total_density: Tensor = density.logsumexp(dim=1) - 2 * root.diagonal(dim1=1, dim2=2).real.log().sum(dim=1)
        return total_density


def _isotropic(room: GeometryModel) -> Tensor:
    """Return the correlation (K, K) of waves from all directions between the array's elements."""
    element = room.array.element.double()
    apart = 2 * torch.cdist(element, element) / room.array.wavelength
    return torch.sinc(apart).to(torch.complex64)


STATISTICS_STEPS = 60
__all__ = [
    "CoarrayLikelihood",
    "PathStatistics",
    "PhaseLikelihood",
    "SpectrumFeatures",
    "gain_features",
    "room_features",
]
