"""Predictors from the neighbourhood: one of scikit-learn's regressors on the position for each receiver."""

from __future__ import annotations

import warnings
from abc import abstractmethod
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
from swiftwrf.rssi import RssiFitContext, RssiPredictor
from swiftwrf.runtime.threads import parallel_map
from tasks.rssi.predictors.path_loss import Mean, ReceiverPathLoss

# scikit-learn's own choice for many neighbours computes distances from squares and a product, which cancel map coordinates
NEIGHBOUR_SEARCH = "kd_tree"
NEIGHBOUR_COUNTS = (1, 3, 5, 8, 12, 20, 40, 80, 120)
FLOOR_STRETCH = 5.0  # of heights where there are floors, so that neighbours are on one floor
MAX_TUNING_ROWS, MAX_GP_ROWS = 500, 1500  # the cost of the Gaussian process grows with their cube


class ReceiverRegressors(RssiPredictor):
    """Base class: one scikit-learn regressor on the position for each receiver.

    The regressors are fitted to the residual of a simpler predictor, if `_base` returns one, else to the RSSI itself.
    """

    batch_size = 2**20  # scikit-learn bounds its memory itself

    def _base(self, train: Rssi) -> RssiPredictor | None:
        """Return the predictor whose residual is learnt."""
        return None

    @abstractmethod
    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        """Return a regressor fitted to positions (n, 3) and values (n,) of one receiver."""

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        residual, base = train.rssi_dbm, self._base(train)
        self._simpler = base and base.fit(train)
        if self._simpler is not None:
            residual = residual - self._simpler.predict(train.transmitter_position).mean
        at, config = train.transmitter_position, self.config
        fold = folds(at, config.validation, config.seed, session=train.session).numpy()
        self._scale = torch.tensor([1.0, 1.0, FLOOR_STRETCH if train.floors else 1.0], dtype=torch.float64)
        position = (train.transmitter_position * self._scale).numpy()
        mean = float(residual.nanmean())

        def fit(values: NDArray[Any]) -> Any:
            detected = ~np.isnan(values)
            if detected.sum() < MIN_TRAINING:  # too few to choose settings: their mean, or that of all receivers
                level = float(values[detected].mean()) if detected.any() else mean
                return DummyRegressor(strategy="constant", constant=level).fit(position, 0 * position[:, 0])
            own = fold[detected]
            if np.bincount(own).max() == len(own):  # detected in one region only: no other region is left to learn from
                own = np.arange(len(own)) % (fold.max() + 1)
            return self._regressor(position[detected], values[detected], own)

        with warnings.catch_warnings():  # around all: threads share the filters
            warnings.simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is the answer
            self._regressors = parallel_map(fit, residual.numpy().T)

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        if not len(position):  # scikit-learn refuses it
            return torch.zeros(0, len(self._regressors), dtype=torch.float64), None
        x = (position.detach() * self._scale).numpy()
        predicted = torch.from_numpy(np.stack([regressor.predict(x) for regressor in self._regressors], axis=1))
        return predicted if self._simpler is None else predicted + self._simpler.predict(position.detach()).mean, None


class KNNPredictor(ReceiverRegressors):
    """Inverse-distance mean of the k nearest measurements of RSSI; k by cross-validation in the training rows."""

    name = "knn"

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        return choose_neighbours(x, y, fold)


class ResidualKNNPredictor(KNNPredictor):
    """The receiver's path-loss model, and the mean of its nearest residuals.

    It is close to the published MRI (Shin et al., IEEE Transactions on Mobile Computing 14(6), 2015).
    """

    name = "mri_residual"
    requires_receiver_position = True

    def _base(self, train: Rssi) -> RssiPredictor:
        return ReceiverPathLoss()


class GPPredictor(ReceiverRegressors):
    """A Gaussian process on the residual of the receiver's path-loss model.

    Without positions of the receivers it is on the residual of the mean. The kernel is Matern 3/2 and white noise, its
    parameters by marginal likelihood in the training rows (C. E. Rasmussen and C. K. I. Williams, 2006).
    """

    name = "gp"

    def _base(self, train: Rssi) -> RssiPredictor:
        return ReceiverPathLoss() if train.located else Mean()

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        scale = max(float(np.var(y)), 1e-6)
        extent = float(np.ptp(x, axis=0).max()) or 1.0
        length = Matern(extent / 10, (extent / 200, 2.5 * extent), nu=1.5)
        kernel = ConstantKernel(scale / 3, (scale * 1e-3, scale * 10)) * length
        kernel = kernel + WhiteKernel(scale / 2, (scale * 1e-3, scale * 10))
        order = np.random.default_rng(self.config.seed).permutation(len(y))
        tuned, kept = order[:MAX_TUNING_ROWS], order[:MAX_GP_ROWS]
        fitted = GaussianProcessRegressor(kernel, random_state=self.config.seed).fit(x[tuned], y[tuned])
        return GaussianProcessRegressor(fitted.kernel_, optimizer=None).fit(x[kept], y[kept])


def choose_neighbours(x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> KNeighborsRegressor:
    """Return a regressor fitted to coordinates (n, d) and values (n,) whose settings predict held-out folds (n,) best."""
    numbers = np.unique(fold)
    fewest = len(y) - int(np.bincount(fold).max())
    errors = {(k, weights): 0.0 for k in NEIGHBOUR_COUNTS if k <= fewest for weights in ("uniform", "distance")}
    for number in numbers:  # one search for neighbours serves all settings; GridSearchCV repeats it
        out, kept = fold == number, fold != number
        search = NearestNeighbors(n_neighbors=max(errors)[0], algorithm=NEIGHBOUR_SEARCH)
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
    return KNeighborsRegressor(k, weights=weights, algorithm=NEIGHBOUR_SEARCH).fit(x, y)
