"""Spectra at any position: the computations behind the page of spectra."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf import AngularGrid, FieldModel, InputError, Spectra, load
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.array.planar import PlanarArray, folded_angles
from swiftwrf.choices import Moving
from swiftwrf.data.spectra import direction_of_link
from swiftwrf.errors import with_article
from swiftwrf.locate import MatchedField
from swiftwrf.positions import distance, inside
from tasks.aoa.room import MARGIN, extent
from tasks.view.locating import Located

MAX_DRAG_SECONDS = 0.02  # of one prediction while the moving end is dragged
MAX_BEYOND_DATA = 1.5  # margin of the page around the measured positions, in units of their extent
Direction = tuple[float, float]  # azimuth, elevation [deg]


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A fitted model on the page."""

    title: str  # name on the page
    model: FieldModel  # field model
    planes: list[dict[str, Any]]  # planes of the room as in `geometry-mix*.json`. Defaults to those of the model
    in_training: NDArray[np.bool_] | None = None  # whether each measured spectrum trained the model, (n,), if known
    locator_file: Path | None = None  # matched field that was fitted to the same spectra. None if there is none

    @cached_property
    def locator(self) -> MatchedField:
        """The locator, opened when it is first used.

        Raises:
            InputError: The file contains none.
        """
        assert self.locator_file is not None
        locator = load(self.locator_file)
        if not isinstance(locator, MatchedField):
            kinds = with_article(locator.kind), with_article(MatchedField.kind)
            raise InputError(f"{self.locator_file} holds {kinds[0]}, expected {kinds[1]}")
        return locator

    @cached_property
    def drag_grid(self) -> AngularGrid:
        """Finest grid that is predicted within `MAX_DRAG_SECONDS` on this machine, or the coarsest one."""
        grid, position = self.model.grid, self.model.region()[:1]
        factors = range(1, min(grid.shape) + 1) if self.model.any_grid else (1,)
        grids = [grid.coarsen(factor) for factor in factors if not any(size % factor for size in grid.shape)]
        return next((grid for grid in grids if _seconds(self.model, position, grid) <= MAX_DRAG_SECONDS), grids[-1])


def _seconds(model: FieldModel, position: Tensor, grid: AngularGrid) -> float:
    """Return the time of the second prediction; the first one compiles and fills caches."""
    for _ in range(2):
        began = time.perf_counter()
        with torch.no_grad():
            model.predict(position, grid)
    return time.perf_counter() - began


@dataclass(frozen=True)
class PredictedSpectrum:
    """A spectrum predicted at one position of the moving end."""

    position: NDArray[np.floating]  # position of the moving end [m], (3,)
    grid: AngularGrid  # directions of the spectrum
    mean: NDArray[np.floating]  # magnitudes, (n_elevation, n_azimuth)
    std: NDArray[np.floating] | None  # standard deviation of a measured spectrum, if the model has one
    peak: Direction  # direction of the largest magnitude
    line_of_sight: Direction | None  # direction of the transmitter. None if the fixed end is unknown
    seconds: float  # time of the prediction


@dataclass(frozen=True, eq=False)
class SpectraView:
    """Fitted models, at least one, and the measured spectra, as far as they are known."""

    title: str
    models: list[LoadedModel]
    data: Spectra | None = None
    notes: list[str] = field(default_factory=list)

    @cached_property
    def fixed_end(self) -> tuple[Tensor, Tensor, Moving] | None:
        """Fixed end, rotation of the array and moving end, from the data, else from a model. None if unknown."""
        if self.data is None:
            return next((end for loaded in self.models if (end := loaded.model.fixed_end) is not None), None)
        if self.data.fixed_position is None or self.data.rotation is None:
            return None
        return self.data.fixed_position, self.data.rotation, self.data.moving

    @property
    def moving(self) -> str:
        """Name of the moving end."""
        if self.data is not None:
            return self.data.moving
        return "moving end" if self.fixed_end is None else self.fixed_end[2]

    @property
    def fixed(self) -> NDArray[np.floating] | None:
        """Position of the fixed end [m], (3,). None if unknown."""
        return None if self.fixed_end is None else self.fixed_end[0].numpy()

    @cached_property
    def positions(self) -> NDArray[np.floating]:
        """Positions (n, 3) [m] that the page covers: the measured ones, else the regions of the models."""
        known = [loaded.model.region() for loaded in self.models] if self.data is None else [self.data.position]
        return np.concatenate([position.double().numpy() for position in known])

    @cached_property
    def box(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Opposite corners (3,) [m] of the page's region: the room, cut off far from the measured positions."""
        planes = [plane for loaded in self.models for plane in loaded.planes]
        inside = self.positions if self.fixed is None else np.concatenate([self.positions, self.fixed[None]])
        low, high = extent(planes, inside)
        nearest, farthest = self.positions.min(axis=0), self.positions.max(axis=0)
        margin = np.maximum(MAX_BEYOND_DATA * (farthest - nearest).max(), MARGIN)
        return np.maximum(low, nearest - margin), np.minimum(high, farthest + margin)

    @property
    def start(self) -> NDArray[np.floating]:
        """Initial position of the moving end (3,) [m]: the measured one nearest to the middle, or the middle."""
        middle: NDArray[np.floating] = (self.positions.min(axis=0) + self.positions.max(axis=0)) / 2
        nearest = int(np.linalg.norm(self.positions - middle, axis=1).argmin())
        start: NDArray[np.floating] = middle if self.data is None else self.positions[nearest]
        return start

    def predict(self, loaded: LoadedModel, position: NDArray[np.floating], dragging: bool = False) -> PredictedSpectrum:
        """Predict the spectrum at a position (3,) [m]; while dragging on a grid that is fast enough."""
        grid = loaded.drag_grid if dragging else loaded.model.grid
        query = torch.as_tensor(position, dtype=torch.float64).reshape(1, 3)
        began = time.perf_counter()
        with torch.no_grad():
            prediction = loaded.model.predict(query, grid)
        seconds, array = time.perf_counter() - began, None if self.data is None else self.data.array
        return PredictedSpectrum(
            np.asarray(position, dtype=float),
            grid,
            prediction.mean[0].numpy(),
            None if prediction.std is None else prediction.std[0].numpy(),
            peak(prediction.mean[0], grid, array),
            None if self.fixed_end is None else _degrees(direction_of_link(query, *self.fixed_end, array)[0]),
            seconds,
        )

    def extrapolates(self, position: NDArray[np.floating]) -> bool:
        """Return whether a position (3,) [m] lies outside of the positions that the page covers, in plan."""
        return not bool(inside(position, self.positions))

    def nearest(self, position: NDArray[np.floating]) -> tuple[int, float]:
        """Return index and distance [m] of the measured spectrum nearest to a position (3,) [m]."""
        assert self.data is not None
        away = distance(torch.as_tensor(position, dtype=torch.float64).reshape(1, 3), self.data.position)[0]
        return int(away.argmin()), float(away.min())

    def located(self, loaded: LoadedModel, index: int) -> Located:
        """Return the posterior over the position of a measured spectrum."""
        assert self.data is not None
        return Located.of(loaded.locator.locate(self.data[index : index + 1]), self.data.position[index].double())


def peak(spectrum: Tensor, grid: AngularGrid, array: PlanarArray | None = None) -> Direction:
    """Return the direction of the largest magnitude of a spectrum (n_elevation, n_azimuth), folded as the labels."""
    return _degrees(folded_angles(array, grid.peak_direction(spectrum[None]))[0])


def angle_between(a: Direction, b: Direction) -> float:
    """Return the angle between two directions [deg]."""
    first, second = (to_direction(*torch.tensor(direction, dtype=torch.float64).deg2rad()) for direction in (a, b))
    return float(angular_distance(first, second).rad2deg())


def _degrees(direction: Tensor) -> Direction:
    azimuth, elevation = direction.rad2deg().tolist()
    return azimuth, elevation
