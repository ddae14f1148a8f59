"""Spectra anywhere: what is drawn where the moving end stands, without anything of how it is shown."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf import AngularGrid, CoarrayModel, GeometryModel, InputError, Spectra, SwiftWRF
from swiftwrf.angles import great_circle, to_direction
from swiftwrf.checkpoint import Saved
from swiftwrf.comparison.dcgan import Dcgan
from swiftwrf.comparison.drawing import LinkDrawing
from swiftwrf.comparison.vae import Vae
from swiftwrf.data.spectra import Moving, direction_of_link
from swiftwrf.geometry import HybridModel
from swiftwrf.positions import distance
from tasks.aoa.page.room import MARGIN, extent

FAR = 1.5  # away from the measured positions, in their extent
QUICK = 0.02  # [s] that a spectrum may take while the moving end is dragged
Direction = tuple[float, float]  # azimuth, elevation [deg]
Link = tuple[Tensor, Tensor, Moving]
Draw = Callable[[Tensor], tuple[Tensor, Tensor | None]]  # positions to spectra and their deviations


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
class Fitted:
    """A fitted model.

    Args:
        title: what it is called.
        model: what was saved.
        planes: of the room, as in geometry-mix*.json.
        learnt: which measured spectra it was fitted to, (n,); None where that is unknown.

    Raises:
        InputError: a model that draws no spectra.
    """

    title: str
    model: Saved
    planes: list[dict[str, Any]] = field(default_factory=list)
    learnt: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if not hasattr(self.model, "synthesize"):
            raise InputError(f"a {self.model.kind} draws neither spectra nor maps that can be looked at")

    @cached_property
    def grid(self) -> AngularGrid:
        """That of the spectra it was fitted to."""
        model: Any = self.model.geometry if isinstance(self.model, HybridModel) else self.model
        grid: AngularGrid = model.grid
        return grid

    @cached_property
    def fine(self) -> Draw:
        """Draws on the model's own grid."""
        return self._on(self.grid)

    @cached_property
    def quick(self) -> tuple[AngularGrid, Draw]:
        """A grid on which a spectrum takes at most `QUICK` seconds here and now, the coarsest there is where none does, and
        what draws on it."""
        at = self.region[:1]
        found = self.grid, self.fine
        for factor in range(1, min(self.grid.shape) + 1 if self._any_grid else 2):
            if any(size % factor for size in self.grid.shape):
                continue
            grid = self.grid.coarsen(factor)
            found = grid, self.fine if factor == 1 else self._on(grid)
            if _seconds(found[1], at) <= QUICK:
                break
        return found

    @property
    def _any_grid(self) -> bool:
        """Whether the model draws on other grids than its own."""
        return isinstance(self.model, SwiftWRF | GeometryModel | CoarrayModel | LinkDrawing)

    def _on(self, grid: AngularGrid) -> Draw:
        model: Any = self.model
        if isinstance(model, SwiftWRF):
            canvas = model.canvas(grid)
            if canvas.variation is not None:
                return lambda position: model.synthesize(position, canvas, return_std=True)
            return lambda position: (model.synthesize(position, canvas), None)
        if isinstance(model, GeometryModel):
            model = replace(model, grid=grid)
        elif self._any_grid:
            return lambda position: (model.synthesize(position, grid), None)
        return lambda position: (model.synthesize(position), None)

    @cached_property
    def region(self) -> Tensor:
        """Positions (n, 3) [m] around which the model knows spectra, as far as it says."""
        match self.model:
            case SwiftWRF() | Vae() | Dcgan():
                frame: Any = self.model if isinstance(self.model, SwiftWRF) else self.model.frame
                return _cube(frame.centre, frame.scale)
            case CoarrayModel() | HybridModel():
                return self.model.anchor
            case LinkDrawing():
                link = self.model.link
                reach = (link.fixed - link.centre).abs().max()
                return _cube(link.centre, reach)
            case GeometryModel():
                return self._inside(self.model)
        raise AssertionError(type(self.model))

    def _inside(self, room: GeometryModel) -> Tensor:
        """The middle of a room and two of its corners, two metres away from the fixed end where no wall tells."""
        low, high = room.fixed_position - 2, room.fixed_position + 2
        for plane in room.planes:
            axis = int(np.abs(plane.normal).argmax())
            at = plane.offset_m / plane.normal[axis]
            if plane.normal[axis] > 0:
                high[axis] = at
            else:
                low[axis] = at
        return torch.stack([(low + high) / 2, low, high])

    @property
    def link(self) -> Link | None:
        """Where the fixed end stands, how the array is turned and which end moves, as far as the model knows."""
        match self.model:
            case GeometryModel():
                return self.model.fixed_position, self.model.rotation, self.model.moving
            case HybridModel():
                room = self.model.geometry
                return room.fixed_position, room.rotation, room.moving
            case LinkDrawing():
                link = self.model.link
                return link.fixed, link.rotation, link.moving
        return None


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


def planes_of(model: Saved) -> list[dict[str, Any]]:
    """The room that a model found, as in geometry-mix*.json; none where it knows of none."""
    room = model.geometry if isinstance(model, HybridModel) else model
    planes: list[dict[str, Any]] = room.to_json()["planes"] if isinstance(room, GeometryModel) else []
    return planes


def strongest(spectrum: Tensor, grid: AngularGrid) -> Direction:
    """Direction of the largest magnitude of a spectrum (n_elevation, n_azimuth)."""
    return _degrees(grid.strongest(spectrum[None])[0])


def angle_between(a: Direction, b: Direction) -> float:
    """Great-circle angle of two directions [deg]."""
    first, second = (to_direction(*torch.tensor(direction, dtype=torch.float64).deg2rad()) for direction in (a, b))
    return float(great_circle(first, second).rad2deg())


def _cube(centre: Tensor, half: Tensor) -> Tensor:
    """The middle of a cube and two of its corners, (3, 3)."""
    return centre + half * torch.tensor([[0.0], [-1], [1]], dtype=torch.float64)


def _degrees(direction: Tensor) -> Direction:
    azimuth, elevation = direction.rad2deg().tolist()
    return azimuth, elevation


def _seconds(draw: Draw, at: Tensor) -> float:
    """That one spectrum takes; the second one, for the first may compile or fill caches."""
    draw(at)
    began = time.perf_counter()
    draw(at)
    return time.perf_counter() - began
