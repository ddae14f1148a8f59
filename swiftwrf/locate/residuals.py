"""Distribution of residuals, fitted to held-out ones."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

SHRINKAGES = (0.05, 0.1, 0.2, 0.4, 0.7)  # of a covariance towards a multiple of the identity, that are compared
FOLDS, EM_STEPS = 5, 8
DEGREES = (3.0, 5.0, 10.0, 30.0, math.inf)  # degrees of freedom that are compared
FLOOR = 1e-6  # of a residual's variance, relative to the features' own


@dataclass(frozen=True, eq=False)
class ResidualDistribution:
    """Multivariate Student distribution of residuals (n, F), fitted to held-out ones.

    Args:
        whitening: Matrix W with residuals @ W of unit variance, float32 (F, F).
        degrees: Degrees of freedom; infinite for a Gaussian.
    """

    whitening: Tensor
    degrees: float

    @classmethod
    def fit(cls, residual: Tensor, size: float) -> ResidualDistribution:
        """Fit covariance and degrees of freedom; cross-validation chooses these and the shrinkage of the covariance.

        Args:
            residual: Held-out residuals (n, F).
            size: Mean square of the features, for the floor of the variance.
        """
        residual = residual.double()
        fold = torch.arange(len(residual)) % FOLDS

        def score(setting: tuple[float, float]) -> float:
            total = 0.0
            for number in range(FOLDS):
                root = _root(residual[fold != number], size, *setting)
                distance = (
                    torch.linalg.solve_triangular(root, residual[fold == number].T, upper=False).square().sum(dim=0)
                )
                density = _log_density(distance, len(root), setting[1]) - root.diagonal().log().sum()
                total += float(density.sum())
            return total

        best = max(itertools.product(SHRINKAGES, DEGREES), key=score)
        return cls(torch.linalg.inv(_root(residual, size, *best)).T.float(), best[1])

    def log_density(self, distance: Tensor) -> Tensor:
        """Return the log-density of squared whitened distances, up to a constant."""
        return _log_density(distance, len(self.whitening), self.degrees)


def _log_density(distance: Tensor, f: int, degrees: float) -> Tensor:
    if math.isinf(degrees):
        return -distance / 2 - f / 2 * math.log(2 * math.pi)
    constant = math.lgamma((degrees + f) / 2) - math.lgamma(degrees / 2) - f / 2 * math.log(degrees * math.pi)
    return constant - (degrees + f) / 2 * torch.log1p(distance / degrees)


def _root(residual: Tensor, size: float, shrinkage: float, degrees: float) -> Tensor:
    """Return the Cholesky factor of the scale matrix (F, F) of residuals (n, F), shrunk to a multiple of the identity."""
    n, f = residual.shape
    weight = torch.ones(n, dtype=residual.dtype)
    for _ in range(1 if math.isinf(degrees) else EM_STEPS):  # expectation maximisation
        scatter = (weight[:, None] * residual).T @ residual / n
        mean = scatter.diagonal().mean()
        scatter = (1 - shrinkage) * scatter + (shrinkage * mean + FLOOR * size) * torch.eye(f, dtype=scatter.dtype)
        root: Tensor = torch.linalg.cholesky(scatter)
        if not math.isinf(degrees):
            distance = torch.linalg.solve_triangular(root, residual.T, upper=False).square().sum(dim=0)
            weight = (degrees + f) / (degrees + distance)
    return root
