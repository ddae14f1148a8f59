"""Distribution of residuals, fitted to held-out ones."""

from __future__ import annotations

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
        kept = (fold != torch.arange(FOLDS)[:, None]).double()
        density = torch.stack([_held_out_density(residual, kept, size, degrees) for degrees in DEGREES])
        degrees, shrinkage = divmod(int(density.argmax()), len(SHRINKAGES))
        everything = torch.ones(1, len(residual), dtype=torch.float64)
        chosen = torch.tensor(SHRINKAGES[shrinkage : shrinkage + 1], dtype=torch.float64)
        root = _roots(residual, everything, size, chosen, DEGREES[degrees])[0]
        return cls(torch.linalg.inv(root).T.float(), DEGREES[degrees])

    def log_density(self, distance: Tensor) -> Tensor:
        """Return the log-density of squared whitened distances, up to a constant."""
        return _log_density(distance, len(self.whitening), self.degrees)


def _log_density(distance: Tensor, f: int, degrees: float) -> Tensor:
    if math.isinf(degrees):
        return -distance / 2 - f / 2 * math.log(2 * math.pi)
    constant = math.lgamma((degrees + f) / 2) - math.lgamma(degrees / 2) - f / 2 * math.log(degrees * math.pi)
    # in place: a search has millions of distances
    return (distance / degrees).log1p_().mul_(-(degrees + f) / 2).add_(constant)


def _held_out_density(residual: Tensor, kept: Tensor, size: float, degrees: float) -> Tensor:
    """Return the log-density of the rows outside each fold, for each shrinkage (S,), with folds as 0/1 weights (B, n)."""
    shrinkage = torch.tensor(SHRINKAGES, dtype=torch.float64).repeat_interleave(len(kept))
    weight = kept.repeat(len(SHRINKAGES), 1)
    root = _roots(residual, weight, size, shrinkage, degrees)
    volume = root.diagonal(dim1=1, dim2=2).log().sum(dim=1, keepdim=True)
    density = _log_density(_squared_distance(root, residual), residual.shape[1], degrees) - volume
    return ((1 - weight) * density).sum(dim=1).reshape(len(SHRINKAGES), -1).sum(dim=1)


def _roots(residual: Tensor, kept: Tensor, size: float, shrinkage: Tensor, degrees: float) -> Tensor:
    """Return Cholesky factors of scale matrices, shrunk to multiples of the identity.

    Args:
        residual: Residuals (n, F).
        kept: 1 for the rows that each matrix is fitted to, 0 for the others, (B, n).
        size: Mean square of the features.
        shrinkage: Shrinkage of each matrix, (B,).
        degrees: Degrees of freedom.

    Returns:
        Lower triangular matrices (B, F, F).
    """
    f = residual.shape[1]
    weight, identity = kept, torch.eye(f, dtype=residual.dtype)
    for _ in range(1 if math.isinf(degrees) else EM_STEPS):  # expectation maximisation
        scatter = (residual.T * weight[:, None]) @ residual / kept.sum(dim=1)[:, None, None]
        mean = scatter.diagonal(dim1=1, dim2=2).mean(dim=1)
        scatter = (1 - shrinkage)[:, None, None] * scatter
        root: Tensor = torch.linalg.cholesky(scatter + (shrinkage * mean + FLOOR * size)[:, None, None] * identity)
        if not math.isinf(degrees):
            weight = kept * (degrees + f) / (degrees + _squared_distance(root, residual))
    return root


def _squared_distance(root: Tensor, residual: Tensor) -> Tensor:
    """Return squared Mahalanobis distances (B, n) of residuals (n, F) for Cholesky factors (B, F, F)."""
    white: Tensor = torch.linalg.solve_triangular(root, residual.T, upper=False)
    return white.square().sum(dim=1)
