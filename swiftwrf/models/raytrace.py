"""Ray tracing by Sionna RT, in a scene that is given or in the room that the spectra show."""

from __future__ import annotations

from pathlib import Path

import torch
from augment.synthesizers.base import ARRAY, FIXED_END, SYNTHESIZERS, Synthesizer
from augment.synthesizers.geometry import find_room
from torch import Tensor

from swiftwrf import GeometryModel, Spectra
from swiftwrf.data.raytraced import ROOMS, SCENE_FILE, Material, Scene, Surface, Tracing, sionna, trace
from swiftwrf.data.raytraced.surfaces import rectangle
from swiftwrf.models.geometry import refit_geometry

BEYOND = 10.0  # times as far as anything known do the walls of a found room reach: they have no edges
FARTHEST = 1e4  # [m] from the fixed end: beyond, single precision loses the phase
STRONGEST = 0.95  # gain of a plane that a material can have
THICK_M, LOSS = 100.0, 1e-3  # a slab [m] of a conductivity [S/m] that lets no second reflection out


@SYNTHESIZERS.register(
    "raytrace",
    meaning="rays traced by Sionna RT, in --scene or in the room that geometry finds (extra: raytrace)",
    needs=(ARRAY, FIXED_END),
    colour="#994455",
)
class Raytrace(Synthesizer):
    """Paths by the laws of reflection for vertically polarised isotropic ends.

    The scene that is given is taken as it is, and learns nothing from the spectra. Of the room that is found, planes become
    half spaces without loss that reflect at normal incidence as strongly as the spectra say.
    """

    def fit(self, train: Spectra) -> None:
        sionna()  # refuses before a room is sought
        self._train, self._room = train, None
        if self.settings.scene is None:
            self._room, self.shared_seconds = find_room(train, self.settings)
        self._build()

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, Raytrace)
        self._train, self._room = train, None
        if other._room is not None:
            self._room = refit_geometry(other._room, train, seed=self.settings.seed)
        self._build()

    def _build(self) -> None:
        """The scene, and where its origin is in world coordinates: single precision wants near numbers."""
        array, fixed, name = self._train.array, self._train.fixed_position, self.settings.scene
        assert array is not None
        assert fixed is not None
        if self._room is not None:
            self._origin = fixed
            self._scene = Scene(planes(self._room, self._train.position), array.frequency_hz)
        else:
            assert name is not None
            self._origin = torch.zeros_like(fixed)
            self._scene = open_scene(name, array.frequency_hz)

    @torch.no_grad()
    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """As of all synthesizers; where no path arrives, zeros."""
        array, fixed, rotation = self._train.array, self._train.fixed_position, self._train.rotation
        assert array is not None
        assert fixed is not None
        assert rotation is not None
        spectrum = torch.zeros(len(position), *self._train.grid.shape)
        near = ((position - fixed).abs() <= FARTHEST).all(dim=1).nonzero()[:, 0]
        if not len(near):
            return spectrum
        paths = trace(
            self._scene,
            fixed - self._origin,
            position[near].double() - self._origin,
            self._train.moving,
            Tracing(seed=self.settings.seed),
            self.settings.progress,
        )
        channel = array.channel(paths.direction @ rotation, paths.gain, paths.owner, len(near))
        heard = paths.count > 0
        spectrum[near[heard]] = array.spectrum(channel[heard], self._train.grid)
        return spectrum


def open_scene(name: str, frequency_hz: float) -> Scene:
    """A room by its name or a scene by its file, at a carrier.

    Raises:
        InputError: as of `Scene`; an unknown room.
    """
    if name.endswith(SCENE_FILE):
        return Scene.read(Path(name), frequency_hz)
    return Scene(ROOMS[name]().surfaces(), frequency_hz)


def planes(room: GeometryModel, position: Tensor) -> list[Surface]:
    """The planes of a found room as squares without end, the fixed end at the origin.

    Args:
        room: what the spectra show.
        position: that were measured, (n, 3) [m].
    """
    normal, offset, gain = room.tensors()
    away = offset[0] - normal[0] @ room.fixed_position
    known = float(torch.cat([away.abs(), (position - room.fixed_position).norm(dim=1)]).max())
    made = []
    for number, (direction, at, strength) in enumerate(
        zip(normal[0], away.tolist(), gain[0].abs().tolist(), strict=True)
    ):
        strength = min(strength, STRONGEST)
        material = Material(f"plane-{number}", THICK_M, ((1 + strength) / (1 - strength)) ** 2, LOSS)
        side = 2 * BEYOND * known * torch.linalg.svd(direction[None]).Vh[1:]  # (2, 3), across the normal
        corner = at * direction - side.sum(dim=0) / 2
        made.append(Surface.joined(f"plane-{number}", material, [rectangle(corner.tolist(), *side.tolist())]))
    return made
