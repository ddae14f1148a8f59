"""The room that the spectra show: planes with their verdicts, and the spectra that follow from it at any position."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.spectra import Moving
from swiftwrf.errors import InputError
from swiftwrf.models.geometry.images import Scene, field, image_gain, images, sequences
from swiftwrf.models.geometry.sample import Residual, draw
from swiftwrf.positions import check_batch, check_drawn, check_positions
from swiftwrf.runtime.checkpoint import Header, Saved, expect

MOST_PLANES, MOST_ORDER = 64, 4  # of a room in a file


FARTHEST = 1e7  # [m] from the fixed end: beyond, phases are lost to rounding


@dataclass(frozen=True)
class Plane:
    """A mirror plane normal . x = offset in world coordinates.

    Args:
        normal: unit vector out of the room.
        offset_m: [m].
        gain: amplitude that it reflects, with its sign.
        std_mm: standard deviation of the offset [mm].
        certain: no other place explains the spectra nearly as well, and held-out spectra need the plane.
    """

    normal: tuple[float, float, float]
    offset_m: float
    gain: float
    std_mm: float
    certain: bool


@dataclass(frozen=True, eq=False)
class GeometryModel(Saved):
    """Spectra by image sources; what `fit_geometry` returns.

    Args:
        array: the antenna array.
        grid: of the spectra.
        rotation: turns array into world coordinates, (3, 3).
        fixed_position: of the end that does not move [m], (3,).
        moving: which end moves.
        planes: what was found, none where there was nothing to find.
        order: of the images.
        score_held_out: 1 - correlation of predicted and observed co-array numbers of training spectra that were held out
            from the search for planes along the sides, its first stage.
        unexplained: share of the power of the co-array numbers, of the training spectra that were looked at, that the
            prediction leaves.
        verdict: the finding in a sentence.
        covariance: of the offsets [m^2], (P, P).
        residual: statistics of what the planes leave, for draws.
    """

    kind: ClassVar[str] = "geometry model"

    array: PlanarArray
    grid: AngularGrid
    rotation: Tensor
    fixed_position: Tensor
    moving: Moving
    planes: list[Plane]
    order: int
    score_held_out: float
    unexplained: float
    verdict: str
    covariance: Tensor
    residual: Residual

    @torch.no_grad()
    def synthesize(self, position: Tensor, generator: torch.Generator | None = None, batch: int = 256) -> Tensor:
        """Spectra at any positions of the moving end.

        Args:
            position: [m], (n, 3).
            generator: draws a sample - plane offsets within their deviations (anew for every `batch` spectra), paths that
                are blocked, further paths as strong as what the planes leave - instead of the most plausible spectrum.
            batch: spectra at a time.

        Returns:
            Magnitudes in [0, 1], float32 (n, n_elevation, n_azimuth).

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position = check_positions(position)
        check_batch(batch)
        spectrum = torch.empty(len(position), *self.grid.shape)
        for start in range(0, len(position), batch):
            rows = slice(start, start + batch)
            spectrum[rows] = self.array.spectrum(self.channel(position[rows], generator), self.grid)
        return check_drawn(spectrum)

    def channel(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """What each element hears at positions (n, 3) [m], complex64 (n, K), drawn where there is a generator."""
        scene = self.scene(position)
        normal, offset, gain = self.tensors()
        chain = sequences(normal[0], self.order) if self.planes else []
        if generator is not None:
            return draw(scene, normal, offset, gain, chain, self.covariance, self.residual, generator)
        return scene.wave(scene.transmitter) + field(scene, normal, offset, gain, chain)[0]

    def scene(self, position: Tensor) -> Scene:
        """The scene at positions (n, 3) [m], nothing observed; from `FARTHEST` on only the direction counts."""
        away = position - self.fixed_position
        size = away.abs().amax(dim=1, keepdim=True)
        position = torch.where(size > FARTHEST, self.fixed_position + FARTHEST * (away / size), position)
        nothing = torch.ones(len(position), len(self.array.element), dtype=torch.complex64)
        return Scene.of(position, self.fixed_position, self.moving, self.array, self.rotation, nothing)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals (1, P, 3), offsets (1, P) [m] and gains (1, P)."""
        normal = torch.tensor([p.normal for p in self.planes], dtype=torch.float64).reshape(1, -1, 3)
        offset = torch.tensor([[p.offset_m for p in self.planes]], dtype=torch.float64)
        return normal, offset, torch.tensor([[p.gain for p in self.planes]])

    def image_sources(self) -> tuple[Tensor, Tensor, Tensor]:
        """Mirror images of the fixed end: positions (S, 3) [m], gains (S,) and numbers of reflections (S,), itself first."""
        normal, offset, gain = self.tensors()
        at, strength, order = self.fixed_position[None], torch.ones(1), torch.zeros(1, dtype=torch.int64)
        if not self.planes:
            return at, strength, order
        chain = sequences(normal[0], self.order)
        scene = Scene.of(at, at[0], "receiver", self.array, self.rotation, torch.ones(1, len(self.array.element)))
        found = images(scene, normal, offset, chain)[0, :, 0]
        return (
            torch.cat([at, found]),
            torch.cat([strength, image_gain(gain, chain)[0]]),
            torch.cat([order, torch.tensor([len(s) for s in chain])]),
        )

    def to_json(self) -> dict[str, Any]:
        """The room in plain values: planes as normal . x = offset in world coordinates."""
        planes = [{**asdict(p), "normal": list(p.normal)} for p in self.planes]
        return {
            "planes": planes,
            "order": self.order,
            "score_held_out": self.score_held_out,
            "unexplained": self.unexplained,
        }

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """All there is to save: tensors and plain values."""
        tensors = {
            "element": self.array.element,
            "rotation": self.rotation,
            "fixed_position": self.fixed_position,
            "covariance": self.covariance,
        }
        values = self.to_json() | {
            "wavelength": self.array.wavelength,
            "grid": asdict(self.grid),
            "moving": self.moving,
            "verdict": self.verdict,
            "residual": asdict(self.residual),
        }
        return tensors, values

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> GeometryModel:
        """The model that `state` described.

        Raises:
            InputError: tensors or an order that no room has; image sources grow with the planes to the power of the order.
        """
        n_planes, order = len(header["planes"]), header["order"]
        expect(tensors, {"rotation": (3, 3), "fixed_position": (3,)})
        if type(order) is not int or not 0 <= order <= MOST_ORDER or n_planes > MOST_PLANES:
            raise InputError(
                f"a room has at most {MOST_PLANES} planes and paths of 0 to {MOST_ORDER} reflections, got {n_planes} and "
                f"{order}"
            )
        return cls(
            array=PlanarArray(tensors["element"], header["wavelength"]),
            grid=AngularGrid(**header["grid"]),
            rotation=tensors["rotation"],
            fixed_position=tensors["fixed_position"],
            moving=header["moving"],
            planes=[Plane(**{**p, "normal": tuple(p["normal"])}) for p in header["planes"]],
            order=header["order"],
            score_held_out=header["score_held_out"],
            unexplained=header["unexplained"],
            verdict=header["verdict"],
            covariance=tensors["covariance"],
            residual=Residual(**header["residual"]),
        )
