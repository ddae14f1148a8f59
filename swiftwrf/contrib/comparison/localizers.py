"""Localizers: the position of a transmitter from one row of RSSI, by the posterior and by the usual baselines."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from torch import Tensor

from swiftwrf.contrib.comparison.rssi_baselines import fit_process
from swiftwrf.data import Rssi
from swiftwrf.data.splits import Validation, folds
from swiftwrf.locate.rssi import BATCH_ROWS, RssiLocator
from swiftwrf.locate.rssi_likelihood import Fingerprints
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, checked

LEVELS = (0.5, 0.8, 0.95)  # probabilities of the credible regions
UNDETECTED_BELOW_DB = 5.0  # below the weakest value, of what is not detected, for gp


@dataclass(frozen=True, eq=False)
class Located:
    """Estimated positions of n rows.

    Args:
        position: Estimates, float64 (n, 3) [m].
        radius: Radii of the credible regions of `LEVELS` around the estimates, (n, 3) [m]. None without a posterior.
        ambiguous: True where a second position is likely, bool (n,). None without a posterior.
        floor_probability: Probability of the floor of the estimate, (n,): its part of the posterior or of the neighbours'
            weights. None without floors.
        direction: Azimuth and elevation at each station by the posterior, (n, A, 2) [rad]. None without arrays.
    """

    position: Tensor
    radius: Tensor | None = None
    ambiguous: Tensor | None = None
    floor_probability: Tensor | None = None
    direction: Tensor | None = None


class Localizer(ABC):
    """Base class: `fit` to measured rows, then `locate` others.

    Args:
        validation: Training rows held out to choose settings; see `RssiLocatorConfig`.
        n_cells: Number of candidate positions of a posterior.
        seed: Seed of everything random.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> LOCALIZERS["knn"](seed=3).fit(train).locate(test.rssi_dbm).position.shape
        torch.Size([12, 3])
    """

    @checked
    def __init__(
        self, *, validation: Validation = "random", n_cells: PositiveInt = 4000, seed: NonNegativeInt = 0
    ) -> None:
        self.validation, self.n_cells, self.seed = validation, n_cells, seed

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

    locator: RssiLocator
    """locator, set by `fit`"""

    def fit(self, train: Rssi) -> Self:
        locator = RssiLocator(validation=self.validation, n_cells=self.n_cells, seed=self.seed)
        self.locator = locator.fit(train, progress=True)
        return self

    def locate(self, rssi: Tensor) -> Located:
        parts = []
        for rows in rssi.split(BATCH_ROWS):
            posterior = self.locator.locate(rows)
            radius = posterior.credible_radii(LEVELS)
            parts.append((posterior.median, radius, posterior.ambiguous, posterior.floor_probability.amax(dim=1)))
        found = Located(*(torch.cat(values) for values in zip(*parts, strict=True)))
        return found if self.locator.region.floors else replace(found, floor_probability=None)


@LOCALIZERS.register("knn")
class NearestFingerprints(Localizer):
    """The inverse-distance mean position of the k places with the most similar RSSI, on the floor that they vote for.

    Distance of RSSI and k by cross-validation, see `Fingerprints`.
    """

    fingerprints: Fingerprints
    """training rows, set by `fit`"""

    def fit(self, train: Rssi) -> Self:
        fold = folds(train.transmitter_position, self.validation, self.seed, session=train.session)
        relative = train.derived(rssi_dbm=self._relative(train.rssi_dbm))
        self.fingerprints = Fingerprints.fit(relative, fold, self.seed)
        return self

    def locate(self, rssi: Tensor) -> Located:
        part, _, estimate = self.fingerprints.votes(self._relative(rssi))
        return Located(estimate, floor_probability=part.amax(dim=1) if self.fingerprints.floors else None)

    def _relative(self, rssi: Tensor) -> Tensor:
        return rssi


@LOCALIZERS.register("knn_difference")
class NearestDifferences(NearestFingerprints):
    """knn on the differences to the row's strongest value, which a constant offset of the device does not change."""

    def _relative(self, rssi: Tensor) -> Tensor:
        return rssi - rssi.nan_to_num(-torch.inf).amax(dim=1, keepdim=True)


@LOCALIZERS.register("nearest")
class NearestFingerprint(NearestFingerprints):
    """The position of the single training row with the most similar RSSI, by Manhattan distance: the field's benchmark."""

    def fit(self, train: Rssi) -> Self:
        # rows without a detection are rows of the benchmark
        self.fingerprints = Fingerprints(train.transmitter_position, train.rssi_dbm.float(), None, "manhattan", 1)
        return self


@LOCALIZERS.register("gp")
class RegressedCoordinates(Localizer):
    """Gaussian-process regression from RSSI to coordinates; what is not detected is 5 dB below the weakest training value.

    The kernel is Matern 3/2 and white noise, its parameters by marginal likelihood in the training rows (C. E. Rasmussen and
    C. K. I. Williams, 2006).
    """

    def fit(self, train: Rssi) -> Self:
        train = train.subset(train.detected.any(dim=1))
        self._undetected = float(train.rssi_dbm[train.detected].min()) - UNDETECTED_BELOW_DB
        x, position = self._filled(train.rssi_dbm), train.transmitter_position.numpy()
        scale = max(float(x.std()), 1e-6)
        length = Matern(2.0 * scale, (0.1 * scale, 100.0 * scale), nu=1.5)
        kernel = ConstantKernel(1.0, (0.01, 100.0)) * length + WhiteKernel(0.1, (1e-4, 10.0))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is the answer
            self._regressor = fit_process(kernel, x, position, self.seed, normalize=True)
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(torch.from_numpy(self._regressor.predict(self._filled(rssi))))

    def _filled(self, rssi: Tensor) -> NDArray[np.float64]:
        found: NDArray[np.float64] = rssi.double().nan_to_num(self._undetected).numpy()
        return found


@LOCALIZERS.register("mean")
class MeanPosition(Localizer):
    """The mean training position, whatever the RSSI."""

    def fit(self, train: Rssi) -> Self:
        self._mean = train.transmitter_position.mean(dim=0)
        return self

    def locate(self, rssi: Tensor) -> Located:
        return Located(self._mean.expand(len(rssi), -1))
