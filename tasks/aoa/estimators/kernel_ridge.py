"""Regression that is strong where spectra are few."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GridSearchCV, KFold
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional

from augment import Mixed
from swiftwrf.angles import to_angles, to_direction
from swiftwrf.data.spectra import coarsening
from tasks.aoa.estimators.base import ESTIMATORS, Estimator


@ESTIMATORS.register(
    "kernel_ridge", meaning="kernel ridge regression from the spectrum to the direction", colour="#44aa99"
)
class KernelRegression(Estimator):
    """Kernel ridge regression (Saunders et al. 1998) from coarse spectra to unit vectors: strong where spectra are few.

    Width and penalty are chosen by cross-validation on the training spectra.
    """

    AZIMUTHS = 60  # the array's beams are wider than these columns
    CHOSEN_ROWS, KEPT_ROWS = 400, 4000  # its cost grows with their cube

    def fit(self, train: Mixed) -> None:
        order = np.random.default_rng(self.settings.seed).permutation(len(train))[: self.KEPT_ROWS]
        feature = np.concatenate([self._feature(part) for part in train.batches()])[order]
        direction = to_direction(*train.label.unbind(-1)).numpy()[order]
        self._mean = direction.mean(axis=0)
        some = feature[: self.CHOSEN_ROWS]
        apart = ((some[:, None, ::7] - some[None, :, ::7]) ** 2).sum(axis=-1) * 7  # every seventh pixel will do
        width = 1 / max(float(np.median(apart[~np.eye(len(some), dtype=bool)])), 1e-9)
        grid = {"alpha": [1e-4, 1e-3, 1e-2, 1e-1], "gamma": [factor * width for factor in (0.1, 0.3, 1.0, 3.0)]}
        folds = KFold(min(5, len(some)), shuffle=True, random_state=self.settings.seed)
        search = GridSearchCV(KernelRidge(kernel="rbf"), grid, cv=folds, scoring="neg_mean_absolute_error", refit=False)
        with threadpool_limits(1):  # many small problems: several threads would mostly wait for each other
            search.fit(some, direction[: self.CHOSEN_ROWS] - self._mean)
        self._regression = KernelRidge(kernel="rbf", **search.best_params_).fit(feature, direction - self._mean)

    def estimate(self, spectrum: Tensor) -> Tensor:
        pointing = self._regression.predict(self._feature(spectrum)) + self._mean
        return torch.stack(to_angles(torch.from_numpy(pointing)), dim=-1)

    def _feature(self, spectrum: Tensor) -> NDArray[Any]:
        factor = coarsening(spectrum.shape[1:], self.AZIMUTHS)
        coarse: NDArray[Any] = functional.avg_pool2d(spectrum[:, None], factor).flatten(1).double().numpy()
        return coarse
