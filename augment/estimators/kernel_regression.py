"""Kernel regression with Nadaraya-Watson weights, width and penalty by cross-validation.

A prediction is the mean of dual coefficients, weighted by a Gaussian kernel whose weights sum to one. With the targets as
dual coefficients it is the estimator of Nadaraya (1964) and Watson (1964). The dual coefficients here reproduce the targets
up to a penalty, as those of a normalised radial basis function network do (Moody and Darken 1989).

Measurement noise and model error add a nearly constant offset to the squared distances between a measured spectrum and all
synthetic ones, which multiplies every Gaussian kernel value by the same factor. Normalising each kernel row cancels that
factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Gt, Lt
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import softmax
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.model_selection import KFold
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from augment import Mixed
from augment.estimators.base import ESTIMATORS, Estimator
from swiftwrf import InputError
from swiftwrf.array.angles import to_angles, to_direction
from swiftwrf.data.spectra import coarsening
from swiftwrf.runtime.checkpoint import Saved

WIDTH_CANDIDATES = (10.0, 20.0, 40.0, 80.0)  # gamma times the median squared distance
PENALTY_CANDIDATES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
MIN_MEDIAN = 1e-4  # of squared distances, relative to their mean, that gives a width
MAX_CHOICE_ROWS = 600  # rows of the cross-validation; with fewer rows it chooses too large a penalty
MAX_ROWS = 4000  # training rows; the time of a fit grows with their cube
MAX_AZIMUTHS = 60  # columns of coarse spectra; the beams of an array are wider than one of them
BATCH_SPECTRA = 512  # spectra that are loaded at a time


def kept_rows(n: int, seed: int) -> NDArray[np.int64]:
    """Return the row numbers, of n rows in random order, that a regression is fitted to."""
    return np.random.default_rng(seed).permutation(n)[:MAX_ROWS]


def coarse_pixels(spectrum: Tensor) -> Tensor:
    """Return spectra (n, H, W) averaged to at most 60 azimuths, as features (n, p)."""
    return functional.avg_pool2d(spectrum[:, None], coarsening(spectrum.shape[1:], MAX_AZIMUTHS)).flatten(1)


@dataclass(frozen=True, eq=False)
class NadarayaWatson:
    """A fitted regression: the prediction is the mean of dual coefficients, weighted by the normalised kernel.

    Example:
        >>> x = np.linspace(0, 1, 20)[:, None]
        >>> bool(np.abs(NadarayaWatson.fit(x, x, seed=0)(x) - x).max() < 0.05)
        True
    """

    known: Annotated[Tensor, "float n p"]  # features of the training rows
    dual: Annotated[Tensor, "float64 n k"]  # dual coefficients of the training rows
    gamma: Annotated[float, Gt(0), Lt(math.inf)]  # inverse squared width of the kernel exp(-gamma |a - b|^2)

    @classmethod
    def fit(cls, feature: NDArray[Any], target: NDArray[Any], seed: int) -> NadarayaWatson:
        """Fit a regression from features (n, p) to values (n, k).

        Args:
            feature: Features of at least two rows. The first 600 rows choose width and penalty.
            target: Values of these rows.
            seed: Seed of the folds.
        """
        # rounding errors grow with the length of rows; between equal ones they would make the kernel indefinite
        distance = euclidean_distances(feature - feature.mean(axis=0), squared=True)
        some = slice(MAX_CHOICE_ROWS)
        gamma, alpha = choose(distance[some, some], target[some], seed)
        dual = _dual_coefficients(np.exp(-gamma * distance), target, alpha)
        return cls(torch.from_numpy(feature), torch.from_numpy(dual), gamma)

    def __call__(self, feature: NDArray[Any]) -> NDArray[Any]:
        """Return the predicted values (m, k) of features (m, p)."""
        known, dual = self._arrays
        distance = euclidean_distances(feature, known, squared=True)
        values: NDArray[Any] = _normalised_kernel(distance, self.gamma) @ dual
        return values

    @cached_property
    def _arrays(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return self.known.double().numpy(), self.dual.numpy()

    def check(self, n_features: int, n_values: int) -> None:
        """Refuse a regression from a file that has other numbers of features or values.

        Raises:
            InputError: It has.
        """
        if (size := (self.known.shape[1], self.dual.shape[1])) != (n_features, n_values):
            raise InputError(f"a regression of {n_features} features and {n_values} values has {size}")


def choose(distance: NDArray[Any], target: NDArray[Any], seed: int) -> tuple[float, float]:
    """Return the width gamma and the penalty alpha with the least mean absolute error on held-out rows.

    Args:
        distance: Squared distances between the rows, (n, n), in double precision. In single precision products of small
            kernel values are denormal numbers, which take ten times as long.
        target: Values of the rows, (n, k).
        seed: Seed of the folds.
    """
    apart = distance[~np.eye(len(distance), dtype=bool)]
    typical, mean = float(np.median(apart)), float(apart.mean())
    # if most rows are nearly equal, e.g. of a constant field model, their median distance is far below that of the others
    width = 1 / max(typical if typical > MIN_MEDIAN * mean else mean, 1e-9)
    folds = KFold(min(5, len(distance)), shuffle=True, random_state=seed)
    errors: dict[tuple[float, float], float] = {}
    with threadpool_limits(1):  # many small problems: several threads would mostly wait for each other
        for gamma in (factor * width for factor in WIDTH_CANDIDATES):
            kernel = np.exp(-gamma * distance)
            for kept, out in folds.split(kernel):
                known, weight = kernel[np.ix_(kept, kept)], _normalised_kernel(distance[np.ix_(out, kept)], gamma)
                for alpha in PENALTY_CANDIDATES:
                    predicted = weight @ _dual_coefficients(known, target[kept], alpha)
                    error = float(np.abs(predicted - target[out]).mean())
                    errors[gamma, alpha] = errors.get((gamma, alpha), 0.0) + error
    return min(errors, key=errors.__getitem__)


def _normalised_kernel(distance: NDArray[Any], gamma: float) -> NDArray[Any]:
    """Return the kernel (m, n) divided by its row sums, from squared distances (m, n) to the training rows."""
    weight: NDArray[Any] = softmax(-gamma * distance, axis=1)
    return weight


def _dual_coefficients(kernel: NDArray[Any], target: NDArray[Any], alpha: float) -> NDArray[Any]:
    """Return dual coefficients (n, k) whose row-normalised kernel average reproduces the targets.

    With K, the kernel (n, n) divided by its row sums, they are (1 + alpha) (K + alpha)^-1 times the targets. A small penalty
    interpolates the targets, a large one gives the targets themselves, and constant targets are reproduced exactly.
    """
    sums = kernel.sum(axis=1)
    by_columns = (kernel + np.diag(alpha * sums)).T  # the symmetric matrix in LAPACK's order, which needs no copy
    factor = cho_factor(by_columns, lower=True, overwrite_a=True, check_finite=False)
    dual: NDArray[Any] = cho_solve(factor, sums[:, None] * target, check_finite=False)
    return (1 + alpha) * dual


@ESTIMATORS.register("kernel_regression")
class KernelRegression(Estimator, Saved):
    """Kernel regression from coarse spectra to directions, accurate for few training spectra.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=40)
        >>> KernelRegression(seed=1).fit(Mixed.measured(room)).predict(room.spectrum).shape
        torch.Size([40, 2])
    """

    kind = "kernel regression"
    saved = "_direction"
    _direction: NadarayaWatson

    def _fit(self, train: Mixed, device: torch.device) -> None:
        rows = torch.from_numpy(kept_rows(len(train), self.config.seed))
        features = np.concatenate([_features(train.select(some)) for some in rows.split(BATCH_SPECTRA)])
        direction = to_direction(*train.label[rows].unbind(-1)).numpy()
        fitted = NadarayaWatson.fit(features, direction, self.config.seed)
        self._direction = replace(fitted, known=fitted.known.float())  # as the spectra are

    def predict(self, spectra: Tensor) -> Tensor:
        return torch.stack(to_angles(torch.from_numpy(self._direction(_features(spectra)))), dim=-1)

    def _restored(self) -> None:
        self._direction.check(_features(torch.zeros(1, *self.grid.shape)).shape[1], 3)


def _features(spectra: Tensor) -> NDArray[Any]:
    coarse: NDArray[Any] = coarse_pixels(spectra).double().numpy()
    return coarse
