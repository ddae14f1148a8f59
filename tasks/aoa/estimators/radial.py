"""Kernel ridge regression (Saunders et al. 1998) with a normalised Gaussian kernel, width and penalty by cross-validation.

A measured spectrum differs from every synthetic one by noise and by what the synthesizer does not know, which adds much the
same to all its distances. A Gaussian kernel shrinks by it, and what a regression has balanced between many rows no longer
holds. Normalised (Nadaraya 1964, Watson 1964; Moody and Darken 1989) it is as it was, and a narrow one looks at few rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solve
from scipy.special import softmax
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.model_selection import KFold
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from swiftwrf import InputError
from swiftwrf.data.spectra import coarsening
from swiftwrf.runtime.checkpoint import Header, expect

WIDTHS = (10.0, 20.0, 40.0, 80.0)  # of the kernel, as gamma times the median squared distance: narrow ones alone
PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
CHOSEN_ROWS = 600  # choose both; where there are more rows, fewer would choose too large a penalty
KEPT_ROWS = 4000  # its cost grows with their cube
AZIMUTHS = 60  # an array's beams are wider than these columns


def kept_rows(n: int, seed: int) -> NDArray[np.int64]:
    """The rows of so many that a regression is fitted to, in the order in which it looks at them."""
    return np.random.default_rng(seed).permutation(n)[:KEPT_ROWS]


def coarse_pixels(spectrum: Tensor) -> Tensor:
    """Of spectra (n, H, W), as features (n, p) of them."""
    return functional.avg_pool2d(spectrum[:, None], coarsening(spectrum.shape[1:], AZIMUTHS)).flatten(1)


@dataclass(frozen=True, eq=False)
class RadialRegression:
    """A function of features that `fit` found: a mean over the rows that it knows, the near ones above all.

    Args:
        known: features of those rows, (n, p).
        says: what each of them says, (n, k).
        gamma: of the kernel exp(-gamma |a - b|^2).
    """

    known: NDArray[Any]
    says: NDArray[Any]
    gamma: float

    @classmethod
    def fit(cls, feature: NDArray[Any], target: NDArray[Any], seed: int) -> RadialRegression:
        """From features (n, p) to values (n, k).

        Args:
            feature, target: of at least two rows; the first of many choose width and penalty.
            seed: of the folds.
        """
        apart = euclidean_distances(feature, squared=True)
        gamma, alpha = choose(apart[:CHOSEN_ROWS, :CHOSEN_ROWS], target[:CHOSEN_ROWS], seed)
        return cls(feature, _says(np.exp(-gamma * apart), target, alpha), gamma)

    def __call__(self, feature: NDArray[Any]) -> NDArray[Any]:
        """Values (m, k) of features (m, p)."""
        values: NDArray[Any] = _near(euclidean_distances(feature, self.known, squared=True), self.gamma) @ self.says
        return values

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """What a file keeps: tensors in single precision, and plain values."""
        arrays = {"known": self.known, "says": self.says}
        return {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}, {
            "gamma": self.gamma
        }

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header, features: int, values: int) -> RadialRegression:
        """That of which `state` gave these.

        Args:
            tensors, header: from a file; others among them play no part.
            features, values: p and k.

        Raises:
            InputError: they do not fit together.
        """
        expect(tensors, {"known": (n := len(tensors["known"]), features), "says": (n, values)})
        gamma = float(header["gamma"])
        if not (gamma > 0 and math.isfinite(gamma)):
            raise InputError(f"gamma must be positive and finite, got {gamma}")
        return cls(tensors["known"].double().numpy(), tensors["says"].double().numpy(), gamma)


def choose(apart: NDArray[Any], target: NDArray[Any], seed: int) -> tuple[float, float]:
    """Width gamma and penalty alpha with the least mean absolute error on held-out rows.

    Args:
        apart: squared distances of rows from each other, (n, n).
        target: their values, (n, k).
        seed: of the folds.
    """
    width = 1 / max(float(np.median(apart[~np.eye(len(apart), dtype=bool)])), 1e-9)
    folds = KFold(min(5, len(apart)), shuffle=True, random_state=seed)
    errors: dict[tuple[float, float], float] = {}
    with threadpool_limits(1):  # many small problems: several threads would mostly wait for each other
        for gamma in (factor * width for factor in WIDTHS):
            kernel = np.exp(-gamma * apart)
            for kept, out in folds.split(kernel):
                known, near = kernel[np.ix_(kept, kept)], _near(apart[np.ix_(out, kept)], gamma)  # for all penalties
                for alpha in PENALTIES:
                    error = float(np.abs(near @ _says(known, target[kept], alpha) - target[out]).mean())
                    errors[gamma, alpha] = errors.get((gamma, alpha), 0.0) + error
    return min(errors, key=errors.__getitem__)


def _near(apart: NDArray[Any], gamma: float) -> NDArray[Any]:
    """How much each known row counts, (m, n), by squared distances from it: the kernel divided by the sums of its rows."""
    near: NDArray[Any] = softmax(-gamma * apart, axis=1)
    return near


def _says(kernel: NDArray[Any], target: NDArray[Any], alpha: float) -> NDArray[Any]:
    """What rows have to say, (n, k), for means of it to come to their values.

    With K, the kernel (n, n) divided by the sums of its rows, these are (1 + alpha) (K + alpha)^-1 times the values: where
    the penalty is small means go through all values, where it is large rows say their values, and constants stay anyway.
    """
    sums = kernel.sum(axis=1)
    says: NDArray[Any] = solve(kernel + np.diag(alpha * sums), sums[:, None] * target, assume_a="pos")
    return (1 + alpha) * says
