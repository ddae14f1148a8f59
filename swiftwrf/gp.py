"""The one Gaussian process: its kernel, how the kernel is chosen, regression, and smooth random fields under its prior.

Positions whose spectra resemble each other should move alike. So the kernel is the one under which a Gaussian process on
the spectra's pixels best predicts training spectra that are held out: at random, or a whole region at a time where the
model will be asked for regions nobody measured. Everything follows from the spectra's inner products, hence a candidate
costs a few small linear solves and no rendering (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine
Learning", 2006, chapters 2 and 5).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor, nn

from swiftwrf.errors import InputError
from swiftwrf.positions import Neighbours, distance
from swiftwrf.store import Store
from swiftwrf.threads import single_thread

NOISES = (1e-3, 1e-2, 1e-1)  # of spectra: little of a measured one is not a function of position
NEGLIGIBLE = 5e-4  # share of the error at held-out positions that components may add which are left out
JITTER = 1e-6  # relative variance that keeps neighbouring anchors apart
EXACT = 2000  # positions up to which a process is exact; beyond, time and memory would grow with their cube and square
NEAR = 64  # positions that tell of one among many: farther ones hardly change the mean
MAX_ROWS = 400  # more do not change the choice, and a candidate costs their number cubed


@dataclass(frozen=True)
class Kernel:
    """How alike a field is at two positions, by their distance r: a rough long-range and a smooth short-range part.

        k(r) = share exp(-r / long) + (1 - share) (1 + sqrt(3) r / short) exp(-sqrt(3) r / short)

    The long part (Matern 1/2) carries the rough field between rooms' positions, the short one (Matern 3/2) follows a path
    sampled densely.

    Args:
        long, short: correlation lengths, in the unit of the positions.
        share: of the long part, in [0, 1].
        noise: variance of what is not a function of position, relative to k(0) = 1.

    Raises:
        InputError: a length, share or noise that makes no kernel.
    """

    long: float = 0.5
    short: float = 0.1
    share: float = 0.6
    noise: float = 1e-2

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, (self.long, self.short, self.share, self.noise)))
        if not (finite and self.long > 0 and self.short > 0 and 0 <= self.share <= 1 and self.noise >= 0):
            raise InputError(f"a kernel needs lengths above 0, a share in [0, 1] and a noise from 0, got {self}")

    def scaled(self, factor: float) -> Kernel:
        """The same kernel on positions multiplied by `factor`."""
        return replace(self, long=self.long * factor, short=self.short * factor)

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """k between positions (n, 3) and (m, 3), (n, m)."""
        r = distance(a, b)
        if self.share == 1:
            return torch.exp(-r / self.long)
        near = math.sqrt(3) * r / self.short
        value: Tensor = self.share * torch.exp(-r / self.long) + (1 - self.share) * (1 + near) * torch.exp(-near)
        return value

    def noisy_gram(self, position: Tensor) -> Tensor:
        """Covariance of noisy values at positions (n, 3), float64 (n, n)."""
        position = position.double()
        noisy: Tensor = self(position, position) + self.noise * torch.eye(len(position), dtype=torch.float64)
        return noisy


class GaussianProcess:
    """Regression with a given kernel and mean 0: values at any position as a weighted sum of those at known ones.

    Args:
        kernel: with its noise.
        known: positions (n, 3) of the values.
    """

    def __init__(self, kernel: Kernel, known: Tensor) -> None:
        self.kernel, self.known = kernel, known.double()

    @cached_property
    @torch.inference_mode(False)
    def inverse(self) -> Tensor:
        """Of the covariance of the noisy values, (n, n)."""
        inverse: Tensor = torch.linalg.inv(self.kernel.noisy_gram(self.known))
        return inverse

    def weights(self, position: Tensor) -> Tensor:
        """By which the known values make up the mean at positions (m, 3), float64 (m, n)."""
        weights: Tensor = self.kernel(position.double(), self.known) @ self.inverse
        return weights

    def variance(self, position: Tensor) -> Tensor:
        """Of the field (without noise) at positions (m, 3), relative to k(0) = 1, float64 (m,)."""
        cross = self.kernel(position.double(), self.known)
        variance: Tensor = 1 - (cross @ self.inverse * cross).sum(dim=1)
        return variance.clamp(0, 1)


class NearbyProcess:
    """The same for any number of known positions: each position is told of by the nearest of them alone (local Gaussian
    processes: R. B. Gramacy and D. W. Apley, Journal of Computational and Graphical Statistics 24, 2015).

    Args:
        kernel: with its noise.
        known: positions (n, 3) of the values.
    """

    def __init__(self, kernel: Kernel, known: Tensor) -> None:
        self.kernel, self.known, self._neighbours = kernel, known.double(), Neighbours(known)

    def weights(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """At positions (m, 3): numbers of the known values that make up the mean, (m, k), by which weights, float64 (m, k),
        and the variance of the field (without noise), relative to k(0) = 1, float64 (m,)."""
        position = position.to(self.known)
        number = self._neighbours(position, min(NEAR, len(self.known)))[1].to(self.known.device)
        near = self.known[number]
        noisy = self.kernel(near, near) + self.kernel.noise * torch.eye(number.shape[1]).to(near)
        cross = self.kernel(position[:, None], near)[:, 0]
        weight = torch.linalg.solve(noisy, cross)
        return number, weight, (1 - (weight * cross).sum(dim=1)).clamp(0, 1)

    def mean(self, position: Tensor, value: Tensor) -> Tensor:
        """Of functions with known values (n, K) at positions (m, 3), float64 (m, K)."""
        number, weight, _ = self.weights(position)
        return torch.einsum("mk,mkc->mc", weight, value[number].double())

    def variance(self, position: Tensor) -> Tensor:
        """Of the field (without noise) at positions (m, 3), relative to k(0) = 1, float64 (m,)."""
        return self.weights(position)[2]


class SmoothField(nn.Module):
    """K smooth random functions of position, c(s) = k(s, Z) R^-T z with anchors Z and k(Z, Z) + noise = R R^T.

    Under the Gaussian-process prior z is standard normal, so that a small |z|^2 is a smooth function. Near the anchors the
    functions follow them; far from all of them they fall back to 0 instead of extrapolating.

    Args:
        anchor: Z, normalised positions (M, 3).
        kernel: k, on normalised positions.
        rank: K.
        whiten: R^-T (M, M) where it is known already.
    """

    def __init__(self, anchor: Tensor, kernel: Kernel, rank: int, whiten: Tensor | None = None) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        if whiten is None:  # in float64, for nearby anchors are nearly alike
            whiten = torch.linalg.inv(torch.linalg.cholesky(kernel.noisy_gram(anchor))).T.to(anchor)
        self.register_buffer("whiten", whiten)
        self.coefficient = nn.Parameter(torch.zeros(len(anchor), rank))

    anchor: Tensor
    whiten: Tensor

    @classmethod
    @single_thread()
    def regress(cls, position: Tensor, kernel: Kernel, value: Tensor) -> SmoothField:
        """The functions that a Gaussian process tells from values (n, K) at normalised positions (n, 3)."""
        field = cls(position, kernel, value.shape[1])
        field.coefficient.data = torch.linalg.solve_triangular(
            torch.linalg.cholesky(kernel.noisy_gram(position)), value.double(), upper=False
        ).to(position)
        return field

    def variance(self, position: Tensor) -> Tensor:
        """Of the functions at positions (B, 3) once the measured spectra are known, relative to k(0) = 1, (B,)."""
        known: Tensor = self.kernel(position, self.anchor) @ self.whiten
        return (1 - known.square().sum(dim=1)).clamp(0, 1)

    def forward(self, position: Tensor) -> Tensor:
        """c(s) at positions (B, 3), (B, K)."""
        return self.kernel(position, self.anchor) @ (self.whiten @ self.coefficient)

    def prior(self) -> Tensor:
        """|z|^2, the negative log prior up to a factor 1/2."""
        return self.coefficient.square().sum()


class NearbyField(nn.Module):
    """What a smooth field tells of too many positions for one: its functions at a position from the values at the nearest
    ones alone.

    Args:
        anchor: normalised positions (M, 3).
        kernel: on normalised positions, with its noise.
        value: of K functions, (M, K).
    """

    def __init__(self, anchor: Tensor, kernel: Kernel, value: Tensor) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        self.register_buffer("value", value.to(anchor))
        self._process: NearbyProcess | None = None

    anchor: Tensor
    value: Tensor

    @property
    def process(self) -> NearbyProcess:
        """Made at first use, when the anchors are where they stay."""
        if self._process is None or self._process.known.device != self.anchor.device:
            self._process = NearbyProcess(self.kernel, self.anchor)
        return self._process

    def variance(self, position: Tensor) -> Tensor:
        """Of the functions at positions (B, 3), relative to k(0) = 1, (B,)."""
        return self.process.variance(position).to(position)

    def forward(self, position: Tensor) -> Tensor:
        """The functions at positions (B, 3), (B, K)."""
        return self.process.mean(position, self.value).to(position)


@single_thread()
def choose_kernel(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Kernel:
    """The candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Args:
        position: of the training spectra [m], (n, 3).
        spectrum: the training spectra, (n, H, W).
        fold: number of the part that each is held out with, (n,).
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    gram = _inner_products(spectrum)

    def score(kernel: Kernel) -> float:
        total = 0.0
        for out, kept, gain in held_out_weights(kernel, position, fold):
            own = gram.diagonal()[out]
            error = own - 2 * (gain * gram[out][:, kept]).sum(1) + ((gain @ gram[kept][:, kept]) * gain).sum(1)
            total -= float(error.clamp_min(1e-12).log().sum())
        return total

    return max(candidates(position, NOISES), key=score)


@single_thread()
def choose_rank(position: Tensor, spectrum: Tensor | Store, fold: Tensor, kernel: Kernel) -> int:
    """How many principal components of the spectra it takes until the variance of the others no longer counts beside the
    error at positions that are held out.

    Args:
        position, spectrum, fold: as for `choose_kernel`.
        kernel: what it chose.
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    variance, vector = torch.linalg.eigh(_inner_products(spectrum))
    variance = variance.flip(0).clamp_min(0)
    component = vector.flip(1) * variance.sqrt()  # (n, n), one column a component
    predicted, _ = held_out(kernel, position, fold, component)
    left_out = variance.flip(0).cumsum(0).flip(0)  # by 0, 1, ... components
    enough = left_out <= NEGLIGIBLE * (component - predicted).square().sum()
    return int((~enough).sum())


def held_out(kernel: Kernel, position: Tensor, fold: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """What regression with mean 0 predicts of values whose fold is left out, all folds from one inverse (Rasmussen and
    Williams 2006, section 5.4.2; Golub, Heath and Wahba 1979).

    Args:
        position: (n, 3).
        fold: number of the part that each is held out with, (n,).
        value: (n, K).

    Returns:
        Predictions (n, K), and variances of the noisy values about them, relative to k(0) = 1, (n,); float64.
    """
    inverse = torch.linalg.inv(kernel.noisy_gram(position))
    weighted = inverse @ value.double()
    predicted, variance = torch.empty_like(weighted), torch.empty(len(value), dtype=torch.float64)
    for number in fold.unique():
        out = (fold == number).nonzero()[:, 0]
        covariance = torch.linalg.inv(inverse[out][:, out])
        predicted[out] = value[out].double() - covariance @ weighted[out]
        variance[out] = covariance.diagonal()
    return predicted, variance


@single_thread()
def most_informative(kernel: Kernel, known: Tensor, candidate: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Where measuring lowers the mean variance over the candidates most, one after the other (greedy variance reduction;
    Krause, Singh and Guestrin 2008 on its near-optimality).

    Args:
        kernel: of the field, with its noise.
        known: positions (n, 3) that are measured already.
        candidate: positions (m, 3) to choose from, evenly over the region.
        count: how many, at most m.

    Returns:
        Numbers of the chosen candidates in order, (count,), and the mean variance before any and after each of them,
        relative to k(0) = 1, float64 (1 + count,).
    """
    candidate = candidate.double()
    cross = kernel(candidate, known.double())
    covariance = kernel(candidate, candidate) - cross @ torch.linalg.solve(kernel.noisy_gram(known), cross.T)
    chosen: list[int] = []
    left = [covariance.diagonal().mean()]
    for _ in range(count):
        noisy = covariance.diagonal().clamp_min(0) + kernel.noise + JITTER
        lowered = covariance.square().sum(dim=0) / noisy
        lowered[chosen] = -1
        best = int(lowered.argmax())
        covariance -= covariance[:, best, None] * covariance[best] / noisy[best]
        chosen.append(best)
        left.append(covariance.diagonal().mean())
    return torch.tensor(chosen, dtype=torch.int64), torch.stack(left).clamp_min(0)


def thinned(*tensors: Tensor | Store, rows: int = MAX_ROWS) -> list[Tensor]:
    """At most so many rows of each, the same ones, evenly spread."""
    n = len(tensors[0])
    some = torch.linspace(0, n - 1, rows).long() if n > rows else slice(None)
    return [t[some] for t in tensors]


def _inner_products(spectrum: Tensor) -> Tensor:
    """Of the spectra's differences from their mean, a pixel, float64 (n, n)."""
    flat = spectrum.flatten(1).double()
    flat = flat - flat.mean(dim=0)
    return flat @ flat.T / flat.shape[1]


def candidates(position: Tensor, noises: Sequence[float]) -> Iterator[Kernel]:
    """Kernels with lengths from the extent of the positions (n, 3) [m] down, with and without a short-range part."""
    extent = float((position.max(0).values - position.min(0).values).max()) or 1.0
    for noise in noises:
        for k in range(5):
            long = extent / 2**k
            yield Kernel(long=long, short=extent, share=1.0, noise=noise)
            yield from (Kernel(long=long, short=extent / 3 / 2**j, share=0.6, noise=noise) for j in range(1, 6))


def held_out_weights(kernel: Kernel, position: Tensor, fold: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For each fold: which rows are out and which are kept, and the weights (out, kept) that predict the former."""
    noisy = kernel.noisy_gram(position)
    covariance = noisy - kernel.noise * torch.eye(len(position), dtype=noisy.dtype)
    for number in fold.unique():
        out, kept = fold == number, fold != number
        yield out, kept, torch.linalg.solve(noisy[kept][:, kept], covariance[kept][:, out]).T
