"""A fitted model to look at: what it draws how fast, and what it knows of the place."""

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

from swiftwrf import AngularGrid, CoarrayModel, GeometryModel, InputError, SwiftWRF
from swiftwrf.comparison.dcgan import Dcgan
from swiftwrf.comparison.drawing import LinkDrawing
from swiftwrf.comparison.vae import Vae
from swiftwrf.data.spectra import Moving
from swiftwrf.models.geometry import HybridModel, room_of
from swiftwrf.runtime.checkpoint import Saved

QUICK = 0.02  # [s] that a spectrum may take while the moving end is dragged
Link = tuple[Tensor, Tensor, Moving]
Draw = Callable[[Tensor], tuple[Tensor, Tensor | None]]  # positions to spectra and their deviations


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
        model: Any = room_of(self.model) or self.model
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
        if isinstance(self.model, LinkDrawing):
            link = self.model.link
            return link.fixed, link.rotation, link.moving
        room = room_of(self.model)
        return None if room is None else (room.fixed_position, room.rotation, room.moving)


def planes_of(model: Saved) -> list[dict[str, Any]]:
    """The room that a model found, as in geometry-mix*.json; none where it knows of none."""
    room = room_of(model)
    planes: list[dict[str, Any]] = room.to_json()["planes"] if room is not None else []
    return planes


def _cube(centre: Tensor, half: Tensor) -> Tensor:
    """The middle of a cube and two of its corners, (3, 3)."""
    return centre + half * torch.tensor([[0.0], [-1], [1]], dtype=torch.float64)


def _seconds(draw: Draw, at: Tensor) -> float:
    """That one spectrum takes; the second one, for the first may compile or fill caches."""
    draw(at)
    began = time.perf_counter()
    draw(at)
    return time.perf_counter() - began
