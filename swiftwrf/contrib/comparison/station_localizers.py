"""Localizers by several stations: the posterior of all of them or of one, and the usual baselines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.metrics.pairwise import nan_euclidean_distances
from sklearn.neighbors import KNeighborsRegressor
from torch.nn import functional

from swiftwrf.contrib.comparison.localizers import LEVELS, Located
from swiftwrf.data import Stations
from swiftwrf.data.spectra import coarsening
from swiftwrf.data.splits import each_fold, folds
from swiftwrf.locate import MatchedField, MatchedFieldConfig
from swiftwrf.locate.triangulation import bearings, peak_directions, triangulated
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.runtime.registry import Registry

NEIGHBOUR_COUNTS = (1, 2, 3, 5, 8)
BATCH_TRANSMISSIONS = 256  # that are located together


class StationLocalizer(ABC):
    """Base class: `fit` to measured transmissions, then `locate` others.

    Args:
        rooms: Room of each station, fitted to the same transmissions.
        config: Options of posteriors, of which the seed is that of everything random.
    """

    def __init__(self, rooms: Mapping[str, GeometryModel], config: MatchedFieldConfig | None = None) -> None:
        self.rooms, self.config = rooms, config or MatchedFieldConfig()

    @abstractmethod
    def fit(self, train: Stations) -> Self:
        """Fit to measured transmissions and return the localizer."""

    @abstractmethod
    def locate(self, data: Stations) -> Located:
        """Return the positions of transmissions; each has a value."""


STATION_LOCALIZERS: Registry[StationLocalizer] = Registry("localizer by stations", "swiftwrf.station_localizers")


@STATION_LOCALIZERS.register("posterior")
class StationsPosterior(StationLocalizer):
    """The median of the posterior over positions, given the spectra at all stations and their rooms."""

    locator: MatchedField
    """locator, set by `fit`"""

    def fit(self, train: Stations) -> Self:
        rooms = {name: self.rooms[name] for name in train.names}
        self.locator = MatchedField(self.config).fit(train, room=rooms)
        return self

    def locate(self, data: Stations) -> Located:
        parts = []
        for rows in torch.arange(len(data)).split(BATCH_TRANSMISSIONS):
            posterior = self.locator.locate(data.subset(rows))
            radius = posterior.credible_radii(LEVELS)
            direction = torch.stack([self.locator.direction(posterior, name) for name in data.names], dim=1)
            parts.append((posterior.median, radius, posterior.ambiguous, direction))
        position, radius, ambiguous, direction = (torch.cat(values) for values in zip(*parts, strict=True))
        return Located(position, radius, ambiguous, direction=direction)

    def weights(self) -> dict[str, float]:
        """Return the weight of each likelihood, by station and kind."""
        kinds = [
            f"{name} {kind}"
            for name, own in zip(self.locator.stations, self.locator.likelihoods, strict=True)
            for kind in own.names
        ]
        return dict(zip(kinds, self.locator.weight.tolist(), strict=True))


@STATION_LOCALIZERS.register("triangulation")
class PeakTriangulation(StationLocalizer):
    """Least-squares triangulation of the strongest direction at each station."""

    def fit(self, train: Stations) -> Self:
        self._mean = train.position.mean(dim=0)
        return self

    def locate(self, data: Stations) -> Located:
        return Located(triangulated(*bearings(data, peak_directions(data), self._mean), start=self._mean))


@STATION_LOCALIZERS.register("knn")
class NearestSpectra(StationLocalizer):
    """The mean position of the training transmissions with the most similar spectra at all stations.

    The squared distance of two transmissions is the mean over the pixels of the stations that received both. The number of
    neighbours has the smallest mean error at held-out transmissions.
    """

    def fit(self, train: Stations) -> Self:
        x, y = features(train), train.position.numpy()
        errors: dict[int, list[float]] = {}
        for out, kept in each_fold(folds(train.position, "random", self.config.seed)):
            away = nan_euclidean_distances(x[out], x[kept])
            for k in NEIGHBOUR_COUNTS:
                if k <= len(kept):
                    error = np.linalg.norm(_mean_of_nearest(away, y[kept], k) - y[out], axis=1)
                    errors.setdefault(k, []).extend(error)
        self.k = min(errors, key=lambda k: float(np.mean(errors[k])))
        self._known = x, y
        return self

    def locate(self, data: Stations) -> Located:
        x, y = self._known
        return Located(torch.from_numpy(_mean_of_nearest(nan_euclidean_distances(features(data), x), y, self.k)))


def _mean_of_nearest(away: NDArray[np.float64], position: NDArray[np.float64], k: int) -> NDArray[np.float64]:
    """Return the inverse-distance mean position of k neighbours, given distances (n, m), nan without a common station."""
    away = np.nan_to_num(away, nan=np.nanmax(away, initial=1.0))
    regression = KNeighborsRegressor(k, weights="distance", metric="precomputed")
    found: NDArray[np.float64] = regression.fit(np.zeros((len(position), len(position))), position).predict(away)
    return found


@STATION_LOCALIZERS.register("mean")
class MeanOfPositions(StationLocalizer):
    """The mean training position, whatever the spectra."""

    def fit(self, train: Stations) -> Self:
        self._mean = train.position.mean(dim=0)
        return self

    def locate(self, data: Stations) -> Located:
        return Located(self._mean.expand(len(data), -1))


def features(data: Stations, max_azimuths: int = 60) -> NDArray[np.float64]:
    """Return the spectra at all stations side by side, averaged to fewer pixels, (n, p), nan where nothing was received.

    Args:
        data: Transmissions.
        max_azimuths: Columns of a spectrum at most. The beams of an array are wider than one of 60.

    Example:
        >>> import swiftwrf
        >>> features(swiftwrf.simulated_stations(n=10, stations=2)).shape
        (10, 1800)
    """
    parts = []
    for name in data.names:
        rows, spectra = data.of(name)
        factor = coarsening(spectra.grid.shape, max_azimuths)
        pixels = functional.avg_pool2d(spectra.spectrum[:, None], factor).flatten(1).double()
        found = torch.full((len(data), pixels.shape[1]), torch.nan, dtype=torch.float64)
        found[rows] = pixels
        parts.append(found)
    return torch.cat(parts, dim=1).numpy()
