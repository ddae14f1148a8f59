"""Spectra anywhere: what is drawn where the moving end stands, without anything of how it is shown."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf import AngularGrid, Spectra
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.data.spectra import direction_of_link
from swiftwrf.positions import distance
from tasks.aoa.page.room import MARGIN, extent
from tasks.view.fitted import Fitted, Link

FAR = 1.5  # away from the measured positions, in their extent
Direction = tuple[float, float]  # azimuth, elevation [deg]


@dataclass(frozen=True)
class Drawn:
    """A spectrum where the moving end stands.

    Args:
        position: of the moving end [m], (3,).
        grid: of the spectrum; coarser than the model's where that would take too long.
        spectrum: magnitudes, (n_elevation, n_azimuth).
        deviation: expected of a measured spectrum; None where the model knows none.
        strongest: direction of the largest magnitude.
        line_of_sight: direction of the transmitter; None where it is unknown.
        seconds: that it took.
    """

    position: NDArray[np.floating]
    grid: AngularGrid
    spectrum: NDArray[np.floating]
    deviation: NDArray[np.floating] | None
    strongest: Direction
    line_of_sight: Direction | None
    seconds: float


@dataclass(frozen=True)
class Measured:
    """The measured spectrum that is nearest to a position.

    Args:
        number: of its row, counted from 0.
        away_m: distance from the position [m].
        learnt: whether the model has learnt from it.
        spectrum, strongest: see `Drawn`.
    """

    number: int
    away_m: float
    learnt: bool
    spectrum: NDArray[np.floating]
    strongest: Direction


@dataclass(frozen=True, eq=False)
class SpectraScene:
    """What can be looked at: fitted models, and the spectra that were measured where they are known.

    Args:
        title: of the page.
        fitted: the models, at least one.
        data: what was measured; None where it is unknown.
        notes: what to say of it, a sentence each.
    """

    title: str
    fitted: list[Fitted]
    data: Spectra | None = None
    notes: list[str] = field(default_factory=list)

    @cached_property
    def link(self) -> Link | None:
        """Where the fixed end stands, how the array is turned and which end moves, as the data or else a model tell."""
        if self.data is not None:
            if self.data.fixed_position is None or self.data.rotation is None:
                return None
            return self.data.fixed_position, self.data.rotation, self.data.moving
        return next((fitted.link for fitted in self.fitted if fitted.link is not None), None)

    @property
    def moving(self) -> str:
        """What the moving end is called."""
        if self.data is not None:
            return self.data.moving
        return "moving end" if self.link is None else self.link[2]

    @property
    def fixed(self) -> NDArray[np.floating] | None:
        """Where the other one stands (3,) [m]; None where it is unknown."""
        return None if self.link is None else self.link[0].numpy()

    @cached_property
    def places(self) -> NDArray[np.floating]:
        """Positions (n, 3) [m] that the page shows: those measured, or around which the models know spectra."""
        known = [fitted.region for fitted in self.fitted] if self.data is None else [self.data.position]
        return np.concatenate([position.double().numpy() for position in known])

    @cached_property
    def box(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Opposite corners (3,) [m] of what the page shows: the room as far as it is known, but of what lies far from the
        measured positions only the side on which it is, or there would be no room to drag between these."""
        planes = [plane for fitted in self.fitted for plane in fitted.planes]
        inside = self.places if self.fixed is None else np.concatenate([self.places, self.fixed[None]])
        low, high = extent(planes, inside)
        nearest, farthest = self.places.min(axis=0), self.places.max(axis=0)
        margin = np.maximum(FAR * (farthest - nearest).max(), MARGIN)
        return np.maximum(low, nearest - margin), np.minimum(high, farthest + margin)

    @property
    def start(self) -> NDArray[np.floating]:
        """Where the moving end stands at first: a measured position near the middle, or the middle."""
        middle = (self.places.min(axis=0) + self.places.max(axis=0)) / 2
        nearest = int(np.linalg.norm(self.places - middle, axis=1).argmin())
        start: NDArray[np.floating] = middle if self.data is None else self.places[nearest]
        return start

    def draw(self, fitted: Fitted, position: NDArray[np.floating], quick: bool = False) -> Drawn:
        """The spectrum of a model with the moving end at a position (3,) [m]; quickly, perhaps on a coarser grid."""
        grid, draw = fitted.quick if quick else (fitted.grid, fitted.fine)
        at = torch.as_tensor(position, dtype=torch.float64).reshape(1, 3)
        began = time.perf_counter()
        spectrum, deviation = draw(at)
        seconds = time.perf_counter() - began
        sight = None if self.link is None else _degrees(direction_of_link(at, *self.link)[0])
        return Drawn(
            np.asarray(position, dtype=float),
            grid,
            spectrum[0].numpy(),
            None if deviation is None else deviation[0].numpy(),
            strongest(spectrum[0], grid),
            sight,
            seconds,
        )

    def nearest(self, fitted: Fitted, position: NDArray[np.floating]) -> Measured | None:
        """The measured spectrum nearest to a position (3,) [m]; None where none are known."""
        if self.data is None:
            return None
        away = distance(torch.as_tensor(position, dtype=torch.float64).reshape(1, 3), self.data.position)[0]
        row = int(away.argmin())
        spectrum = self.data.store[row : row + 1][0]
        learnt = fitted.learnt is not None and bool(fitted.learnt[row])
        return Measured(row, float(away[row]), learnt, spectrum.numpy(), strongest(spectrum, self.data.grid))


def strongest(spectrum: Tensor, grid: AngularGrid) -> Direction:
    """Direction of the largest magnitude of a spectrum (n_elevation, n_azimuth)."""
    return _degrees(grid.peak_direction(spectrum[None])[0])


def angle_between(a: Direction, b: Direction) -> float:
    """Great-circle angle of two directions [deg]."""
    first, second = (to_direction(*torch.tensor(direction, dtype=torch.float64).deg2rad()) for direction in (a, b))
    return float(angular_distance(first, second).rad2deg())


def _degrees(direction: Tensor) -> Direction:
    azimuth, elevation = direction.rad2deg().tolist()
    return azimuth, elevation
