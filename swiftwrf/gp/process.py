"""Gaussian-process regression: exact among few positions, local among many, and leave-group-out predictions."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import asdict
from functools import cached_property

import torch
from torch import Tensor, nn

from swiftwrf.errors import InputError
from swiftwrf.gp.kernel import Kernel
from swiftwrf.positions import Neighbours
from swiftwrf.runtime.checkpoint import Header, expect

MAX_EXACT = 2000  # positions up to which a process is exact; time and memory grow with their cube and square
N_NEIGHBOURS = 64  # positions that a local prediction conditions on; farther ones hardly change the mean


class GaussianProcess:
    """Regression with a given kernel and prior mean 0.

    Among more than 2000 positions, a prediction conditions on the nearest 64 only (local Gaussian process: R. B. Gramacy and
    D. W. Apley, Journal of Computational and Graphical Statistics 24, 2015).

    Args:
        kernel: Kernel with its noise.
        known: Positions of the values (n, 3).
        coefficient: Dual coefficients of an exact process, values of a local one, (n, K); needed by `mean` only. See
            `regress`.
        exact: Whether every prediction conditions on all positions. Defaults to n <= 2000.
        correlation: Correlation of the field at the time of each value with the present field, (n,), from above 0 to 1,
            ascending. Defaults to 1. Between two values of correlations a <= b it is a / b (autoregressive in time).

    Example:
        >>> position = torch.rand(20, 3, dtype=torch.float64)
        >>> process = GaussianProcess.regress(Kernel(noise=1e-6), position, position.sum(dim=1, keepdim=True))
        >>> bool((process.mean(position)[:, 0] - position.sum(dim=1)).abs().max() < 1e-2)
        True
    """

    def __init__(
        self,
        kernel: Kernel,
        known: Tensor,
        coefficient: Tensor | None = None,
        exact: bool | None = None,
        correlation: Tensor | None = None,
    ) -> None:
        self.kernel, self.known, self.coefficient = kernel, known.double(), coefficient
        self._asked_exact, self.exact = exact, len(known) <= MAX_EXACT if exact is None else exact
        self.correlation = self.known.new_ones(len(known)) if correlation is None else correlation.double()

    @classmethod
    def regress(
        cls,
        kernel: Kernel,
        known: Tensor,
        value: Tensor,
        exact: bool | None = None,
        dtype: torch.dtype = torch.float64,
        correlation: Tensor | None = None,
    ) -> GaussianProcess:
        """Return the process of values (n, K) at known positions (n, 3), with coefficients of the given type."""
        process = cls(kernel, known, value.to(dtype), exact, correlation)
        if process.exact:
            process.value = value.to(dtype)
            process.coefficient = torch.cholesky_solve(value.double(), process._factor).to(dtype)
        return process

    @cached_property
    def value(self) -> Tensor:
        """Values (n, K) that the process was regressed on, in the precision of the coefficients."""
        assert self.coefficient is not None
        if not self.exact:
            return self.coefficient
        return (self._factor @ (self._factor.T @ self.coefficient.double())).to(self.coefficient)

    def updated(self, position: Tensor, value: Tensor) -> GaussianProcess:
        """Return the process with more values (k, K) at positions (k, 3), equal to `regress` on all values.

        The Cholesky factor grows by k rows, in a time proportional to n^2 k (G. H. Golub and C. F. Van Loan, "Matrix
        Computations", 4th ed., 2013, section 6.5.4).
        """
        assert self.coefficient is not None
        known = torch.cat([self.known, position.double()])
        correlation = torch.cat([self.correlation, self.correlation.new_ones(len(position))])
        options = self._asked_exact, self.coefficient.dtype, correlation
        if not self.exact or not (self._asked_exact or len(known) <= MAX_EXACT):
            return self.regress(self.kernel, known, torch.cat([self.value, value.to(self.coefficient)]), *options)
        n, coefficient = len(self.known), self.coefficient.double()
        cross = self._cross(position)
        root = torch.linalg.solve_triangular(self._factor, cross.T, upper=False)  # (n, k)
        corner = torch.linalg.cholesky(self.kernel.covariance(position) - root.T @ root)
        new = torch.cholesky_solve(value.double() - cross @ coefficient, corner)
        weight = torch.linalg.solve_triangular(self._factor.T, root, upper=True)
        coefficient = torch.cat([coefficient - weight @ new, new]).to(self.coefficient)
        process = GaussianProcess(self.kernel, known, coefficient, self._asked_exact, correlation)
        factor = corner.new_zeros(len(known), len(known))
        factor[:n, :n], factor[n:, :n], factor[n:, n:] = self._factor, root.T, corner
        process._factor, process.value = factor, torch.cat([self.value, value.to(coefficient)])
        return process

    def without(self, rows: Tensor) -> GaussianProcess:
        """Return the process without the values of some rows, by regression on the remaining ones."""
        assert self.coefficient is not None
        kept = torch.ones(len(self.known), dtype=torch.bool)
        kept[rows] = False
        options = self._asked_exact, self.coefficient.dtype, self.correlation[kept]
        return self.regress(self.kernel, self.known[kept], self.value[kept], *options)

    def with_kernel(self, kernel: Kernel) -> GaussianProcess:
        """Return the process of the values with another kernel."""
        assert self.coefficient is not None
        options = self._asked_exact, self.coefficient.dtype, self.correlation
        return self.regress(kernel, self.known, self.value, *options)

    def widened(self, count: int) -> GaussianProcess:
        """Return the process with some more columns of values, all 0."""
        process = copy(self)
        process.coefficient, process.value = (
            nn.functional.pad(torch.as_tensor(x), (0, count)) for x in (self.coefficient, self.value)
        )
        return process

    def aged(self, correlation: float) -> GaussianProcess:
        """Return the process after a change of the field, whose values before and after have the given correlation.

        Covariances of the values stay as they are, and the posterior mean is multiplied by the correlation.
        """
        process = copy(self)
        process.correlation = correlation * self.correlation
        return process

    def mean(self, position: Tensor) -> Tensor:
        """Return the posterior mean at positions (m, 3), (m, K), in the precision of the coefficients."""
        assert self.coefficient is not None
        if self.exact:
            mean: Tensor = self._cross(position).to(self.coefficient) @ self.coefficient
            return mean
        return self.local(position)[0]

    def weights(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posterior mean at positions (m, 3) as a linear function of the values.

        Returns:
            Row numbers (r,) of the values that count, and their weights, float64 (m, r).
        """
        if self.exact:
            weight = torch.cholesky_solve(self._cross(position).T, self._factor).T
            return torch.arange(len(self.known)), weight
        number, weight, _ = self._local(position)
        return dense_weights(number, weight)

    def variance(self, position: Tensor) -> Tensor:
        """Return the posterior variance, without noise, at positions (m, 3), relative to k(0) = 1, float64 (m,)."""
        if not self.exact:
            return self._local(position)[2]
        root = torch.linalg.solve_triangular(self._factor, self._cross(position).T, upper=False)
        variance: Tensor = 1 - root.square().sum(dim=0)
        return variance.clamp(0, 1)

    def state(self, prefix: str = "") -> tuple[dict[str, Tensor], Header]:
        """Return positions and coefficients, and the kernel as plain values, with names that begin with `prefix`."""
        assert self.coefficient is not None
        tensors = {f"{prefix}position": self.known, f"{prefix}coefficient": self.coefficient}
        if bool((self.correlation < 1).any()):
            tensors[f"{prefix}correlation"] = self.correlation
        return tensors, {f"{prefix}kernel": asdict(self.kernel)}

    @classmethod
    def from_state(
        cls, tensors: dict[str, Tensor], header: Header, dtype: torch.dtype, exact: bool | None = None, prefix: str = ""
    ) -> GaussianProcess:
        """Return the process of a state, with coefficients of the given type.

        Raises:
            InputError: Tensors of other sizes, or a kernel outside its range.
        """
        known, coefficient = tensors[f"{prefix}position"], tensors[f"{prefix}coefficient"]
        n = len(known)
        expect(tensors, {f"{prefix}position": (n, 3), f"{prefix}coefficient": (n, *coefficient.shape[1:2])})
        correlation = tensors.get(f"{prefix}correlation", known.new_ones(n))
        expect({"correlation": correlation}, {"correlation": (n,)})
        if not bool(((correlation > 0) & (correlation <= 1)).all()):
            raise InputError("correlation in time must be above 0 and at most 1")
        return cls(Kernel(**header[f"{prefix}kernel"]), known, coefficient.to(dtype), exact, correlation)

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

    def local(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean (m, K) and variance (m,) at positions from the nearest known ones, whatever their number."""
        assert self.coefficient is not None
        number, weight, variance = self._local(position)
        return torch.einsum("mk,mkc->mc", weight, self.coefficient[number].double()), variance

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


def held_out_neighbours(
    kernel: Kernel, position: Tensor, fold: Tensor, rows: Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Yield how the nearest rows of other folds predict some rows, fold by fold.

    Args:
        kernel: Kernel of a process with mean 0.
        position: Positions (n, 3).
        fold: Number of the group that each row is held out with, (n,).
        rows: Row numbers (m,).

    Yields:
        Row numbers (b,) of one fold, row numbers (r,) of the values that predict them, weights float64 (b, r), and
        variances of the noisy values, float64 (b,).

    Example:
        >>> position = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * torch.ones(3)
        >>> parts = held_out_neighbours(Kernel(noise=0.01), position, torch.arange(20) % 2, torch.arange(4))
        >>> [(own.tolist(), len(others), weight.shape) for own, others, weight, _ in parts]
        [([0, 2], 10, torch.Size([2, 10])), ([1, 3], 10, torch.Size([2, 10]))]
    """
    for number in fold[rows].unique():
        own, others = rows[fold[rows] == number], (fold != number).nonzero()[:, 0]
        near, weight, variance = GaussianProcess(kernel, position[others], exact=False)._local(position[own])
        used, dense = dense_weights(near, weight)
        yield own, others[used], dense, variance + kernel.noise


class LeaveGroupOut:
    """Prediction of a group of rows from all other rows without another fit.

    For a Gaussian vector y with precision P, the errors at the rows g are inv(P[g, g]) @ (P @ y)[g], with covariance
    inv(P[g, g]) (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 5.12).

    Args:
        precision: Inverse covariance of the noisy values (n, n).
        out: Numbers of the rows that are held out, (o,).

    Example:
        >>> position = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None] * torch.ones(3)
        >>> precision = torch.linalg.inv(Kernel(noise=0.01).covariance(position))
        >>> group = LeaveGroupOut(precision, torch.tensor([3, 4]))
        >>> group.errors(precision @ position[:, 0]).shape, group.covariance.shape
        (torch.Size([2]), torch.Size([2, 2]))
    """

    def __init__(self, precision: Tensor, out: Tensor) -> None:
        self.precision, self.out = precision, out
        self._block = precision.index_select(0, out).index_select(1, out)

    @classmethod
    def each(cls, kernel: Kernel, position: Tensor, fold: Tensor) -> Iterator[LeaveGroupOut]:
        """Yield one group for each fold of a process with mean 0 at positions (n, 3) with fold numbers (n,)."""
        precision = torch.linalg.inv(kernel.covariance(position))
        for number in fold.unique():
            yield cls(precision, (fold == number).nonzero()[:, 0])

    @cached_property
    def covariance(self) -> Tensor:
        """Covariance of the errors (o, o)."""
        covariance: Tensor = torch.linalg.inv(self._block)
        return covariance

    @cached_property
    def kept(self) -> Tensor:
        """Numbers of the other rows, (k,)."""
        held = torch.zeros(len(self.precision), dtype=torch.bool)
        held[self.out] = True
        return (~held).nonzero()[:, 0]

    @property
    def weights(self) -> Tensor:
        """Weights (o, k) with which the other rows predict the group."""
        return -self.covariance @ self.precision.index_select(0, self.out).index_select(1, self.kept)

    def errors(self, dual: Tensor) -> Tensor:
        """Return true minus predicted values (o, ...) from precision @ values (n, ...)."""
        errors: Tensor = torch.linalg.solve(self._block, dual[self.out])
        return errors


def held_out(kernel: Kernel, position: Tensor, fold: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Return predictions (n, K) of values (n, K) without their folds, and variances of the noisy values, float64 (n,).

    Args:
        kernel: Kernel of a process with mean 0.
        position: Positions (n, 3).
        fold: Number of the group that each row is held out with, (n,).
        value: Values (n, K).

    Example:
        >>> position = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * torch.ones(3)
        >>> predicted, variance = held_out(Kernel(noise=0.01), position, torch.arange(20) % 5, position[:, :1])
        >>> predicted.shape, variance.shape
        (torch.Size([20, 1]), torch.Size([20]))
    """
    predicted, variance = torch.empty_like(value, dtype=torch.float64), torch.empty(len(value), dtype=torch.float64)
    dual: Tensor | None = None
    for group in LeaveGroupOut.each(kernel, position, fold):
        dual = group.precision @ value.double() if dual is None else dual
        predicted[group.out] = value[group.out].double() - group.errors(dual)
        variance[group.out] = group.covariance.diagonal()
    return predicted, variance
