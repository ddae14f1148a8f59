"""Student distribution of residuals, fitted to held-out ones by cross-validation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

DEGREES = (3.0, 5.0, 10.0, 30.0, math.inf)  # degrees of freedom that are compared
CHUNK = 2**24  # values of observations x candidates x features at a time

Estimator = Callable[[Tensor, Tensor, float], Tensor]  # residuals (n, F), shrinkages (S,), degrees to scales (S, F, F)


@dataclass(frozen=True, eq=False)
class Student:
    """Multivariate Student distribution of F features, of which an observation may lack some.

    Args:
        scale: Scale matrix, float64 (F, F).
        degrees: Degrees of freedom; infinite for a Gaussian.
    """

    scale: Tensor
    degrees: float

    @classmethod
    def fit(cls, residual: Tensor, estimate: Estimator, shrinkages: Sequence[float], n_folds: int) -> Self:
        """Fit to held-out residuals, with the shrinkage and degrees of freedom of the highest held-out density.

        Args:
            residual: Residuals (n, F), NaN where missing.
            estimate: Function that gives the scale matrices.
            shrinkages: Shrinkages of the scale matrix that are compared.
            n_folds: Number of folds of the cross-validation.
        """
        residual, shrinkage = residual.double(), torch.tensor(shrinkages, dtype=torch.float64)
        fold = torch.arange(len(residual)) % n_folds
        zero = torch.zeros(1, residual.shape[1], dtype=torch.float64)
        density = torch.zeros(len(DEGREES), len(shrinkage), dtype=torch.float64)
        for (row, degrees), number in itertools.product(enumerate(DEGREES), range(n_folds)):
            out = residual[fold == number]
            scales = estimate(residual[fold != number], shrinkage, degrees)
            held_out = [cls(scale, degrees).log_likelihood(out, zero, zero + 1).sum() for scale in scales]
            density[row] += torch.stack(held_out)
        best, column = divmod(int(density.argmax()), len(shrinkage))
        return cls(estimate(residual, shrinkage[[column]], DEGREES[best])[0], DEGREES[best])

    @cached_property
    def whitening(self) -> Tensor:
        """Matrix W (F, F) with residuals @ W of unit scale, float32."""
        matrix: Tensor = torch.linalg.inv(torch.linalg.cholesky(self.scale)).T.float()
        return matrix

    def log_density(self, distance: Tensor, count: Tensor | None = None) -> Tensor:
        """Return the log-density of squared whitened distances, without the determinants of scale and whitening.

        Args:
            distance: Squared distances, of any shape.
            count: Number of features of each distance. Defaults to F.
        """
        f = torch.tensor(len(self.scale), dtype=distance.dtype) if count is None else count
        if math.isinf(self.degrees):
            return -distance / 2 - f / 2 * math.log(2 * math.pi)
        half = (self.degrees + f) / 2
        constant = torch.lgamma(half) - math.lgamma(self.degrees / 2) - f / 2 * math.log(self.degrees * math.pi)
        # in place: a search has millions of distances
        return (distance / self.degrees).log1p_().mul_(-half).add_(constant)

    def log_likelihood(self, observed: Tensor, mean: Tensor, std: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of observations at candidates.

        Args:
            observed: Observed features (n, F), NaN where missing.
            mean: Predicted features (m, F).
            std: Their standard deviations (m, F), by which the residuals are divided.
        """
        n, m = len(observed), len(mean)
        distance, determinant = observed.new_zeros(n, m), observed.new_zeros(n, m)
        present = ~observed.isnan()
        patterns, owner = present.unique(dim=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            rows, columns = (owner == number).nonzero()[:, 0], pattern.nonzero()[:, 0]
            if not len(columns):
                continue
            root = torch.linalg.cholesky(self.scale[columns][:, columns])
            whitening = torch.linalg.inv(root).T.to(observed.dtype)
            determinant[rows] = std[:, columns].log().sum(dim=1) + float(root.diagonal().log().sum())
            scaled = mean[:, columns] / std[:, columns]
            for some in rows.split(max(1, CHUNK // (m * len(columns)))):
                error = observed[some][:, columns][:, None] / std[:, columns] - scaled
                distance[some] = (error @ whitening).square().sum(dim=2)
        return self.log_density(distance, present.sum(dim=1, keepdim=True).to(observed.dtype)) - determinant

    def sample(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Sample residuals, float64 (*shape, F)."""
        white = torch.randn(*shape, len(self.scale), generator=generator, dtype=torch.float64)
        noise: Tensor = white @ torch.linalg.cholesky(self.scale).T
        if math.isinf(self.degrees):
            return noise
        # a Student variable is a Gaussian one over the root of a scaled chi-squared one
        rng = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
        chi_squared = torch.from_numpy(rng.chisquare(self.degrees, shape))
        scale: Tensor = (chi_squared / self.degrees).sqrt()
        return noise / scale[..., None]


def covariance(residual: Tensor, shrinkage: Tensor, degrees: float, floor: float) -> Tensor:
    """Return scale matrices (S, F, F) of residuals (n, F), shrunk to multiples of the identity.

    Args:
        residual: Residuals without gaps.
        shrinkage: Weights of the identity, (S,).
        degrees: Degrees of freedom, for which expectation maximisation weights the rows.
        floor: Smallest variance.
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


def correlation(residual: Tensor, shrinkage: Tensor, degrees: float) -> Tensor:
    """Return scale matrices (S, F, F) of standardised residuals (n, F) with gaps, their correlations shrunk to 0.

    They are those of second moments, whatever the degrees of freedom.
    """
    known = (~residual.isnan()).double()
    filled = residual.nan_to_num()
    count = known.T @ known
    product = (filled.T @ filled) / count.clamp_min(1)
    product = product * count / (count + 10.0)  # half of it with 10 common rows
    scale = product.diagonal().clamp_min(0.25).sqrt()
    shape = (1 - shrinkage)[:, None, None] * (product / scale / scale[:, None]).clamp(-0.99, 0.99)
    shape.diagonal(dim1=1, dim2=2).fill_(1)
    value, vector = torch.linalg.eigh(shape)
    positive: Tensor = (vector * value.clamp_min(0.05)[:, None]) @ vector.mT * scale * scale[:, None]
    return positive
