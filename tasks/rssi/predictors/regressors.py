"""Predictors from the neighbourhood: one of scikit-learn's regressors on the position for each receiver."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.dummy import DummyRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.neighbors import KNeighborsRegressor, NearestNeighbors
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.runtime.threads import side_by_side
from tasks.rssi.predictors.base import PREDICTORS, Predictor, Settings
from tasks.rssi.predictors.laws import LogDistance, Mean

# scikit-learn's own choice for many neighbours takes distances from squares and a product, which map coordinates cancel
SEARCH = "kd_tree"
NEIGHBOURS = (1, 3, 5, 8, 12, 20, 40, 80, 120)
TUNED_ROWS, KEPT_ROWS = 500, 1500  # of the Gaussian process: its cost grows with their cube


class _PerReceiver(ABC):
    """One scikit-learn regressor on the position for each receiver, on RSSI itself or on what a simpler predictor leaves."""

    def __init__(self, settings: Settings) -> None:
        self._validation, self._seed = settings.validation, settings.seed

    def _simpler(self, train: Rssi) -> Predictor | None:
        """The predictor whose residuals are learnt."""
        return None

    def fit(self, train: Rssi) -> None:
        residual = train.rssi_dbm
        self._base = self._simpler(train)
        if self._base is not None:
            self._base.fit(train)
            residual = residual - self._base.predict(train.transmitter_position)
        fold = folds(train.transmitter_position, self._validation, self._seed).numpy()
        position = train.transmitter_position.numpy()
        typical = float(residual.nanmean())

        def fit(values: NDArray[Any]) -> Any:
            heard = ~np.isnan(values)
            if heard.sum() < MIN_TRAINING:  # too few to choose anything: their mean, or that of all
                level = float(values[heard].mean()) if heard.any() else typical
                return DummyRegressor(strategy="constant", constant=level).fit(position, 0 * position[:, 0])
            own = fold[heard]
            if np.bincount(own).max() == len(own):  # heard in one region alone: no region is left to learn from
                own = np.arange(len(own)) % (fold.max() + 1)
            return self._regressor(position[heard], values[heard], own)

        with warnings.catch_warnings():  # around all: threads share the filters
            warnings.simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is the answer
            self._regressors = side_by_side(fit, residual.numpy().T)

    @abstractmethod
    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        """A regressor fitted to one receiver's positions (n, 3) and values (n,)."""

    def predict(self, position: Tensor) -> Tensor:
        x = position.double().numpy()
        predicted = torch.from_numpy(np.stack([regressor.predict(x) for regressor in self._regressors], axis=1))
        return predicted if self._base is None else predicted + self._base.predict(position)


@PREDICTORS.register("knn")
class NearestNeighbours(_PerReceiver):
    """Inverse-distance mean of the k nearest measurements of RSSI; k by cross-validation in the training rows."""

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        numbers = np.unique(fold)
        fewest = len(y) - int(np.bincount(fold).max())
        errors = {(k, weights): 0.0 for k in NEIGHBOURS if k <= fewest for weights in ("uniform", "distance")}
        for number in numbers:  # one search for neighbours serves all settings, as GridSearchCV would not
            out, kept = fold == number, fold != number
            search = NearestNeighbors(n_neighbors=max(errors)[0], algorithm=SEARCH)
            distance, row = search.fit(x[kept]).kneighbors(x[out])
            near = y[kept][row]
            with np.errstate(divide="ignore"):
                inverse = 1 / distance
            inverse = np.where(np.isinf(inverse).any(axis=1, keepdims=True), np.isinf(inverse), inverse)
            for k, weights in errors:
                weight = inverse[:, :k] if weights == "distance" else np.ones_like(inverse[:, :k])
                predicted = (weight * near[:, :k]).sum(axis=1) / weight.sum(axis=1)
                errors[k, weights] += float(np.abs(predicted - y[out]).mean()) / len(numbers)
        k, weights = min(errors, key=lambda setting: errors[setting])
        return KNeighborsRegressor(k, weights=weights, algorithm=SEARCH).fit(x, y)


@PREDICTORS.register("mri_residual")
class NearestResiduals(NearestNeighbours):
    """The same of what the log-distance law of the receiver leaves (near to the published MRI: Shin et al., IEEE TMC 14(6),
    2015)."""

    def _simpler(self, train: Rssi) -> Predictor:
        return LogDistance(pooled=False)


@PREDICTORS.register("gp")
class GaussianProcess(_PerReceiver):
    """A Gaussian process on what the log-distance law of the receiver leaves, or its mean where the receiver's position is
    unknown: Matern 3/2 and white noise, hyper-parameters by marginal likelihood in the training rows (C. E. Rasmussen and
    C. K. I. Williams, 2006)."""

    def _simpler(self, train: Rssi) -> Predictor:
        return LogDistance(pooled=False) if train.located else Mean()

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        scale = max(float(np.var(y)), 1e-6)
        kernel = ConstantKernel(scale / 3, (scale * 1e-3, scale * 10)) * Matern(2.0, (0.1, 50.0), nu=1.5)
        kernel = kernel + WhiteKernel(scale / 2, (scale * 1e-3, scale * 10))
        order = np.random.default_rng(self._seed).permutation(len(y))
        tuned, kept = order[:TUNED_ROWS], order[:KEPT_ROWS]
        fitted = GaussianProcessRegressor(kernel, random_state=self._seed).fit(x[tuned], y[tuned])
        return GaussianProcessRegressor(fitted.kernel_, optimizer=None).fit(x[kept], y[kept])
