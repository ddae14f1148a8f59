"""Student distribution of residuals, fitted to held-out ones by cross-validation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

DEGREES = (3.0, 5.0, 10.0, 30.0, math.inf)  # degrees of freedom that are compared

Estimator = Callable[[Tensor, Tensor, float], Tensor]  # residuals (n, F), shrinkages (S,), degrees to scales (S, F, F)


@dataclass(frozen=True, eq=False)
class Student:
    """Multivariate Student distribution of F features.

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
            residual: Residuals (n, F).
            estimate: Function that gives the scale matrices.
            shrinkages: Shrinkages of the scale matrix that are compared.
            n_folds: Number of folds of the cross-validation.
        """
        residual, shrinkage = residual.double(), torch.tensor(shrinkages, dtype=torch.float64)
        fold = torch.arange(len(residual)) % n_folds
        density = torch.zeros(len(DEGREES), len(shrinkage), dtype=torch.float64)
        for (row, degrees), number in itertools.product(enumerate(DEGREES), range(n_folds)):
            out = residual[fold == number]
            scales = estimate(residual[fold != number], shrinkage, degrees)
            held_out = [cls(scale, degrees).log_likelihood(out).sum() for scale in scales]
            density[row] += torch.stack(held_out)
        best, column = divmod(int(density.argmax()), len(shrinkage))
        return cls(estimate(residual, shrinkage[[column]], DEGREES[best])[0], DEGREES[best])

    @cached_property
    def whitening(self) -> Tensor:
        """Matrix W (F, F) with residuals @ W of unit scale, float32."""
        matrix: Tensor = torch.linalg.inv(torch.linalg.cholesky(self.scale)).T.float()
        return matrix

    def log_density(self, distance: Tensor) -> Tensor:
        """Return the log-density of squared whitened distances, without the determinants of scale and whitening.

        Args:
            distance: Squared distances, of any shape.
        """
        f = len(self.scale)
        if math.isinf(self.degrees):
            normal: Tensor = -distance / 2 - f / 2 * math.log(2 * math.pi)
            return normal
        half = (self.degrees + f) / 2
        constant = math.lgamma(half) - math.lgamma(self.degrees / 2) - f / 2 * math.log(self.degrees * math.pi)
        # in place: a search has millions of distances
        density: Tensor = (distance / self.degrees).log1p_().mul_(-half).add_(constant)
        return density

    def log_likelihood(self, residual: Tensor) -> Tensor:
        """Return the log-likelihoods (n,) of residuals (n, F), float64."""
        root = torch.linalg.cholesky(self.scale)
        white = torch.linalg.solve_triangular(root, residual.T, upper=False)
        return self.log_density(white.square().sum(dim=0)) - root.diagonal().log().sum()


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
