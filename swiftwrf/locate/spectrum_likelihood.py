"""Likelihoods of spectra and channels by the room that was found.

Searching the position whose predicted field matches the observed one is matched-field processing (A. B. Baggeroer,
W. A. Kuperman and P. N. Mikhalevsky, IEEE J. Oceanic Eng. 18, 1993; with uncertain surroundings: A. M. Richardson and
L. W. Nolte, J. Acoust. Soc. Am. 89, 1991).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Self

import numpy as np
import torch
from annotated_types import Gt, Lt
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.data.splits import each_fold
from swiftwrf.locate.features import Features, PathWaves, SpectrumFeatures
from swiftwrf.models.geometry.channels import coherence, ends, sources, superposed
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.runtime.threads import parallel_map
from swiftwrf.runtime.validation import PositiveFloat

DEGREES = (3.0, 5.0, 10.0, 30.0, math.inf)  # degrees of freedom of Student distributions that are compared; not studied
SCALES = (0.1, 1.0, 10.0)  # of the variances of path gains and scattering at a position; not studied
BOUNDS = (-10.0, 6.0)  # of the logarithms of variances: products of four of them stay within float32

Likelihood = Callable[[PathWaves, SpectrumFeatures], Tensor]
"""from waves at m candidates and m observations to log-likelihoods (m,), up to a constant of each observation"""
Screen = Callable[[SpectrumFeatures], Tensor]
"""from n observations to log-likelihoods (n, m) at m cells"""


def student_log_density(distance: Tensor, degrees: float, size: Tensor | int) -> Tensor:
    """Return the log-density of Student variables in `size` dimensions at squared whitened distances, without determinants.

    With infinite degrees of freedom they are Gaussian.
    """
    size = torch.as_tensor(size, dtype=torch.float64)
    if math.isinf(degrees):
        return -distance / 2 - size / 2 * math.log(2 * math.pi)
    half = (degrees + size) / 2
    constant = torch.lgamma(half) - math.lgamma(degrees / 2) - size / 2 * math.log(degrees * math.pi)
    # in place: a search has millions of distances
    return (distance / degrees).log1p_().mul_(-half).add_(constant)


@dataclass(frozen=True, eq=False)
class Student:
    """Multivariate Student distribution of F features.

    Args:
        scale: Scale matrix, float64 (F, F).
        degrees: Degrees of freedom; infinite for a Gaussian.
    """

    scale: Annotated[Tensor, "float64 f f"]
    degrees: PositiveFloat

    @classmethod
    def fit(cls, residual: Tensor, floor: float, *, shrinkages: Sequence[float] = (0.05, 0.1, 0.2, 0.4, 0.7)) -> Self:
        """Fit the distribution with the shrinkage and degrees of freedom of the highest held-out density.

        Args:
            residual: Residuals (n, F).
            floor: Smallest variance.
            shrinkages: Weights of the identity in the scale matrix that are compared. Not studied.
        """
        residual, shrinkage = residual.double(), torch.tensor(shrinkages, dtype=torch.float64)
        fold = torch.arange(len(residual)) % 5
        density = torch.zeros(len(DEGREES), len(shrinkage), dtype=torch.float64)
        for (row, degrees), (out, kept) in itertools.product(enumerate(DEGREES), each_fold(fold)):
            scales = covariance(residual[kept], shrinkage, degrees, floor)
            held_out = [cls(scale, degrees).log_likelihood(residual[out]).sum() for scale in scales]
            density[row] += torch.stack(held_out)
        best, column = divmod(int(density.argmax()), len(shrinkage))
        return cls(covariance(residual, shrinkage[[column]], DEGREES[best], floor)[0], DEGREES[best])

    @cached_property
    def whitening(self) -> Tensor:
        """Matrix W (F, F) with residuals @ W of unit scale, float32."""
        matrix: Tensor = torch.linalg.inv(torch.linalg.cholesky(self.scale)).T.float()
        return matrix

    def log_density(self, distance: Tensor) -> Tensor:
        """Return the log-density of squared whitened distances of any shape, without the determinants."""
        return student_log_density(distance, self.degrees, len(self.scale))

    def log_likelihood(self, residual: Tensor) -> Tensor:
        """Return the log-likelihoods (n,) of residuals (n, F), float64."""
        factor = torch.linalg.cholesky(self.scale)
        white = torch.linalg.solve_triangular(factor, residual.T, upper=False)
        density: Tensor = self.log_density(white.square().sum(dim=0)) - factor.diagonal().log().sum()
        return density


def covariance(residual: Tensor, shrinkage: Tensor, degrees: float, floor: float) -> Tensor:
    """Return scale matrices (S, F, F) of residuals (n, F), shrunk to the identity by weights (S,), variances above `floor`.

    Expectation maximisation weights the rows by the degrees of freedom.
    """
    n, f = residual.shape
    weight, identity = residual.new_ones(len(shrinkage), 1, n), torch.eye(f, dtype=residual.dtype)
    shrinkage = shrinkage[:, None, None]
    for _ in range(1 if math.isinf(degrees) else 8):  # expectation and maximisation
        scatter = (residual.T * weight) @ residual / n
        mean = scatter.diagonal(dim1=1, dim2=2).mean(dim=1)[:, None, None]
        scale: Tensor = (1 - shrinkage) * scatter + (shrinkage * mean + floor) * identity
        white = torch.linalg.solve_triangular(torch.linalg.cholesky(scale), residual.T, upper=False)
        weight = (degrees + f) / (degrees + white.square().sum(dim=1, keepdim=True))
    return scale


@dataclass(frozen=True, eq=False)
class CoarrayLikelihood:
    """Student likelihood of the co-array numbers, with the covariance of held-out residuals.

    Args:
        predict: Predicted co-array numbers.
        distribution: Distribution of predicted minus observed numbers over their relative standard deviations.
    """

    predict: Features
    distribution: Student

    def __call__(self, waves: PathWaves, observed: SpectrumFeatures) -> Tensor:
        """Return log-likelihoods (m,) of m observations at m candidates, up to a constant of each observation."""
        predicted, std = self.predict(waves)
        away = (predicted - observed.coarray) @ self.distribution.whitening / std[:, None]
        density: Tensor = self.distribution.log_density(away.square().sum(dim=1)) - away.shape[1] * std.log()
        return density

    def screen(self, whitened: Tensor, std: Tensor) -> Screen:
        """Return the function from n observations to log-likelihoods (n, m), by whitened predictions (m, F) at m cells."""
        squared, precision = whitened.square().sum(dim=1), std.square().reciprocal()
        volume = whitened.shape[1] * std.log()

        def log_likelihood(observed: SpectrumFeatures) -> Tensor:
            target = observed.coarray @ self.distribution.whitening
            distance = torch.addmm(squared, target, whitened.T, alpha=-2)
            distance = distance.add_(target.square().sum(dim=1, keepdim=True)).clamp_min_(0).mul_(precision)
            return self.distribution.log_density(distance).sub_(volume)

        return log_likelihood


class PhaseLikelihood:
    """Marginal likelihood of the element phases if path gains vary about their mean by a complex normal distribution.

    The phase of the whole channel is unknown and integrated over.

    Args:
        room: Room with P planes and further surfaces, and its paths.
        log_variance: Logarithms of variances, (4 + P,), relative to the power of the direct path's mean gain. The first is
            that of the direct path's gain, the next P are those of a first-order gain in each plane. The next one is that
            of higher orders, relative to the product of their planes' variances and squared gains. The last two are those of
            scattering from all directions, relative to the power of the channel, and of each element's phasor, relative to
            its power.
    """

    def __init__(self, room: GeometryModel, log_variance: Tensor) -> None:
        self.log_variance = log_variance
        reflectors, value = room.reflectors, log_variance.exp()
        direct, plane, (order, self._diffuse, self._floor) = value[0], value[1:-3], value[-3:].unbind()
        second = reflectors.gain[0].square() + plane
        images = [
            plane[planes[0]] if len(planes) == 1 else order * torch.stack([second[i] for i in planes]).prod()
            for planes in reflectors.sequence
        ]
        self._variance = torch.stack([direct, *images])
        element = room.array.element.double()
        # correlation (K, K) of waves from all directions between the elements
        self._isotropic = torch.sinc(2 * torch.cdist(element, element) / room.array.wavelength).to(torch.complex64)

    @classmethod
    def fit(cls, parts: Sequence[tuple[GeometryModel, PathWaves, SpectrumFeatures]], *, penalty: float = 0.01) -> Self:
        """Fit the variances by the marginal likelihood of observations at known positions.

        Args:
            parts: Rooms, waves of each room at the positions, and observations there. The result is that of the first room.
            penalty: Factor of the mean squared logarithm of the variances. It keeps those that the data do not determine
                near 1. Not studied.
        """
        room = parts[0][0]
        start = np.array([-3.0, *[-2.0] * room.reflectors.gain.shape[1], 0.0, -2.0, -2.0])

        @torch.enable_grad()
        def loss(values: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            raw = torch.from_numpy(values).float().requires_grad_()
            density = torch.cat([cls(each, raw)(waves, observed) for each, waves, observed in parts])
            total = penalty * raw.square().mean() - density.mean()
            (gradient,) = torch.autograd.grad(total, raw)
            return float(total.detach()), gradient.double().numpy()

        bounds = [BOUNDS] * len(start)
        optimum = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 20})
        return cls(room, torch.from_numpy(optimum.x).float())

    def sample(self, waves: PathWaves, generator: torch.Generator) -> Tensor:
        """Return channels (m, F, K) of the distribution at m positions. Scattering is independent at each frequency."""
        complex_normal = partial(torch.randn, dtype=torch.complex64, generator=generator)
        gain = self._variance.sqrt() * complex_normal(*waves.gain.shape)
        mean, change = waves.channel, superposed(gain, waves.wave)
        spread = torch.einsum("s,msfk->mfk", self._variance, waves.wave.abs().square()).mean(dim=(1, 2))
        power = spread + mean.abs().square().mean(dim=(1, 2))
        k = mean.shape[2]
        root = torch.linalg.cholesky(self._diffuse * self._isotropic + self._floor * torch.eye(k))
        channel: Tensor = mean + change + power.sqrt()[:, None, None] * (complex_normal(*mean.shape) @ root.T)
        return channel

    def __call__(self, waves: PathWaves, observed: SpectrumFeatures) -> Tensor:
        """Return log-likelihoods (m,) of m observations at m candidates, up to a constant of each observation."""
        assert observed.phases is not None
        mean, wave, phases = waves.channel[:, 0], waves.wave[:, :, 0], observed.phases
        weighted = wave * self._variance.sqrt()[:, None]
        spread = torch.einsum("msk,msl->mkl", weighted, weighted.conj())
        power = spread.diagonal(dim1=1, dim2=2).real.mean(dim=1) + mean.abs().square().mean(dim=1)
        total = power * (1 + self._diffuse + self._floor)
        rest = self._diffuse * self._isotropic + self._floor * torch.eye(wave.shape[2])
        spread = (spread + rest * power[:, None, None]) / total[:, None, None]
        mean = mean / total.sqrt()[:, None]
        factor = torch.linalg.cholesky(spread)
        white = torch.linalg.solve_triangular(factor, torch.cat([mean[:, :, None], phases.mT], dim=2), upper=False)
        m, x = white[..., :1], white[..., 1:]
        match = 2 * (m.conj() * x).sum(dim=1).abs()
        misfit = x.abs().square().sum(dim=1) + m.abs().square().sum(dim=1)
        density = match + torch.special.i0e(match).log() - misfit
        total_density: Tensor = density.logsumexp(dim=1) - 2 * factor.diagonal(dim1=1, dim2=2).real.log().sum(dim=1)
        return total_density


class PathLikelihood(PhaseLikelihood):
    """Marginal likelihood of channels at all frequencies under uncertain path gains, as `PhaseLikelihood` of phases.

    A path has one gain at all frequencies. Scattered waves keep their gain over frequency, too. Their delays spread as those
    of the images. A room explains some positions much worse than others, so the variances of gains and scattering have a
    common factor at each position, one of `SCALES`. The phase of each snapshot is unknown, and so is a delay of the packet.
    It is estimated relative to the expected field, given all snapshots.
    """

    def __init__(self, room: GeometryModel, log_variance: Tensor) -> None:
        super().__init__(room, log_variance)
        scene = room.link_at(room.region()[:1])
        length = (sources(room.reflectors, scene) - scene.receiver).norm(dim=-1)[:, 0]
        self._detour_rad = scene.wavenumber * float((length - length[0]).square().mean().sqrt())
        self._over_element, self._basis = torch.linalg.eigh(self._isotropic)

    def __call__(self, waves: PathWaves, observed: SpectrumFeatures) -> Tensor:
        assert observed.channel is not None
        count = observed.channel.shape[1]  # snapshots at one frequency have the same waves
        mean, wave = waves.channel.expand(-1, count, -1), waves.wave.expand(-1, -1, count, -1)
        # scattering has the covariance of frequencies times that of elements, and the eigenvectors of both whiten it
        fields = torch.cat([wave, mean[:, None], observed.channel[:, None]], dim=1) @ self._basis
        power = torch.view_as_real(fields).square().sum((2, 3, 4)) / fields[0, 0].numel()  # which no rotation changes
        with torch.no_grad():
            one = _Whitened.of(fields, power, self._variance, self._diffuse * self._over_element, self._floor)
            fields[:, -1] *= one.phases()
        frequency = waves.frequency.expand(count)
        apart = self._detour_rad * (frequency[:, None] - frequency).float()
        over_frequency, turn = torch.linalg.eigh((-apart.square() / 2).exp())
        fields = turn.T.to(fields.dtype) @ fields
        scattered = self._diffuse * over_frequency[:, None] * self._over_element
        densities = [
            _Whitened.of(fields, power, scale * self._variance, scale * scattered, self._floor).log_density()
            for scale in SCALES
        ]
        density: Tensor = torch.stack(densities).logsumexp(dim=0)
        return density


@dataclass(frozen=True, eq=False)
class _Whitened:
    """Complex normal distribution of channels (F, K) at m candidates, scaled so that noise and scattering are white.

    Only inner products of the waves, of the expected and of the observed channels count. These are the rows of `fields`, in
    this order.

    Args:
        fields: Waves, expected and observed channels, whitened, (m, 1 + S + 2, F, K).
        size: Factors of these that give waves of one standard deviation and channels of unit power, (m, 1 + S + 2).
        gram: Inner products a b^* of the products of both, (m, 1 + S + 2, 1 + S + 2).
        factor: Cholesky factors of I + s s^H, (m, 1 + S, 1 + S), with the waves s.
        log_volume: Logarithm of the factors that whiten the observed channels, summed.
    """

    fields: Tensor
    size: Tensor
    gram: Tensor
    factor: Tensor
    log_volume: Tensor

    @classmethod
    def of(cls, fields: Tensor, power: Tensor, variance: Tensor, scattered: Tensor, floor: Tensor) -> Self:
        """Return the distribution of channels of unit expected power.

        Args:
            fields: Waves of the paths, expected and observed channels (m, 1 + S + 2, F, K).
            power: Their powers (m, 1 + S + 2).
            variance: Variances of the gains of the paths (1 + S,).
            scattered: Variances of scattering (F or 1, K), relative to the power of the paths.
            floor: Variance of the noise, relative to the same.
        """
        rest = scattered.clamp_min(0) + floor
        whitening = ((1 + rest.mean()) / rest).sqrt()
        amount = ((power[:, -2] + power[:, :-2] @ variance) * (1 + rest.mean())).rsqrt()[:, None]
        size = torch.cat([amount * variance.sqrt(), amount, torch.ones_like(amount)], dim=1)
        fields = fields * whitening
        rows = fields.flatten(2)
        gram = (rows @ rows.mH) * (size[:, :, None] * size[:, None])
        factor = torch.linalg.cholesky(gram[:, :-2, :-2] + torch.eye(len(variance)))
        return cls(fields, size, gram, factor, whitening.log().expand(fields.shape[2:]).sum())

    def phases(self, *, steps: int = 3) -> Tensor:
        """Return the phasors (m, F, 1) by which the observed snapshots agree with the expected field.

        Phases and the field that is expected given the channels follow from each other in three steps (not studied).
        """
        match = self.size[:, :-1, None] * (self.fields[:, :-1] * self.fields[:, -1:].conj()).sum(-1)  # of each snapshot
        along, mean = match[:, :-1], match[:, -1:].mT
        phase = mean.sgn()
        for _ in range(steps - 1):
            change = torch.cholesky_solve(along @ phase.conj() - self.gram[:, :-2, -2:-1], self.factor)
            phase = (mean + along.mT @ change.conj()).sgn()
        return phase

    def log_density(self) -> Tensor:
        """Return the log-densities of the observed channels with an unknown common phase, up to a constant, (m,)."""
        along = torch.linalg.solve_triangular(self.factor, self.gram[:, :-2, -2:], upper=False)
        product = self.gram[:, -2:, -2:] - along.mH @ along  # of expected and observed channels over the covariance
        match, misfit = 2 * product[:, 0, 1].abs(), product.diagonal(dim1=1, dim2=2).real.sum(1)
        volume = self.factor.diagonal(dim1=1, dim2=2).real.log().sum(1) - self.log_volume
        density: Tensor = match + torch.special.i0e(match).log() - misfit - 2 * volume
        return density


@dataclass(frozen=True, eq=False)
class ChannelLikelihood:
    """Likelihood of measured channels by the room's path gains, with an unknown phase of each snapshot.

        l = -F K log(1 - coherence + floor)

    With an unknown scale and an unknown power of white errors this is the logarithm of the concentrated normal likelihood.
    The floor is the median missing coherence at held-out positions: below it, errors of the room decide.

    Args:
        floor: Missing coherence at true positions.
    """

    floor: Annotated[float, Gt(0), Lt(math.inf)]

    def __call__(self, waves: PathWaves, observed: SpectrumFeatures) -> Tensor:
        """Return log-likelihoods (m,) of m observations at m candidates, up to a constant of each observation."""
        assert observed.channel is not None
        return self.log_density(coherence(observed.channel, waves.channel), observed.channel)

    def log_density(self, coherence: Tensor, channel: Tensor) -> Tensor:
        """Return the log-likelihoods of coherences of any shape with channels (n, F, K)."""
        missing = (1 - coherence).clamp_min_(0).add_(self.floor)  # in place: a search has millions of cells
        return missing.log_().mul_(-math.prod(channel.shape[1:]))

    def screen(self, predicted: Sequence[Tensor]) -> Screen:
        """Return the function from n observations to log-likelihoods (n, m), by channels at m cells.

        Args:
            predicted: Channels at some of the cells each, complex64 (F, -, K), of one snapshot or of the first and the last.
        """

        def log_likelihood(observed: SpectrumFeatures) -> Tensor:
            every = observed.channel
            assert every is not None
            channel = every[:, ends(every.shape[1])].movedim(1, 0)  # (F, n, K)
            observed_power = channel.abs().square().sum(dim=2).T
            # conj(x) h is the real numbers x . h and (j x) . h, whose squares are summed faster than those of complex ones
            parts = torch.view_as_real(torch.cat([channel, 1j * channel], dim=1)).flatten(2)

            def at(cells: Tensor) -> Tensor:
                waves = torch.view_as_real(cells).flatten(2)
                match = (parts @ waves.mT).square_().unflatten(1, (2, -1)).sum(dim=(0, 1))
                power = waves.square().sum(dim=2).expand(len(channel), -1)
                return self.log_density(match / (observed_power @ power).clamp_min(1e-30), every)

            return torch.cat(parallel_map(at, predicted), dim=1)

        return log_likelihood
