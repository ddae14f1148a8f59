"""Ray tracing by Sionna RT, in a given scene or in the room that is estimated from the spectra."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.contrib.raytraced import Material, Scene, Surface, Tracing, open_scene, sionna, trace
from swiftwrf.contrib.raytraced.rooms import rectangle
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.models.base import ARRAY, FIXED_END, FieldModel
from swiftwrf.models.geometry import GeometryConfig, GeometryModel
from swiftwrf.models.link import Linked
from swiftwrf.runtime.validation import configuration

MAX_DISTANCE_M = 1e4  # from the fixed end; beyond, single precision loses the phase
MAX_GAIN = 0.95  # of a plane that a material can have


@configuration
class RaytraceConfig(GeometryConfig):
    """Options of the ray tracing; those of the search apply without a scene."""

    scene: str | None = None
    """name of a built-in room or a scene file; by default the room is estimated from the spectra"""


class RaytraceModel(Linked, FieldModel):
    """Paths by the laws of reflection between vertically polarised isotropic ends, traced by Sionna RT.

    A given scene is used as it is, without any fit. Planes of an estimated room become lossless half spaces whose reflection
    at normal incidence has the estimated gain.
    """

    name = "raytrace"
    kind = "ray-tracing model"
    config_type = RaytraceConfig
    requires = (ARRAY, FIXED_END)
    searches = True
    slow = True
    any_grid = True

    saved = "_room"
    _room: GeometryModel | None
    progress: bool = False
    """whether `predict` shows a progress bar on a terminal"""

    @classmethod
    def accepts_like(cls, model: FieldModel) -> bool:
        return model.room is not None or isinstance(model, cls)

    @property
    def room(self) -> GeometryModel | None:
        """Room that is traced; None if a scene is given."""
        return self._room

    def _fit(self, train: Spectra, *, like: FieldModel | None = None, progress: bool = False, **_: Any) -> None:
        sionna()  # refuses before a room is searched
        self.progress, self._room = progress, None
        if self.config.scene is None:
            like = like if like and like.room else None
            search = {option.name: getattr(self.config, option.name) for option in fields(GeometryConfig)}
            self._room = GeometryModel(**search).fit(train, like=like, progress=progress)
        self._build()

    def _build(self) -> None:
        """Build the scene around an origin that keeps coordinates small, for Sionna computes in single precision."""
        if self._room is None:
            assert self.config.scene is not None
            self._origin = torch.zeros_like(self.fixed_position)
            self._scene = open_scene(self.config.scene, self.array.frequency_hz)
        else:
            self._origin = self.fixed_position
            self._scene = Scene(surfaces(self._room), self.array.frequency_hz)

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        """Return spectra, zero at positions that no path reaches. Not differentiable."""
        position = position.detach()
        spectrum = torch.zeros(len(position), *grid.shape)
        near = ((position - self.fixed_position).abs() <= MAX_DISTANCE_M).all(dim=1).nonzero()[:, 0]
        if not len(near):
            return spectrum, None
        paths = trace(
            self._scene,
            self.fixed_position - self._origin,
            position[near] - self._origin,
            self.moving,
            Tracing(seed=self.config.seed),
            self.progress,
        )
        channel = paths.channel(self.array, self.rotation)
        reached = paths.count > 0
        spectrum[near[reached]] = self.array.spectrum(channel[reached], grid)
        return spectrum, None

    def _restored(self) -> None:
        super()._restored()
        if (self._room is None) == (self.config.scene is None):
            raise InputError("ray tracing needs a scene or a room")
        self._build()


def surfaces(room: GeometryModel) -> list[Surface]:
    """Return the planes of an estimated room as squares without an end, the fixed end at the origin."""
    found = room.tensors()
    away = found.offset[0] - found.normal[0] @ room.fixed_position
    farthest = float(torch.cat([away.abs(), (room.bounds - room.fixed_position).norm(dim=1)]).max())
    made = []
    for number, normal in enumerate(found.normal[0]):
        gain = min(float(found.gain[0, number].abs()), MAX_GAIN)
        # a slab without a second reflection
        material = Material(f"plane-{number}", 100.0, ((1 + gain) / (1 - gain)) ** 2, 1e-3)
        # an unbounded wall ends at ten times the distance of the farthest known point from the fixed end
        side = 20 * farthest * torch.linalg.svd(normal[None]).Vh[1:]  # (2, 3), across the normal
        corner = float(away[number]) * normal - side.sum(dim=0) / 2
        made.append(Surface.joined(material.name, material, [rectangle(corner.tolist(), *side.tolist())]))
    return made
