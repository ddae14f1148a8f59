"""Regression that is strong where spectra are few."""

from __future__ import annotations

import math
from dataclasses import asdict
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

from augment import Mixed
from swiftwrf import InputError
from swiftwrf.angles import AngularGrid, to_angles, to_direction
from swiftwrf.checkpoint import Header, expect
from swiftwrf.data.spectra import coarsening
from tasks.aoa.estimators.base import ESTIMATORS, SavedEstimator, Settings

WIDTHS = (0.1, 0.3, 1.0, 3.0)  # of the kernel, as gamma times the median squared distance
PENALTIES = [1e-4, 1e-3, 1e-2, 1e-1]


@ESTIMATORS.register(
    "kernel_ridge", meaning="kernel ridge regression from the spectrum to the direction", colour="#44aa99"
)
class KernelRegression(SavedEstimator):
    """Kernel ridge regression (Saunders et al. 1998) from coarse spectra to unit vectors: strong where spectra are few.

    Width and penalty are chosen by cross-validation on the training spectra.
    """

    kind = "kernel ridge regression"
    AZIMUTHS = 60  # the array's beams are wider than these columns
    CHOSEN_ROWS, KEPT_ROWS = 400, 4000  # its cost grows with their cube

    def fit(self, train: Mixed) -> None:
        order = np.random.default_rng(self.settings.seed).permutation(len(train))[: self.KEPT_ROWS]
        feature = np.concatenate([self._feature(part) for part in train.batches()])[order]
        direction = to_direction(*train.label.unbind(-1)).numpy()[order]
        self._mean = direction.mean(axis=0)
        chosen = slice(self.CHOSEN_ROWS)
        gamma, alpha = self._choose(feature[chosen], direction[chosen] - self._mean)
        regression = KernelRidge(kernel="rbf", alpha=alpha, gamma=gamma).fit(feature, direction - self._mean)
        self._known, self._weight, self._gamma = feature, regression.dual_coef_, gamma

    def _choose(self, feature: NDArray[Any], offset: NDArray[Any]) -> tuple[float, float]:
        """Width gamma and penalty alpha with the least mean absolute error on held-out rows."""
        apart = euclidean_distances(feature[:, ::7], squared=True) * 7  # every seventh pixel will do
        width = 1 / max(float(np.median(apart[~np.eye(len(feature), dtype=bool)])), 1e-9)
        folds = KFold(min(5, len(feature)), shuffle=True, random_state=self.settings.seed)
        errors: dict[tuple[float, float], float] = {}
        with threadpool_limits(1):  # many small problems: several threads would mostly wait for each other
            for gamma in (factor * width for factor in WIDTHS):
                kernel = rbf_kernel(feature, gamma=gamma)  # one serves all folds and penalties
                for kept, out in folds.split(kernel):
                    known, held = kernel[np.ix_(kept, kept)], kernel[np.ix_(out, kept)]
                    for alpha in PENALTIES:
                        weight = solve(known + alpha * np.eye(len(kept)), offset[kept], assume_a="pos")
                        error = float(np.abs(held @ weight - offset[out]).mean())
                        errors[gamma, alpha] = errors.get((gamma, alpha), 0.0) + error
        return min(errors, key=errors.__getitem__)

    def estimate(self, spectrum: Tensor) -> Tensor:
        pointing = rbf_kernel(self._feature(spectrum), self._known, self._gamma) @ self._weight + self._mean
        return torch.stack(to_angles(torch.from_numpy(pointing)), dim=-1)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        arrays = {"known": self._known, "weight": self._weight, "mean": self._mean}
        tensors = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
        return tensors, {"gamma": self._gamma, "grid": asdict(self.settings.grid)}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> KernelRegression:
        own = cls(Settings(AngularGrid(**header["grid"])))
        n, pixels = len(tensors["known"]), own._feature(torch.zeros(1, *own.settings.grid.shape)).shape[1]
        expect(tensors, {"known": (n, pixels), "weight": (n, 3), "mean": (3,)})
        own._known, own._weight, own._mean = (tensors[name].double().numpy() for name in ("known", "weight", "mean"))
        own._gamma = float(header["gamma"])
        if not (own._gamma > 0 and math.isfinite(own._gamma)):
            raise InputError(f"gamma must be positive and finite, got {own._gamma}")
        return own

    def _feature(self, spectrum: Tensor) -> NDArray[Any]:
        factor = coarsening(spectrum.shape[1:], self.AZIMUTHS)
        coarse: NDArray[Any] = functional.avg_pool2d(spectrum[:, None], factor).flatten(1).double().numpy()
        return coarse
