"""Regression: exact among few positions, by the nearest ones among many, and what it says of values that are held out."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.gp.kernel import Kernel
from swiftwrf.positions import Neighbours

EXACT = 2000  # positions up to which a process is exact; beyond, time and memory would grow with their cube and square
NEAR = 64  # positions that tell of one among many: farther ones hardly change the mean


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


def held_out_errors(precision: Tensor, dual: Tensor, part: Tensor) -> Tensor:
    """Errors of what all other rows say of some, without another fit: P_part^-1 (P y)_part for a Gaussian vector y with
    precision P, whatever the part's own values and noise (Rasmussen and Williams 2006, eq. 5.12, for more than one row).

    Args:
        precision: of the noisy values, (n, n).
        dual: precision @ values, (n,).
        part: numbers of the rows, (k,).
    """
    error: Tensor = torch.linalg.solve(precision.index_select(0, part).index_select(1, part), dual[part])
    return error


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


def held_out_weights(kernel: Kernel, position: Tensor, fold: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For each fold: which rows are out and which are kept, and the weights (out, kept) that predict the former."""
    noisy = kernel.noisy_gram(position)
    covariance = noisy - kernel.noise * torch.eye(len(position), dtype=noisy.dtype)
    for number in fold.unique():
        out, kept = fold == number, fold != number
        yield out, kept, torch.linalg.solve(noisy[kept][:, kept], covariance[kept][:, out]).T
