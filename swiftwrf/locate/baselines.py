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
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.splits import Validation, folds
from swiftwrf.locate.rssi import UNDETECTED_BELOW_DB, RssiLocator
from swiftwrf.rssi.baselines import choose_neighbours, fit_process
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, configuration

LEVELS = (0.5, 0.8, 0.95)  # probabilities of the credible regions
BATCH_ROWS = 128  # rows of RSSI whose posteriors are in memory together


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
        fingerprint = self._fingerprint(train.rssi_dbm)
        self._regressor = self._fitted(fingerprint, train.transmitter_position.numpy(), fold.numpy())
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(torch.from_numpy(self._regressor.predict(self._fingerprint(rssi))))

    def _relative(self, rssi: Tensor) -> Tensor:
        return rssi

    def _fingerprint(self, rssi: Tensor) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self._relative(rssi.double()).nan_to_num(self._undetected).numpy()
        return found

    @abstractmethod
    def _fitted(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> Any:
        """Return a regressor of scikit-learn, fitted to fingerprints (n, R), positions (n, 3) [m] and folds (n,)."""


@LOCALIZERS.register("knn")
class NearestFingerprints(FingerprintLocalizer):
    """The inverse-distance mean position of the k training rows with the most similar RSSI; k by cross-validation."""

    name = "knn"

    def _fitted(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> Any:
        return choose_neighbours(x, position, fold)


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

    def _fitted(self, x: NDArray[np.float64], position: NDArray[np.float64], fold: NDArray[np.int64]) -> Any:
        scale = max(float(x.std()), 1e-6)
        length = Matern(2.0 * scale, (0.1 * scale, 100.0 * scale), nu=1.5)
        kernel = ConstantKernel(1.0, (0.01, 100.0)) * length + WhiteKernel(0.1, (1e-4, 10.0))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is the answer
            return fit_process(kernel, x, position, self.config.seed, normalize=True)


@LOCALIZERS.register("mean")
class MeanPosition(Localizer):
    """The mean training position, whatever the RSSI."""

    name = "mean"

    def fit(self, train: Rssi) -> Self:
        self._mean = train.transmitter_position.mean(dim=0)
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(self._mean.expand(len(rssi), -1))
