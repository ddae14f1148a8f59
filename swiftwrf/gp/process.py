"""Gaussian processes: the kernel and its candidates, regression exact or local, and predictions of held-out rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le, Lt
from scipy.optimize import brentq
from torch import Tensor
from torch.nn import functional

from swiftwrf.data.splits import each_fold
from swiftwrf.positions import Neighbours, distance
from swiftwrf.runtime.validation import Fraction, configuration

MIN_NOISE = 1e-8  # variance of the noise, relative to that of the field
MAX_EXACT = 2000  # positions up to which a process is exact; time and memory grow with their cube and square
Scale = Annotated[float, Gt(0), Lt(math.inf)]
N_NEIGHBOURS = 64  # positions that a local prediction conditions on; farther ones hardly change the mean


@configuration
class Kernel:
    """Covariance of a field at two positions by their distance r: a rough long-range and a smooth short-range part.

        k(r) = w exp(-r / l) + (1 - w) (1 + sqrt(3) r / s) exp(-sqrt(3) r / s)

    The Matern 1/2 part of weight w and length l models a rough field between positions that are wavelengths apart. The
    Matern 3/2 part of length s models a path that is sampled densely.

    Args:
        matern12_length: Correlation length l of the rough part, in the unit of the positions.
        matern32_length: Correlation length s of the smooth part.
        matern12_weight: Variance w of the rough part, in [0, 1].
        noise: Variance that does not depend on position, relative to k(0) = 1. Less than 1e-8 is 1e-8.
        vertical: Factor of differences in z, e.g. between floors.

    Raises:
        InputError: A value outside its range.

    Example:
        >>> Kernel(matern12_length=1.0, matern12_weight=1.0)(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]))
        tensor([[0.3679]])
    """

    matern12_length: Scale = 0.5
    matern32_length: Scale = 0.1
    matern12_weight: Fraction = 0.6
    noise: Annotated[float, Ge(0), Lt(math.inf)] = 1e-2
    vertical: Scale = 1.0

    def check(self) -> None:
        """Raise the noise to what makes every covariance positive definite, also that of repeated positions."""
        object.__setattr__(self, "noise", max(self.noise, MIN_NOISE))

    @property
    def correlation_length(self) -> float:
        """Distance at which the covariance has fallen to 1/e, in the unit of the positions."""
        longest = max(self.matern12_length, self.matern32_length)
        return float(brentq(lambda r: float(self.at(torch.tensor(r).double())) - 1 / math.e, 0.0, 2 * longest))

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Return k between positions (..., n, 3) and (..., m, 3), (..., n, m)."""
        if self.vertical != 1:
            scale = a.new_tensor([1.0, 1.0, self.vertical])
            a, b = a * scale, b * scale
        return self.at(distance(a, b))

    def at(self, r: Tensor) -> Tensor:
        """Return k at distances of any shape."""
        rough, weight = torch.exp(-r / self.matern12_length), self.matern12_weight
        if weight == 1:
            return rough
        near = math.sqrt(3) * r / self.matern32_length
        value: Tensor = weight * rough + (1 - weight) * (1 + near) * torch.exp(-near)
        return value

    def covariance(self, position: Tensor) -> Tensor:
        """Return the covariance of noisy values at positions (n, 3), float64 (n, n)."""
        position = position.double()
        noisy: Tensor = self(position, position) + self.noise * torch.eye(len(position)).to(position)
        return noisy


def candidates(position: Tensor, noises: Sequence[float], *, n_lengths: int = 5, n_smooth: int = 5) -> Iterator[Kernel]:
    """Yield kernels with lengths from the extent of the positions (n, 3) [m] down, with and without a smooth part.

    Args:
        position: Positions (n, 3) [m].
        noises: Variances of the noise.
        n_lengths: Number of lengths of the rough part, each half the one before. Not studied.
        n_smooth: Number of lengths of the smooth part, each half the one before. Not studied.

    Example:
        >>> kernels = list(candidates(torch.rand(50, 3, dtype=torch.float64), noises=[0.01]))
        >>> {kernel.noise for kernel in kernels}
        {0.01}
    """
    extent = float((position.max(0).values - position.min(0).values).max()) or 1.0
    for noise in noises:
        for k in range(n_lengths):
            length = extent / 2**k
            yield Kernel(length, extent, matern12_weight=1.0, noise=noise)
            yield from (
                Kernel(length, extent / 3 / 2**j, matern12_weight=0.6, noise=noise) for j in range(1, n_smooth + 1)
            )


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """Regression with a given kernel and prior mean 0.

    Among more than 2000 positions, a prediction conditions on the nearest 64 only (local Gaussian process: R. B. Gramacy and
    D. W. Apley, Journal of Computational and Graphical Statistics 24, 2015).

    Args:
        kernel: Kernel with its noise.
        known: Positions of the values (n, 3).
        value: Values (n, K), in the precision of the posterior mean. Defaults to none, for variances alone.
        exact: Whether every prediction conditions on all positions. Defaults to n <= 2000.
        correlation: Correlation of the field at the time of each value with the present field, (n,), from above 0 to 1,
            ascending. Defaults to 1. Between two values of correlations a <= b it is a / b (autoregressive in time).

    Example:
        >>> position = torch.rand(20, 3, dtype=torch.float64)
        >>> process = GaussianProcess(Kernel(noise=1e-6), position, position.sum(dim=1, keepdim=True))
        >>> bool((process.mean(position)[:, 0] - position.sum(dim=1)).abs().max() < 1e-2)
        True
    """

    kernel: Kernel
    known: Annotated[Tensor, "float64 n 3"]
    value: Annotated[Tensor, "float n k"] = None  # type: ignore[assignment]
    exact: bool | None = None
    correlation: Annotated[Tensor, "float64 n", Gt(0), Le(1)] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        known = self.known.double()
        correlation = known.new_ones(len(known)) if self.correlation is None else self.correlation.double()
        value = known.new_zeros(len(known), 0) if self.value is None else self.value
        vars(self).update(known=known, value=value, correlation=correlation)

    @property
    def is_exact(self) -> bool:
        """True if every prediction conditions on all positions."""
        return len(self.known) <= MAX_EXACT if self.exact is None else self.exact

    @cached_property
    @torch.inference_mode(False)
    def coefficient(self) -> Tensor:
        """Dual coefficients (n, K), in the precision of the values."""
        return torch.cholesky_solve(self.value.double(), self._factor).to(self.value)

    def updated(self, position: Tensor, value: Tensor) -> GaussianProcess:
        """Return the process with more values (k, K) at positions (k, 3), equal to that of all values.

        The Cholesky factor grows by k rows, in a time proportional to n^2 k (G. H. Golub and C. F. Van Loan, "Matrix
        Computations", 4th ed., 2013, section 6.5.4).
        """
        known = torch.cat([self.known, position.double()])
        correlation = torch.cat([self.correlation, self.correlation.new_ones(len(position))])
        values = torch.cat([self.value, value.to(self.value)])
        process = replace(self, known=known, value=values, correlation=correlation)
        if not (self.is_exact and process.is_exact):
            return process
        n, coefficient, cross = len(self.known), self.coefficient.double(), self._cross(position)
        root = torch.linalg.solve_triangular(self._factor, cross.T, upper=False)  # (n, k)
        corner = torch.linalg.cholesky(self.kernel.covariance(position) - root.T @ root)
        new = torch.cholesky_solve(value.double() - cross @ coefficient, corner)
        weight = torch.linalg.solve_triangular(self._factor.T, root, upper=True)
        factor = corner.new_zeros(len(known), len(known))
        factor[:n, :n], factor[n:, :n], factor[n:, n:] = self._factor, root.T, corner
        return process._with(coefficient=torch.cat([coefficient - weight @ new, new]).to(values), _factor=factor)

    def without(self, rows: Tensor) -> GaussianProcess:
        """Return the process without the values of some rows, by regression on the remaining ones."""
        kept = torch.ones(len(self.known), dtype=torch.bool)
        kept[rows] = False
        return replace(self, known=self.known[kept], value=self.value[kept], correlation=self.correlation[kept])

    def with_kernel(self, kernel: Kernel) -> GaussianProcess:
        """Return the process of the values with another kernel."""
        return replace(self, kernel=kernel)

    def widened(self, count: int) -> GaussianProcess:
        """Return the process with some more columns of values, all 0."""
        return self._with(
            **{name: functional.pad(getattr(self, name), (0, count)) for name in ("value", "coefficient")}
        )

    def aged(self, correlation: float) -> GaussianProcess:
        """Return the process after a change of the field, whose values before and after have the given correlation.

        Covariances of the values stay as they are, and the posterior mean is multiplied by the correlation.
        """
        return self._with(correlation=correlation * self.correlation)

    def _with(self, **changes: Tensor) -> GaussianProcess:
        """Return a copy with other fields or cached properties. All other cached properties must stay valid."""
        process = copy(self)
        vars(process).update(changes)
        return process

    def mean(self, position: Tensor) -> Tensor:
        """Return the posterior mean at positions (m, 3), (m, K), in the precision of the values."""
        if self.is_exact:
            mean: Tensor = self._cross(position).to(self.coefficient) @ self.coefficient
            return mean
        return self.mean_and_variance(position)[0]

    def variance(self, position: Tensor) -> Tensor:
        """Return the posterior variance, without noise, at positions (m, 3), relative to k(0) = 1, float64 (m,)."""
        return self._variance(self._cross(position)) if self.is_exact else self._local(position)[2]

    def _variance(self, cross: Tensor) -> Tensor:
        """Return the posterior variance (m,) at positions by their covariances with the values, (m, n)."""
        root = torch.linalg.solve_triangular(self._factor, cross.T, upper=False)
        variance: Tensor = 1 - root.square().sum(dim=0)
        return variance.clamp(0, 1)

    def _cross(self, position: Tensor) -> Tensor:
        """Return the covariances of the present field at positions (m, 3) with the values, float64 (m, n)."""
        cross: Tensor = self.kernel(position.double(), self.known)
        return cross * self.correlation

    @cached_property
    @torch.inference_mode(False)
    def _factor(self) -> Tensor:
        """Cholesky factor of the covariance of the values, float64 (n, n)."""
        ratio = self.correlation[:, None] / self.correlation
        covariance = self.kernel.covariance(self.known) * torch.minimum(ratio, ratio.T)
        factor: Tensor = torch.linalg.cholesky(covariance)
        return factor

    @cached_property
    def _neighbours(self) -> Neighbours:
        return Neighbours(self.known)

    def mean_and_variance(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return posterior mean (m, K) and variance (m,) at positions (m, 3), by one kernel matrix or one search."""
        if self.is_exact:
            cross = self._cross(position)
            return cross.to(self.coefficient) @ self.coefficient, self._variance(cross)
        number, weight, variance = self._local(position)
        return torch.einsum("mk,mkc->mc", weight, self.value[number].double()), variance

    def _local(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return row numbers (m, k), weights (m, k) and posterior variance (m,) from the nearest positions."""
        position = position.to(self.known)
        number = self._neighbours(position, min(N_NEIGHBOURS, len(self.known)))[1].to(self.known.device)
        near = self.known[number]
        correlation = self.correlation[number]
        ratio = correlation[:, :, None] / correlation[:, None]
        covariance = self.kernel(near, near) * torch.minimum(ratio, ratio.mT)
        cross = self.kernel(position[:, None], near)[:, 0] * correlation
        return number, *local_weights(covariance, cross, self.kernel.noise)


def local_weights(covariance: Tensor, cross: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Return weights (m, k) and posterior variance (m,) from the k values near each of m positions.

    Args:
        covariance: Covariance of the values without noise, (m, k, k).
        cross: Covariance of the values and the field at the positions, (m, k).
        noise: Variance of the noise.
    """
    weight = torch.linalg.solve(covariance + noise * torch.eye(cross.shape[1]).to(cross), cross)
    return weight, (1 - (weight * cross).sum(dim=1)).clamp(0, 1)


def dense_weights(number: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return weights (m, k) of rows `number` (m, k) as unique row numbers (r,) and one weight of each, (m, r).

    Example:
        >>> dense_weights(torch.tensor([[4, 7], [7, 9]]), torch.tensor([[0.5, 0.5], [0.2, 0.8]]))
        (tensor([4, 7, 9]), tensor([[0.5000, 0.5000, 0.0000],
                [0.0000, 0.2000, 0.8000]]))
    """
    rows, column = number.unique(return_inverse=True)
    return rows, weight.new_zeros(len(weight), len(rows)).scatter(1, column, weight)


def leave_folds_out(
    kernel: Kernel, position: Tensor, fold: Tensor, nearest_for: Tensor | None = None
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Yield how a process with mean 0 predicts the rows of each fold from all other folds, without another fit.

    Args:
        kernel: Kernel with its noise.
        position: Positions (n, 3).
        fold: Number of the fold of each row, (n,).
        nearest_for: Numbers of rows that are predicted from their nearest rows only. Defaults to all rows from all others.

    Yields:
        Numbers of the rows that are held out, (o,), and of those that predict them, (k,); the weights of the latter, float64
        (o, k), and the variances of the errors of noisy values, float64 (o,).

    Example:
        >>> position = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * torch.ones(3)
        >>> kernel, fold = Kernel(noise=0.01), torch.arange(20) % 2
        >>> [(out.tolist(), weight.shape) for out, _, weight, _ in leave_folds_out(kernel, position, fold, torch.arange(4))]
        [([0, 2], torch.Size([2, 10])), ([1, 3], torch.Size([2, 10]))]
    """
    if nearest_for is not None:
        for out, others in each_fold(fold, nearest_for):
            near, weight, variance = GaussianProcess(kernel, position[others], exact=False)._local(position[out])
            used, dense = dense_weights(near, weight)
            yield out, others[used], dense, variance + kernel.noise
        return
    precision = torch.linalg.inv(kernel.covariance(position))
    for out, kept in each_fold(fold):
        covariance = torch.linalg.inv(precision[out][:, out])
        weight = -covariance @ precision[out][:, kept]
        yield out, kept, weight, covariance.diagonal()


def leave_folds_out_locally(
    position: Tensor, fold: Tensor, rows: Tensor
) -> tuple[Tensor, Callable[[Kernel], tuple[Tensor, Tensor]]]:
    """Return how processes with mean 0 predict m rows, each from its nearest rows in other folds.

    Args:
        position: Positions (n, d).
        fold: Number of the fold of each row, (n,).
        rows: Numbers of the m rows.

    Returns:
        Numbers (m, k) of the nearest rows, k = 64 or the number of rows outside of the largest fold, and the function from a
        kernel to their weights (m, k) and the posterior variance (m,). Kernels that differ in noise share covariances.

    Example:
        >>> position, fold = torch.rand(20, 3, dtype=torch.float64), torch.arange(20) % 2
        >>> near, weights = leave_folds_out_locally(position, fold, torch.arange(4))
        >>> near.shape, weights(Kernel(noise=0.01))[0].shape
        (torch.Size([4, 10]), torch.Size([4, 10]))
    """
    count = min(N_NEIGHBOURS, len(fold) - int(fold.bincount().max()))
    near = torch.empty(len(fold), count, dtype=torch.int64)
    for out, kept in each_fold(fold, rows):
        near[out] = kept[Neighbours(position[kept])(position[out], count)[1]]
    known = position[near[rows]]
    between, across = distance(known, known), distance(position[rows, None], known)[:, 0]

    @lru_cache(maxsize=1)
    def covariances(kernel: Kernel) -> tuple[Tensor, Tensor]:
        return kernel.at(between), kernel.at(across)

    def weights(kernel: Kernel) -> tuple[Tensor, Tensor]:
        return local_weights(*covariances(replace(kernel, noise=1.0)), kernel.noise)

    return near[rows], weights


def held_out_errors(precision: Tensor, dual: Tensor, out: Tensor) -> Tensor:
    """Return the errors of a group of rows, predicted from all other rows without another fit.

    For a Gaussian vector y with precision P, true minus predicted values of the rows g are inv(P[g, g]) @ (P @ y)[g], with
    covariance inv(P[g, g]) (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq.
    5.12).

    Args:
        precision: Inverse covariance P of the noisy values (..., n, n), of one kernel or of several.
        dual: P @ y, (..., n, m).
        out: Numbers g of the rows that are held out, (o,).

    Returns:
        Errors (..., o, m).

    Example:
        >>> position = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None] * torch.ones(3)
        >>> precision = torch.linalg.inv(Kernel(noise=0.01).covariance(position))
        >>> held_out_errors(precision, precision @ position, torch.tensor([3, 4])).shape
        torch.Size([2, 3])
    """
    errors: Tensor = torch.linalg.solve(precision[..., out[:, None], out], dual[..., out, :])
    return errors
