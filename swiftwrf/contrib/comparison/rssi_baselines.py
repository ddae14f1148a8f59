"""Baselines for RSSI: the mean, path-loss models, neighbours and Gaussian processes.

Scikit-learn takes a second to load, which a command whose processes fit them does not need.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from swiftwrf.data import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.rssi.base import RssiPredictor, columns_of
from swiftwrf.rssi.detection import Detection
from swiftwrf.rssi.pairs import PairPredictor
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, fit_path_losses, log_distance
from swiftwrf.runtime.threads import parallel_map

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Kernel
    from sklearn.neighbors import KNeighborsRegressor

MAX_TREE_COLUMNS = 15  # of coordinates whose neighbours a tree finds
NEIGHBOUR_COUNTS = (1, 3, 5, 8, 12, 20, 40, 80, 120)
FLOOR_STRETCH = 5.0  # of heights where there are floors, so that neighbours are on one floor
MAX_TUNING_ROWS, MAX_GP_ROWS = 500, 1500  # the cost of the Gaussian process grows with their cube


class Mean(RssiPredictor):
    """The mean of the receiver's training values, at every position.

    A receiver that no training row detected has the mean of the others.
    """

    name = "mean"

    def _fit(self, train: Rssi, **_: Any) -> None:
        self._mean = train.rssi_dbm.nanmean(dim=0).nan_to_num(float(train.rssi_dbm.nanmean()))

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        return self._mean.expand(len(position), -1), None


class SharedPathLoss(RssiPredictor):
    """One log-distance path-loss model for all receivers of the pool, by least squares.

    Receivers of unknown position share one level.

    "MRI" is its name in the NeRF2 repository and, most likely, in the paper's table.
    """

    name = "mri_pooled"
    requires_receiver_position = True

    def _fit(self, train: Rssi, *, pool: Rssi, shift: Tensor, curve: Detection | None, **_: Any) -> None:
        self._receiver, rssi, located = train.receiver_position, pool.rssi_dbm, pool.receiver_located
        distance = log_distance(pool.transmitter_position, pool.receiver_position)
        own, others = (fit_path_loss(distance[:, kind], rssi[:, kind], shared=True) for kind in (located, ~located))
        # without measurements of one kind, the model of the other kind; receivers of unknown position then have the mean
        own, mean = own.where(~own.level.isnan(), fit_path_loss(distance, rssi, shared=True)), rssi.nanmean().reshape(1)
        others = others.where(~others.level.isnan(), PathLoss(mean, torch.zeros_like(mean)))
        here = train.receiver_located
        self._path_loss = PathLoss(*(a.expand(len(here)).where(here, b) for a, b in zip(own, others, strict=True)))

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        return self._path_loss(log_distance(position, self._receiver)), None


class ReceiverPathLoss(SharedPathLoss):
    """A log-distance path-loss model for each receiver, shrunk to that of all receivers."""

    name = "mri_receiver"

    def _fit(self, train: Rssi, *, pool: Rssi, shift: Tensor, curve: Detection | None, **_: Any) -> None:
        self._receiver, at = train.receiver_position, pool.transmitter_position
        found = fit_path_losses(at, pool.receiver_position, pool.rssi_dbm, "auto" if curve else "unknown", shift, curve)
        self._path_loss = found.columns(columns_of(train.receiver_names, pool)).each


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

    def _fit(self, train: Rssi, **_: Any) -> None:
        from sklearn.dummy import DummyRegressor
        from sklearn.exceptions import ConvergenceWarning

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
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

        scale = max(float(np.var(y)), 1e-6)
        extent = float(np.ptp(x, axis=0).max()) or 1.0
        length = Matern(extent / 10, (extent / 200, 2.5 * extent), nu=1.5)
        kernel = ConstantKernel(scale / 3, (scale * 1e-3, scale * 10)) * length
        kernel = kernel + WhiteKernel(scale / 2, (scale * 1e-3, scale * 10))
        return fit_process(kernel, x, y, self.config.seed)


def fit_process(
    kernel: Kernel, x: NDArray[Any], y: NDArray[Any], seed: int, *, normalize: bool = False
) -> GaussianProcessRegressor:
    """Return a Gaussian process fitted to coordinates (n, d) and values (n,) or (n, c).

    The parameters of the kernel maximise the marginal likelihood of 500 random rows, from its values and within its bounds.
    The process is conditioned on 1500 rows. With `normalize`, values are scaled to mean 0 and variance 1.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor

    order = np.random.default_rng(seed).permutation(len(y))
    tuned, kept = order[:MAX_TUNING_ROWS], order[:MAX_GP_ROWS]
    tuning = GaussianProcessRegressor(kernel, normalize_y=normalize, random_state=seed).fit(x[tuned], y[tuned])
    return GaussianProcessRegressor(tuning.kernel_, optimizer=None, normalize_y=normalize).fit(x[kept], y[kept])


def choose_neighbours(x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> KNeighborsRegressor:
    """Return a regressor fitted to coordinates (n, d) and values (n, ...), settings by held-out folds (n,)."""
    from sklearn.neighbors import KNeighborsRegressor, NearestNeighbors

    # scikit-learn's choice for many neighbours computes distances from squares and a product, which cancel map coordinates
    algorithm = "kd_tree" if x.shape[1] <= MAX_TREE_COLUMNS else "auto"
    numbers, values = np.unique(fold), y.reshape(len(y), -1)
    fewest = len(y) - int(np.bincount(fold).max())
    errors = {(k, weights): 0.0 for k in NEIGHBOUR_COUNTS if k <= fewest for weights in ("uniform", "distance")}
    for number in numbers:  # one search for neighbours serves all settings; GridSearchCV repeats it
        out, kept = fold == number, fold != number
        search = NearestNeighbors(n_neighbors=max(errors)[0], algorithm=algorithm)
        distance, row = search.fit(x[kept]).kneighbors(x[out])
        near, truth = values[kept][row], values[out]
        with np.errstate(divide="ignore"):
            inverse = 1 / distance
        inverse = np.where(np.isinf(inverse).any(axis=1, keepdims=True), np.isinf(inverse), inverse)
        for k, weights in errors:
            weight = inverse[:, :k, None] if weights == "distance" else np.ones_like(inverse[:, :k, None])
            predicted = (weight * near[:, :k]).sum(axis=1) / weight.sum(axis=1)
            errors[k, weights] += float(np.linalg.norm(predicted - truth, axis=1).mean()) / len(numbers)
    k, weights = min(errors, key=lambda setting: errors[setting])
    return KNeighborsRegressor(k, weights=weights, algorithm=algorithm).fit(x, y)


class PairKNN(PairPredictor):
    """Inverse-distance mean of the k nearest measured pairs of positions; k by cross-validation in the training rows."""

    name = "knn_pairs"

    def _fit_pairs(self, pair: Tensor, rssi: Tensor, fold: Tensor) -> None:
        self._regressor = choose_neighbours(pair.numpy(), rssi.numpy(), fold.numpy())

    def _at_pairs(self, pair: Tensor) -> tuple[Tensor, None]:
        if not len(pair):  # scikit-learn refuses it
            return pair.new_zeros(0), None
        return from_numpy(self._regressor.predict(pair.detach().numpy())), None
