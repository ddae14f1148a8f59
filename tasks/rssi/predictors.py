"""Predictors of RSSI at every receiver from the transmitter's position: what practitioners use, and SwiftWRF."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack, vstack
from sklearn.dummy import DummyRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.neighbors import KNeighborsRegressor, NearestNeighbors
from threadpoolctl import threadpool_limits
from torch import Tensor

from swiftwrf import InputError, Rssi, RssiConfig, RssiModel, comparison, fit_rssi
from swiftwrf.comparison import NeRF2RssiConfig
from swiftwrf.data.splits import MIN_TRAINING, Validation, folds
from swiftwrf.registry import Registry
from swiftwrf.rssi import Map, fit_law, log_distance

NEIGHBOURS = (1, 3, 5, 8, 12, 20, 40, 80, 120)
TUNED_ROWS, KEPT_ROWS = 500, 1500  # of the Gaussian process: its cost grows with their cube


class Predictor(Protocol):
    """Learns from rows where RSSI was heard, then tells it at any position."""

    def fit(self, train: Rssi) -> None:
        """Learns; `train` is all it ever sees."""

    def predict(self, position: Tensor) -> Tensor:
        """RSSI (n, R) [dBm] at transmitter positions (n, 3) [m]."""


@dataclass(frozen=True)
class Settings:
    """What a predictor is made from.

    Args:
        validation: how training rows are held out to choose its settings.
        seed: of what is random.
        preset: of SwiftWRF and NeRF2: `quick`, or `paper` for the plain head and the published field.
        device: where these compute.
        parallel: how SwiftWRF's groups of receivers are mapped.
        pool: the training rows at every receiver of the data; those asked for unless given.
    """

    validation: Validation = "random"
    seed: int = 0
    preset: Literal["quick", "paper"] = "quick"
    device: torch.device | str = "cpu"
    parallel: Map = map
    pool: Rssi | None = None


PREDICTORS = Registry[Predictor]("predictor")
SLOW = ("nerf2", "blend")  # compared only where they are asked for
BLENDED = ("swiftwrf", "gp", "knn", "mri_residual")
MOST_PAIRS = 5000  # that the weights of a blend are found on


RECEIVERS = "positions of the receivers"  # what predictors of the log-distance law need of the data


def lacks(name: str, data: Rssi) -> str:
    """Why a predictor cannot be had of these data, in a sentence; nothing where it can."""
    if RECEIVERS in PREDICTORS[name].needs and not data.located:
        return f"{name} needs the {RECEIVERS}, which {data.name} does not tell"
    return ""


class Mean:
    """The mean of each receiver's training values, wherever the transmitter is."""

    def fit(self, train: Rssi) -> None:
        # a receiver never heard in the training part has the mean of the others
        self._mean = train.rssi_dbm.nanmean(dim=0).nan_to_num(float(train.rssi_dbm.nanmean()))

    def predict(self, position: Tensor) -> Tensor:
        return self._mean.expand(len(position), -1)


class LogDistance:
    """RSSI = T - 10 gamma log10 d by least squares (the log-distance law; "MRI" in the NeRF2 repository and, most likely,
    in the paper's table), for each receiver, or one for all.

    Args:
        pooled: one law for all receivers.
        pool: the rows that the law of all is fitted to; None: those that `fit` is given. It also stands for the law of a
            receiver never heard.
    """

    def __init__(self, pooled: bool, pool: Rssi | None = None) -> None:
        self._pooled, self._pool = pooled, pool

    def fit(self, train: Rssi) -> None:
        if not train.located:
            raise InputError(f"the log-distance law needs the {RECEIVERS}, which {train.name} does not tell")
        self._receiver = train.receiver_position
        rows = self._pool or train
        self._law = fit_law(log_distance(rows.transmitter_position, rows.receiver_position), rows.rssi_dbm, pooled=True)
        if not self._pooled:
            own = fit_law(log_distance(train.transmitter_position, self._receiver), train.rssi_dbm)
            self._law = own.where((~train.rssi_dbm.isnan()).any(dim=0), self._law)

    def predict(self, position: Tensor) -> Tensor:
        return self._law(log_distance(position, self._receiver))


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
        self._regressors = []
        typical = float(residual.nanmean())
        for values in residual.numpy().T:
            heard = ~np.isnan(values)
            if heard.sum() < MIN_TRAINING:  # too few to choose anything: their mean, or that of all
                level = float(values[heard].mean()) if heard.any() else typical
                self._regressors.append(
                    DummyRegressor(strategy="constant", constant=level).fit(position, 0 * position[:, 0])
                )
                continue
            own = fold[heard]
            if np.bincount(own).max() == len(own):  # heard in one region alone: no region is left to learn from
                own = np.arange(len(own)) % (fold.max() + 1)
            self._regressors.append(self._regressor(position[heard], values[heard], own))

    @abstractmethod
    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        """A regressor fitted to one receiver's positions (n, 3) and values (n,)."""

    def predict(self, position: Tensor) -> Tensor:
        x = position.double().numpy()
        predicted = torch.from_numpy(np.stack([regressor.predict(x) for regressor in self._regressors], axis=1))
        return predicted if self._base is None else predicted + self._base.predict(position)


class NearestNeighbours(_PerReceiver):
    """Inverse-distance mean of the k nearest measurements of RSSI; k by cross-validation in the training rows."""

    def _regressor(self, x: NDArray[Any], y: NDArray[Any], fold: NDArray[Any]) -> Any:
        numbers = np.unique(fold)
        fewest = len(y) - int(np.bincount(fold).max())
        errors = {(k, weights): 0.0 for k in NEIGHBOURS if k <= fewest for weights in ("uniform", "distance")}
        for number in numbers:  # one search for neighbours serves all settings, as GridSearchCV would not
            out, kept = fold == number, fold != number
            distance, row = NearestNeighbors(n_neighbors=max(errors)[0]).fit(x[kept]).kneighbors(x[out])
            near = y[kept][row]
            with np.errstate(divide="ignore"):
                inverse = 1 / distance
            inverse = np.where(np.isinf(inverse).any(axis=1, keepdims=True), np.isinf(inverse), inverse)
            for k, weights in errors:
                weight = inverse[:, :k] if weights == "distance" else np.ones_like(inverse[:, :k])
                predicted = (weight * near[:, :k]).sum(axis=1) / weight.sum(axis=1)
                errors[k, weights] += float(np.abs(predicted - y[out]).mean()) / len(numbers)
        k, weights = min(errors, key=lambda setting: errors[setting])
        return KNeighborsRegressor(k, weights=weights).fit(x, y)


class NearestResiduals(NearestNeighbours):
    """The same of what the log-distance law of the receiver leaves (near to the published MRI: Shin et al., IEEE TMC 14(6),
    2015)."""

    def _simpler(self, train: Rssi) -> Predictor:
        return LogDistance(pooled=False)


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
        with threadpool_limits(1):  # many small systems, for which threads mostly wait for each other
            fitted = GaussianProcessRegressor(kernel, random_state=self._seed).fit(x[tuned], y[tuned])
            return GaussianProcessRegressor(fitted.kernel_, optimizer=None).fit(x[kept], y[kept])


class SwiftWRFPredictor:
    """The model of this package; all receivers at once."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def fit(self, train: Rssi) -> None:
        given = self._settings
        config = RssiConfig.paper if given.preset == "paper" else RssiConfig
        self.model: RssiModel = fit_rssi(
            train,
            config(validation=given.validation, seed=given.seed),
            pool=given.pool,
            device=given.device,
            parallel=given.parallel,
        )

    def predict(self, position: Tensor) -> Tensor:
        return self.model.predict(position)[0]


class NeRF2Predictor:
    """A neural field that all receivers share."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def fit(self, train: Rssi) -> None:
        given = self._settings
        config = NeRF2RssiConfig.paper() if given.preset == "paper" else NeRF2RssiConfig()
        self._model = comparison.fit_rssi(train, replace(config, seed=given.seed), device=given.device)

    def predict(self, position: Tensor) -> Tensor:
        return self._model.predict(position)


class Blend:
    """A weighted mean of the best predictors. The weights, the same at all receivers, are those with the least absolute
    error on held-out training rows (stacking: L. Breiman, "Stacked regressions", Machine Learning 24, 1996)."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def fit(self, train: Rssi) -> None:
        names = [name for name in BLENDED if not lacks(name, train)]
        fold = folds(train.transmitter_position, self._settings.validation, self._settings.seed)
        held_out = torch.full((len(names), *train.rssi_dbm.shape), torch.nan, dtype=torch.float64)
        for number in fold.unique():
            out = fold == number
            place = train.transmitter_position[out]
            for i, name in enumerate(names):
                held_out[i, out] = self._fitted(name, train, (~out).nonzero()[:, 0]).predict(place).double()
        heard = ~train.rssi_dbm.isnan()
        self.weights = dict(zip(names, self._weights(held_out[:, heard].T, train.rssi_dbm[heard]), strict=True))
        self._members = {
            name: self._fitted(name, train, torch.arange(len(train)))
            for name, weight in self.weights.items()
            if weight > 0
        }

    def _fitted(self, name: str, train: Rssi, rows: Tensor) -> Predictor:
        """A member, fitted to some rows."""
        pool = self._settings.pool
        predictor = PREDICTORS[name].make(replace(self._settings, pool=pool and pool.subset(rows)))
        predictor.fit(train.subset(rows))
        return predictor

    def _weights(self, predicted: Tensor, measured: Tensor) -> list[float]:
        """Non-negative, of sum 1, for predictions (n, m) of n values: a linear programme in weights and absolute errors."""
        some = np.random.default_rng(self._settings.seed).permutation(len(measured))[:MOST_PAIRS]
        known, values = csr_array(predicted.numpy()[some]), measured.numpy()[some]
        n, m = known.shape
        size = eye_array(n)
        result = linprog(
            c=np.concatenate([np.zeros(m), np.ones(n)]),
            A_ub=vstack([hstack([known, -size]), hstack([-known, -size])]),
            b_ub=np.concatenate([values, -values]),
            A_eq=np.concatenate([np.ones(m), np.zeros(n)])[None],
            b_eq=[1.0],
        )
        weight: list[float] = result.x[:m].tolist()
        return weight

    def predict(self, position: Tensor) -> Tensor:
        parts = [self.weights[name] * member.predict(position).double() for name, member in self._members.items()]
        return torch.stack(parts).sum(dim=0)


@PREDICTORS.register(
    "swiftwrf",
    meaning="50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance law; "
    "mixed with the laws and the mean as held-out rows say",
    colour="#4477aa",
)
def _swiftwrf(settings: Settings) -> Predictor:
    return SwiftWRFPredictor(settings)


@PREDICTORS.register("mean", meaning="the mean of the receiver's training values", colour="#bbbbbb")
def _mean(settings: Settings) -> Predictor:
    return Mean()


@PREDICTORS.register(
    "mri_pooled",
    meaning="one log-distance law for all receivers of the data",
    needs=(RECEIVERS,),
    colour="#ee6677",
)
def _mri_pooled(settings: Settings) -> Predictor:
    return LogDistance(pooled=True, pool=settings.pool)


@PREDICTORS.register(
    "mri_receiver",
    meaning="a log-distance law for each receiver",
    needs=(RECEIVERS,),
    colour="#ee8866",
)
def _mri_receiver(settings: Settings) -> Predictor:
    return LogDistance(pooled=False)


@PREDICTORS.register(
    "mri_residual",
    meaning="the same, and what it leaves interpolated from the nearest measurements",
    needs=(RECEIVERS,),
    colour="#ccbb44",
)
def _mri_residual(settings: Settings) -> Predictor:
    return NearestResiduals(settings)


@PREDICTORS.register("knn", meaning="inverse-distance mean of the nearest measurements", colour="#66ccee")
def _knn(settings: Settings) -> Predictor:
    return NearestNeighbours(settings)


@PREDICTORS.register(
    "gp",
    meaning="a Gaussian process on what the log-distance law leaves (the mean, where receivers have no position)",
    colour="#228833",
)
def _gp(settings: Settings) -> Predictor:
    return GaussianProcess(settings)


@PREDICTORS.register(
    "nerf2",
    meaning="a neural field for all receivers, its rays averaged (NeRF2)",
    needs=(RECEIVERS,),
    colour="#44aa99",
)
def _nerf2(settings: Settings) -> Predictor:
    return NeRF2Predictor(settings)


@PREDICTORS.register(
    "blend",
    meaning=f"a weighted mean of {', '.join(BLENDED)}, its weights from held-out training rows",
    colour="#332288",
)
def _blend(settings: Settings) -> Predictor:
    return Blend(settings)
