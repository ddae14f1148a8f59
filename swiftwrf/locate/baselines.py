"""Localizers: the position of a transmitter from one row of RSSI, by the posterior and by the usual baselines."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.splits import Validation, folds
from swiftwrf.locate.rssi import NEIGHBOUR_COUNTS, UNDETECTED_BELOW_DB, RssiLocator
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, configuration

LEVELS = (0.5, 0.8, 0.95)  # probabilities of the credible regions
BATCH_ROWS = 128  # rows of RSSI whose posteriors are in memory together
MIN_DISTANCE_DB = 0.1  # between fingerprints, so that weights stay finite
MAX_TUNING_ROWS, MAX_REGRESSION_ROWS = 500, 1500  # the cost of Gaussian-process regression grows with their cube


@configuration
class LocalizerConfig:
    """Options of all localizers."""

    validation: Validation = "random"
    """training rows held out to choose settings: single ones at random, or one region at a time"""
    n_cells: PositiveInt = 4000
    """number of candidate positions of a posterior"""
    seed: NonNegativeInt = 0
    """seed of everything random"""


@dataclass(frozen=True, eq=False)
class Located:
    """Estimated positions of n rows.

    Args:
        position: Estimates, float64 (n, 3) [m].
        radius: Radii of the credible regions of `LEVELS` around the estimates, (n, 3) [m]. None without a posterior.
        ambiguous: True where a second position is likely, bool (n,). None without a posterior.
    """

    position: Tensor
    radius: Tensor | None = None
    ambiguous: Tensor | None = None


class Localizer(ABC):
    """Base class: `fit` to measured rows, then `locate` others.

    Args:
        config: Options as one object. Defaults to `LocalizerConfig()`.
        options: Single options, which replace those of `config`.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> LOCALIZERS["knn"](seed=3).fit(train).locate(test.rssi_dbm).position.shape
        torch.Size([12, 3])
    """

    name: ClassVar[str]

    def __init__(self, config: LocalizerConfig | None = None, **options: Any) -> None:
        self.config = replace(config or LocalizerConfig(), **options)

    @abstractmethod
    def fit(self, train: Rssi) -> Self:
        """Fit to measured rows and return the localizer."""

    @abstractmethod
    def locate(self, rssi: Tensor) -> Located:
        """Return the positions of rows of RSSI (n, R) [dBm], NaN if not detected; each row has a value."""


LOCALIZERS: Registry[Localizer] = Registry("localizer", "swiftwrf.localizers")


@LOCALIZERS.register("posterior")
class PosteriorLocalizer(Localizer):
    """The median of the posterior over positions, given the radio maps of all receivers."""

    name = "posterior"

    locator: RssiLocator
    """locator, set by `fit`"""

    def fit(self, train: Rssi) -> Self:
        config = self.config
        locator = RssiLocator(validation=config.validation, n_cells=config.n_cells, seed=config.seed)
        self.locator = locator.fit(train, progress=True)
        return self

    def locate(self, rssi: Tensor) -> Located:
        parts = [located(self.locator, rows) for rows in rssi.split(BATCH_ROWS)]
        return Located(*(torch.cat(values) for values in zip(*parts, strict=True)))


def located(locator: RssiLocator, rssi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return estimates, radii and ambiguity of some rows of RSSI (n, R) [dBm]."""
    posterior = locator.locate(rssi)
    radius = torch.stack([posterior.credible_radius(level) for level in LEVELS], dim=1)
    return posterior.median, radius, posterior.ambiguous


class FingerprintLocalizer(Localizer):
    """Base class: a regression from fingerprints, rows of RSSI in which undetected values are filled, to positions.

    The filled value is 5 dB below the weakest one of the training rows.
    """

    def fit(self, train: Rssi) -> Self:
        train = train.subset(train.detected.any(dim=1))
        relative = self._relative(train.rssi_dbm)
        self._undetected = float(relative[~relative.isnan()].min()) - UNDETECTED_BELOW_DB
        fold = folds(train.transmitter_position, self.config.validation, self.config.seed, session=train.session)
        self._regress(self._fingerprint(train.rssi_dbm), train.transmitter_position.numpy(), fold.numpy())
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(torch.from_numpy(self._estimate(self._fingerprint(rssi))))

    def _relative(self, rssi: Tensor) -> Tensor:
        return rssi

    def _fingerprint(self, rssi: Tensor) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self._relative(rssi.double()).nan_to_num(self._undetected).numpy()
        return found

    @abstractmethod
    def _regress(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> None:
        """Fit to fingerprints (n, R), positions (n, 3) [m] and folds (n,)."""

    @abstractmethod
    def _estimate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions (n, 3) [m] of fingerprints (n, R)."""


@LOCALIZERS.register("knn")
class NearestFingerprints(FingerprintLocalizer):
    """The inverse-distance mean position of the k training rows with the most similar RSSI; k by cross-validation."""

    name = "knn"

    k: int
    """number of neighbours, set by `fit`"""

    def _regress(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> None:
        counts = [k for k in NEIGHBOUR_COUNTS if k <= len(x) - int(np.bincount(fold).max())]
        errors: dict[int, list[NDArray[np.float64]]] = {k: [] for k in counts}
        for number in np.unique(fold):
            out, kept = fold == number, fold != number
            search = NearestNeighbors(n_neighbors=counts[-1]).fit(x[kept])
            distance, row = search.kneighbors(x[out])  # one search serves all k
            for k in counts:
                estimate = _weighted(distance[:, :k], position[kept][row[:, :k]])
                errors[k].append(np.linalg.norm(estimate - position[out], axis=1))
        self.k = min(counts, key=lambda k: float(np.concatenate(errors[k]).mean()))
        self._search, self._position = NearestNeighbors(n_neighbors=self.k).fit(x), position

    def _estimate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        distance, row = self._search.kneighbors(x)
        return _weighted(distance, self._position[row])


def _weighted(distance: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse-distance mean (n, 3) of positions (n, k, 3) at distances (n, k)."""
    weight = 1 / np.maximum(distance, MIN_DISTANCE_DB)
    mean: NDArray[np.float64] = np.einsum("nk,nkc->nc", weight, position) / weight.sum(axis=1, keepdims=True)
    return mean


@LOCALIZERS.register("knn_difference")
class NearestDifferences(NearestFingerprints):
    """knn on the differences to the row's strongest value, which a constant offset of the device does not change."""

    name = "knn_difference"

    def _relative(self, rssi: Tensor) -> Tensor:
        return rssi - rssi.nan_to_num(-torch.inf).amax(dim=1, keepdim=True)


@LOCALIZERS.register("gp")
class RegressedCoordinates(FingerprintLocalizer):
    """Gaussian-process regression from RSSI to coordinates.

    The kernel is Matern 3/2 and white noise, its parameters by marginal likelihood in the training rows (C. E. Rasmussen and
    C. K. I. Williams, 2006).
    """

    name = "gp"

    def _regress(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> None:
        self._scale = max(float(x.std()), 1e-6)
        x = x / self._scale
        kernel = ConstantKernel(1.0, (0.01, 100.0)) * Matern(2.0, (0.1, 100.0), nu=1.5) + WhiteKernel(0.1, (1e-4, 10.0))
        order = np.random.default_rng(self.config.seed).permutation(len(x))
        tuned, kept = order[:MAX_TUNING_ROWS], order[:MAX_REGRESSION_ROWS]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is the answer
            tuning = GaussianProcessRegressor(kernel, normalize_y=True, random_state=self.config.seed)
            kernel = tuning.fit(x[tuned], position[tuned]).kernel_
        self._regressor = GaussianProcessRegressor(kernel, optimizer=None, normalize_y=True).fit(
            x[kept], position[kept]
        )

    def _estimate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        estimate: NDArray[np.float64] = self._regressor.predict(x / self._scale)
        return estimate


@LOCALIZERS.register("mean")
class MeanPosition(Localizer):
    """The mean training position, whatever the RSSI."""

    name = "mean"

    def fit(self, train: Rssi) -> Self:
        self._mean = train.transmitter_position.mean(dim=0)
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(self._mean.expand(len(rssi), -1))
