"""Kernel ridge regression (Saunders et al. 1998) with a Gaussian kernel, its width and penalty by cross-validation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solve
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances, rbf_kernel
from sklearn.model_selection import KFold
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from swiftwrf import InputError
from swiftwrf.checkpoint import Header, expect
from swiftwrf.data.spectra import coarsening

WIDTHS = (0.1, 0.3, 1.0, 3.0)  # of the kernel, as gamma times the median squared distance
PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
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
    """A function of features that `fit` found.

    Args:
        known: features of the rows that it was fitted to, (n, p).
        weight: of each of them in each of k values, (n, k).
        gamma: of the kernel exp(-gamma |a - b|^2).
    """

    known: NDArray[Any]
    weight: NDArray[Any]
    gamma: float

    @classmethod
    def fit(cls, feature: NDArray[Any], target: NDArray[Any], chosen: int, seed: int) -> RadialRegression:
        """From features (n, p) to values (n, k).

        Args:
            feature, target: of at least two rows.
            chosen: how many of them, the first, choose width and penalty.
            seed: of the folds.
        """
        gamma, alpha = choose(feature[:chosen], target[:chosen], seed)
        regression = KernelRidge(kernel="rbf", alpha=alpha, gamma=gamma).fit(feature, target)
        return cls(feature, regression.dual_coef_, gamma)

    def __call__(self, feature: NDArray[Any]) -> NDArray[Any]:
        """Values (m, k) of features (m, p)."""
        values: NDArray[Any] = rbf_kernel(feature, self.known, self.gamma) @ self.weight
        return values

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """What a file keeps: tensors in single precision, and plain values."""
        arrays = {"known": self.known, "weight": self.weight}
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
        n = len(tensors["known"])
        expect(tensors, {"known": (n, features), "weight": (n, values)})
        gamma = float(header["gamma"])
        if not (gamma > 0 and math.isfinite(gamma)):
            raise InputError(f"gamma must be positive and finite, got {gamma}")
        return cls(tensors["known"].double().numpy(), tensors["weight"].double().numpy(), gamma)


def choose(feature: NDArray[Any], target: NDArray[Any], seed: int) -> tuple[float, float]:
    """Width gamma and penalty alpha with the least mean absolute error on held-out rows."""
    apart = euclidean_distances(feature[:, ::7], squared=True) * 7  # every seventh feature will do
    width = 1 / max(float(np.median(apart[~np.eye(len(feature), dtype=bool)])), 1e-9)
    folds = KFold(min(5, len(feature)), shuffle=True, random_state=seed)
    errors: dict[tuple[float, float], float] = {}
    with threadpool_limits(1):  # many small problems: several threads would mostly wait for each other
        for gamma in (factor * width for factor in WIDTHS):
            kernel = rbf_kernel(feature, gamma=gamma)  # one serves all folds and penalties
            for kept, out in folds.split(kernel):
                known, held = kernel[np.ix_(kept, kept)], kernel[np.ix_(out, kept)]
                for alpha in PENALTIES:
                    weight = solve(known + alpha * np.eye(len(kept)), target[kept], assume_a="pos")
                    error = float(np.abs(held @ weight - target[out]).mean())
                    errors[gamma, alpha] = errors.get((gamma, alpha), 0.0) + error
    return min(errors, key=errors.__getitem__)
