"""Predictors of RSSI at every receiver from the transmitter's position: what practitioners use, and SwiftWRF."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor
from swiftwrf.fit import folds
from swiftwrf.fit_config import Validation
from torch import Tensor

from swiftwrf import InputError, Rssi, RssiConfig, RssiModel, fit_rssi
from swiftwrf.rssi import log_distance

NEIGHBOURS = (1, 3, 5, 8, 12, 20, 40, 80, 120)
TUNED_ROWS, KEPT_ROWS = 500, 1500  # of the Gaussian process: its cost grows with their cube


class Predictor(Protocol):
    """Learns from rows where RSSI was heard, then tells it at any position."""

    def fit(self, train: Rssi) -> None:
        """Learns; `train` is all it ever sees."""

    def predict(self, position: Tensor) -> Tensor:
        """RSSI (n, R) [dBm] at transmitter positions (n, 3) [m]."""


class Mean:
    """The mean of each receiver's training values, wherever the transmitter is."""

    def fit(self, train: Rssi) -> None:
        self._mean = train.rssi_dbm.nanmean(dim=0)

    def predict(self, position: Tensor) -> Tensor:
        return self._mean.expand(len(position), -1)


class LogDistance:
    """RSSI = T - 10 gamma log10 d by least squares (the log-distance law; "MRI" in the NeRF2 repository and, most likely,
    in the paper's table), with one T and gamma for all receivers, or one for each.

    Args:
        pooled: one law for all receivers.
    """

    def __init__(self, pooled: bool) -> None:
        self._pooled = pooled

    def fit(self, train: Rssi) -> None:
        self._receiver = train.receiver_position
        distance, n = log_distance(train.transmitter_position, self._receiver), len(train.receiver_names)
        laws = []
        for columns in [list(range(n))] * n if self._pooled else [[r] for r in range(n)]:
            heard = ~train.rssi_dbm[:, columns].isnan()
            x = distance[:, columns][heard][:, None].numpy()
            laws.append(LinearRegression().fit(x, train.rssi_dbm[:, columns][heard].numpy()))
        self._level = torch.tensor([law.intercept_ for law in laws], dtype=torch.float64)
        self._slope = torch.tensor([law.coef_[0] for law in laws], dtype=torch.float64)

    def predict(self, position: Tensor) -> Tensor:
        return self._level + self._slope * log_distance(position, self._receiver)


class _PerReceiver(ABC):
    """One scikit-learn regressor on the position for each receiver, on what a log-distance law leaves or on RSSI itself."""

    def __init__(self, validation: Validation, seed: int, on_law: bool) -> None:
        self._validation: Validation = validation
        self._seed = seed
        self._law: Predictor | None = LogDistance(pooled=False) if on_law else None

    def fit(self, train: Rssi) -> None:
        residual = train.rssi_dbm
        if self._law is not None:
            self._law.fit(train)
            residual = residual - self._law.predict(train.transmitter_position)
        fold = folds(train.transmitter_position, self._validation, self._seed).numpy()
        position = train.transmitter_position.numpy()
        self._regressors = []
        for values in residual.numpy().T:
            heard = ~np.isnan(values)
            self._regressors.append(self._regressor(position[heard], values[heard], fold[heard]))

    @abstractmethod
    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        """A regressor fitted to one receiver's positions (n, 3) and values (n,)."""

    def predict(self, position: Tensor) -> Tensor:
        x = position.double().numpy()
        predicted = torch.from_numpy(np.stack([regressor.predict(x) for regressor in self._regressors], axis=1))
        return predicted if self._law is None else predicted + self._law.predict(position)


class NearestNeighbours(_PerReceiver):
    """Inverse-distance mean of the k nearest measurements of RSSI, or of what the log-distance law of the receiver leaves
    (near to the published MRI: Shin et al., IEEE TMC 14(6), 2015); k by cross-validation in the training rows."""

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        fewest = len(y) - int(np.bincount(fold).max())
        grid = {"n_neighbors": [k for k in NEIGHBOURS if k <= fewest], "weights": ["uniform", "distance"]}
        search = GridSearchCV(KNeighborsRegressor(), grid, scoring="neg_mean_absolute_error", cv=PredefinedSplit(fold))
        return search.fit(x, y)


class GaussianProcess(_PerReceiver):
    """A Gaussian process on what the log-distance law of the receiver leaves: Matern 3/2 and white noise, hyper-parameters
    by marginal likelihood in the training rows (C. E. Rasmussen and C. K. I. Williams, 2006)."""

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        scale = max(float(np.var(y)), 1e-6)
        kernel = ConstantKernel(scale / 3, (scale * 1e-3, scale * 10)) * Matern(2.0, (0.1, 50.0), nu=1.5)
        kernel = kernel + WhiteKernel(scale / 2, (scale * 1e-3, scale * 10))
        order = np.random.default_rng(self._seed).permutation(len(y))
        tuned, kept = order[:TUNED_ROWS], order[:KEPT_ROWS]
        fitted = GaussianProcessRegressor(kernel, random_state=self._seed).fit(x[tuned], y[tuned])
        return GaussianProcessRegressor(fitted.kernel_, optimizer=None).fit(x[kept], y[kept])


class SwiftWRFPredictor:
    """The model of this package; all receivers at once."""

    def __init__(self, config: RssiConfig, **options: Any) -> None:
        self._config, self._options = config, options

    def fit(self, train: Rssi) -> None:
        self.model: RssiModel = fit_rssi(train, self._config, **self._options)

    def predict(self, position: Tensor) -> Tensor:
        return self.model.predict(position)[0]


PREDICTORS = ("swiftwrf", "mean", "mri_pooled", "mri_receiver", "mri_residual", "knn", "gp")


def make_predictor(
    name: str, *, validation: Validation, seed: int, preset: str = "default", **options: Any
) -> Predictor:
    """The predictor of that name.

    Args:
        name: one of `PREDICTORS`.
        validation: how training rows are held out to choose settings.
        seed: of what is random.
        preset: of SwiftWRF: `default`, or `paper` for the plain head.
        options: device and parallel of `fit_rssi`.

    Raises:
        InputError: an unknown name.
    """
    if name == "mean":
        return Mean()
    if name in ("mri_pooled", "mri_receiver"):
        return LogDistance(pooled=name == "mri_pooled")
    if name in ("mri_residual", "knn"):
        return NearestNeighbours(validation, seed, on_law=name == "mri_residual")
    if name == "gp":
        return GaussianProcess(validation, seed, on_law=True)
    if name == "swiftwrf":
        make = RssiConfig.paper if preset == "paper" else RssiConfig
        return SwiftWRFPredictor(make(validation=validation, seed=seed), **options)
    raise InputError(f"unknown predictor {name!r}; choose from {', '.join(PREDICTORS)}")
