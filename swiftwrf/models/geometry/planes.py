"""Rooms of mirror planes: their field, their refinement, and the comparison of two rooms."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import torch
from annotated_types import Ge, Le
from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.errors import InputError
from swiftwrf.models.geometry.images import PhaseObservations, Sequence, field, phase_period_m, sequences
from swiftwrf.models.geometry.phase_retrieval import autocorrelation
from swiftwrf.models.geometry.refine import refine
from swiftwrf.models.geometry.search import SIDES, CandidateRoom
from swiftwrf.runtime.validation import NonNegativeFloat, check_value, configuration

PLANE_TENSORS = ("normal", "offset", "gain")  # of a `PlaneSet`
MAX_PLANES, MAX_ORDER = 64, 4  # of a room, whose image sources number MAX_PLANES^MAX_ORDER at most
NORMAL_TOLERANCE = 1e-6  # of the length of a normal, from rounding
MIN_MISSING = 1e-5  # missing coherence by rounding of spectra and phases


@configuration
class Plane:
    """A mirror plane normal . x = offset in world coordinates.

    Args:
        normal: Unit vector out of the room.
        offset_m: Offset [m].
        gain: Reflection gain (amplitude) with its sign.
        std_mm: Standard deviation of the offset [mm].
        certain: No alternative offset explains the spectra nearly as well, and held-out spectra need the plane.

    Raises:
        InputError: A normal that is no unit vector, or a number that is not finite.
    """

    normal: tuple[float, float, float]
    offset_m: float
    gain: float
    std_mm: NonNegativeFloat = 0.0
    certain: bool = True

    def check(self) -> None:
        """Refuse a normal of another length and infinite numbers."""
        length = math.hypot(*self.normal)
        if abs(length - 1) > NORMAL_TOLERANCE:
            raise InputError(
                f"the normal of a plane must be a unit vector, got {self.normal} of length {length:.6g}; divide normal and "
                "offset_m by it"
            )
        if not (math.isfinite(self.offset_m) and math.isfinite(self.gain)):
            raise InputError(f"offset and gain of a plane must be finite, got {self.offset_m} m and {self.gain}")


@dataclass(frozen=True, eq=False)
class RoomEstimate:
    """Planes of a room with their uncertainty.

    Args:
        planes: Planes, an empty list if none explains the spectra.
        order: Highest number of reflections of an image source.
        score_held_out: 1 - correlation of predicted and observed co-array coefficients of the training spectra that were
            held out from the first stage of the search.
        unexplained: Fraction of the power of the co-array coefficients of the training spectra that is not predicted.
        conclusion: Result in one sentence.
        covariance: Covariance of the offsets (P, P) [m^2].

    Raises:
        InputError: More than 64 planes, or an order outside 0 to 4.
    """

    planes: list[Plane]
    order: int
    score_held_out: float
    unexplained: float
    conclusion: str
    covariance: Tensor

    def __post_init__(self) -> None:
        check_value("order", self.order, Annotated[int, Ge(0), Le(MAX_ORDER)])
        check_value("the number of planes", len(self.planes), Annotated[int, Le(MAX_PLANES)])

    def to_json(self) -> dict[str, Any]:
        """Return the planes (normal . x = offset in world coordinates), order and scores as plain values."""
        planes = [{**asdict(plane), "normal": list(plane.normal)} for plane in self.planes]
        scores = {"score_held_out": self.score_held_out, "unexplained": self.unexplained}
        return {"planes": planes, "order": self.order} | scores


@dataclass(frozen=True)
class PlaneSet:
    """Planes of one room: normals (1, P, 3), offsets (1, P) [m], gains (1, P), and the order of their images."""

    normal: Tensor
    offset: Tensor
    gain: Tensor
    order: int

    @classmethod
    def of(cls, found: CandidateRoom) -> PlaneSet:
        """Return the planes of a candidate room."""
        normal, offset, gain = found.tensors()
        return cls(normal, offset, gain, 2)

    def by_side(self) -> CandidateRoom:
        """Return the candidate room with each plane on the side of the region that it faces most, without a score."""
        sides = (self.normal[0] @ SIDES.T).argmax(1).tolist()
        offset, gain = (dict(zip(sides, values[0].tolist(), strict=True)) for values in (self.offset, self.gain))
        return CandidateRoom(0.0, offset, gain)

    @property
    def sequence(self) -> list[Sequence]:
        """Sequences of reflections up to the order."""
        return sequences(self.normal[0], self.order) if self.normal.shape[1] else []

    def field(self, scene: PhaseObservations) -> Tensor:
        """Return the field with the direct wave at the positions of a scene, complex64 (n, K)."""
        return scene.wave(scene.transmitter) + field(scene, self.normal, self.offset, self.gain, self.sequence)[0]

    def shifted(self, by: Tensor) -> PlaneSet:
        """Return the planes in coordinates whose origin is at `-by` (3,) [m]."""
        return replace(self, offset=self.offset + self.normal @ by)

    def without(self, plane: int) -> PlaneSet:
        """Return the other planes."""
        keep = [i for i in range(self.normal.shape[1]) if i != plane]
        return replace(self, normal=self.normal[:, keep], offset=self.offset[:, keep], gain=self.gain[:, keep])

    def refined(self, scene: PhaseObservations, steps: int = 10, tilt: bool = False) -> PlaneSet:
        """Return the planes after Levenberg-Marquardt steps on offsets, gains and, with `tilt`, normals."""
        return refined([self], scene, steps, tilt)[0]


def refined(rooms: list[PlaneSet], scene: PhaseObservations, steps: int = 10, tilt: bool = False) -> list[PlaneSet]:
    """Return the rooms, each as by `PlaneSet.refined`. Rooms with the same sequences are computed together."""
    found = list(rooms)
    groups: dict[tuple[Sequence, ...], list[int]] = {}
    for number, room in enumerate(rooms):
        if room.sequence:
            groups.setdefault(tuple(room.sequence), []).append(number)
    for sequence, numbers in groups.items():
        normal, offset, gain = (torch.cat([getattr(rooms[i], name) for i in numbers]) for name in PLANE_TENSORS)
        _, *planes = refine(scene, normal, offset, gain, list(sequence), steps=steps, tilt=tilt)
        for number, *one in zip(numbers, *(t.split(1) for t in planes), strict=True):
            found[number] = replace(rooms[number], **dict(zip(PLANE_TENSORS, one, strict=True)))
    return found


def advantage(a: Tensor, b: Tensor) -> float:
    """Return how many standard errors the mean coherence a (n,) is above b."""
    difference = a - b
    return float(difference.mean() / (difference.std() / math.sqrt(len(difference))).clamp_min(1e-9))


def log_explained(coherence: Tensor) -> Tensor:
    """Return minus the logarithm of each spectrum's missing coherence, (n,)."""
    return -(1 - coherence + MIN_MISSING).log()


def robust_advantage(a: Tensor, b: Tensor) -> float:
    """Return the larger `advantage` of coherences a over b, linear or by `log_explained`.

    Linear differences are skewed if spectra are few. Logarithms hide improvements of badly explained spectra.
    """
    return max(advantage(a, b), advantage(log_explained(a), log_explained(b)))


def sign_alternatives(scene: PhaseObservations, room: PlaneSet, plane: int = -1) -> list[PlaneSet]:
    """Return the rooms in which a plane has a gain of the other sign and its wave the same phase, to either side."""
    plane %= room.normal.shape[1]
    period, rooms = phase_period_m(scene, room.normal, room.offset, plane), []
    for step in (-period / 2, period / 2):
        offset, gain = room.offset.clone(), room.gain.clone()
        offset[:, plane] += step
        gain[:, plane] *= -1
        rooms.append(replace(room, offset=offset, gain=gain))
    return rooms


def correlation_score(scene: PhaseObservations, room: PlaneSet, array: PlanarArray) -> float:
    """Return 1 - correlation of predicted and observed co-array coefficients."""
    predicted = autocorrelation(room.field(scene).sgn(), array)
    seen = autocorrelation(scene.channel[:, 0], array)
    power = float(predicted.abs().square().sum() * seen.abs().square().sum())
    return 1 - float((predicted * seen.conj()).real.sum()) / math.sqrt(power)
