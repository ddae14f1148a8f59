"""A room of mirror planes: its field, its refinement, and how two rooms compare."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.models.geometry.images import Scene, Sequence, field, sequences, turn_of
from swiftwrf.models.geometry.phase_retrieval import autocorrelation
from swiftwrf.models.geometry.refine import refine
from swiftwrf.models.geometry.sample import Residual
from swiftwrf.models.geometry.search import SIDES, Room
from swiftwrf.runtime.validation import NonNegativeFloat, configuration

FLOOR = 1e-5  # of what is missing: rounding of spectra, and of the phases that follow from them


@configuration
class Plane:
    """A mirror plane normal . x = offset in world coordinates.

    Args:
        normal: Unit vector out of the room.
        offset_m: Offset [m].
        gain: Reflection gain (amplitude) with its sign.
        std_mm: Standard deviation of the offset [mm].
        certain: No alternative offset explains the spectra nearly as well, and held-out spectra need the plane.
    """

    normal: tuple[float, float, float]
    offset_m: float
    gain: float
    std_mm: NonNegativeFloat = 0.0
    certain: bool = True


@dataclass(frozen=True, eq=False)
class RoomEstimate:
    """Planes of a room with their uncertainty.

    Args:
        planes: Planes, an empty list if none explains the spectra.
        order: Highest number of reflections of an image source.
        score_held_out: 1 - correlation of predicted and observed co-array coefficients of the training spectra that were
            held out from the first stage of the search.
        unexplained: Fraction of the power of the co-array coefficients of the training spectra that is not predicted.
        verdict: Result in one sentence.
        covariance: Covariance of the offsets (P, P) [m^2].
        residual: Statistics of the prediction error, for samples.
    """

    planes: list[Plane]
    order: int
    score_held_out: float
    unexplained: float
    verdict: str
    covariance: Tensor
    residual: Residual

    def to_json(self) -> dict[str, Any]:
        """Return the planes (normal . x = offset in world coordinates), order and scores as plain values."""
        planes = [{**asdict(plane), "normal": list(plane.normal)} for plane in self.planes]
        scores = {"score_held_out": self.score_held_out, "unexplained": self.unexplained}
        return {"planes": planes, "order": self.order} | scores


@dataclass(frozen=True)
class Planes:
    """Planes (1, P, 3), (1, P) [m] with gains (1, P), and the order of their images."""

    normal: Tensor
    offset: Tensor
    gain: Tensor
    order: int

    @classmethod
    def of(cls, found: Room) -> Planes:
        normal, offset, gain = found.tensors()
        return cls(normal, offset, gain, 2)

    def by_side(self) -> Room:
        """As a search has them, each on the side of the region that it faces most, without a score."""
        sides = (self.normal[0] @ SIDES.T).argmax(1).tolist()
        offset, gain = (dict(zip(sides, values[0].tolist(), strict=True)) for values in (self.offset, self.gain))
        return Room(0.0, offset, gain)

    @property
    def sequence(self) -> list[Sequence]:
        return sequences(self.normal[0], self.order) if self.normal.shape[1] else []

    def field(self, scene: Scene) -> Tensor:
        """(n, K)."""
        return scene.wave(scene.transmitter) + field(scene, self.normal, self.offset, self.gain, self.sequence)[0]

    def shifted(self, by: Tensor) -> Planes:
        """In coordinates from an origin at `-by` (3,) [m]."""
        return replace(self, offset=self.offset + self.normal @ by)

    def without(self, plane: int) -> Planes:
        keep = [i for i in range(self.normal.shape[1]) if i != plane]
        return replace(self, normal=self.normal[:, keep], offset=self.offset[:, keep], gain=self.gain[:, keep])

    def refined(self, scene: Scene, steps: int = 10, tilt: bool = False) -> Planes:
        if not self.sequence:
            return self
        _, normal, offset, gain = refine(
            scene, self.normal, self.offset, self.gain, self.sequence, steps=steps, tilt=tilt
        )
        return replace(self, normal=normal, offset=offset, gain=gain)


def advantage(a: Tensor, b: Tensor) -> float:
    """By how many standard errors the coherences a (n,) are higher than b."""
    difference = a - b
    return float(difference.mean() / (difference.std() / math.sqrt(len(difference))).clamp_min(1e-9))


def explained(coherence: Tensor) -> Tensor:
    """How well each spectrum is explained: minus the logarithm of what is missing, (n,)."""
    return -(1 - coherence + FLOOR).log()


def clearly(a: Tensor, b: Tensor) -> float:
    """The larger `advantage` of coherences a over b, as they are or by what is missing: differences of the former are
    skewed where spectra are few, and those of the latter hide what helps badly explained ones."""
    return max(advantage(a, b), advantage(explained(a), explained(b)))


def in_step(scene: Scene, room: Planes, plane: int = -1) -> list[Planes]:
    """The rooms in which a plane reflects with the other sign, and its wave is in step again to either side."""
    plane %= room.normal.shape[1]
    turn, rooms = turn_of(scene, room.normal, room.offset, plane), []
    for step in (-turn / 2, turn / 2):
        offset, gain = room.offset.clone(), room.gain.clone()
        offset[:, plane] += step
        gain[:, plane] *= -1
        rooms.append(replace(room, offset=offset, gain=gain))
    return rooms


def correlation_score(scene: Scene, room: Planes, array: PlanarArray) -> float:
    """1 - correlation of predicted and observed co-array numbers, both scaled freely."""
    predicted = autocorrelation(room.field(scene).sgn(), array)
    seen = autocorrelation(scene.channel[:, 0], array)
    power = float(predicted.abs().square().sum() * seen.abs().square().sum())
    return 1 - float((predicted * seen.conj()).real.sum()) / math.sqrt(power)
