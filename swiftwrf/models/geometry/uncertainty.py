"""What is certain about the planes that were found: deviations, rivals, and doubts about the whole."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.models.geometry.ambiguity import turned
from swiftwrf.models.geometry.images import Scene, field, turn_of
from swiftwrf.models.geometry.planes import (
    Plane,
    Planes,
    RoomEstimate,
    advantage,
    correlation_score,
    explained,
    in_step,
)
from swiftwrf.models.geometry.refine import deviations
from swiftwrf.models.geometry.sample import Residual, residual_statistics

CERTAIN = 3.0  # standard errors by which a plane must be better than in a rival place to be certain
VAGUE = 0.5  # deviation [rad of phase] beyond which a plane is not certain
FLAT = 0.8  # spread of the positions in any direction [rad of phase] up to which they count as flat
SCALES = (0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05)  # of the carrier that rivals the given one
MISFIT = 0.02  # wavelengths that planes are off where nothing is explained: what is not modelled is no random noise


def assess(train: Spectra, scene: Scene, room: Planes, score: float, reach: float) -> RoomEstimate:
    """Return the planes of a room with their standard deviations, and which of them are identifiable.

    Args:
        train: Training spectra, for array and line of sight.
        scene: Observed phases.
        room: Refined planes in world coordinates.
        score: Score at held-out positions.
        reach: Standard deviation [m] of planes that are not identifiable.
    """
    assert train.array is not None
    unexplained = 1 - (1 - correlation_score(scene, room, train.array)) ** 2
    if not room.normal.shape[1]:
        nothing = torch.zeros(0, 0, dtype=torch.float64)
        return RoomEstimate([], room.order, score, unexplained, "no plane explains the spectra", nothing, Residual())
    covariance = deviations(scene, room.normal, room.offset, room.gain, room.sequence)
    systematic = MISFIT * train.array.wavelength * math.sqrt(max(unexplained, 0))
    covariance = covariance + systematic**2 * torch.eye(len(covariance), dtype=torch.float64)
    direct = float(train.line_of_sight.double().mean())
    residual = residual_statistics(scene, room.normal, room.offset, room.gain, room.sequence, direct)
    doubt = _flat(scene) or _other_carrier(scene, room)
    std = covariance.diagonal().clamp_min(0).sqrt().tolist()
    twins = [(twin, explained(scene.coherence(twin.field(scene)))) for twin in turned(scene, room)]
    rivals = [_rival(scene, room, i, twins) for i in range(len(std))]
    lost = [rival <= CERTAIN or s * scene.wavenumber > VAGUE for s, (rival, _) in zip(std, rivals, strict=True)]
    # rooms most of whose planes could stand elsewhere may be wrong as a whole, each plane holding the others
    all_lost = bool(doubt) or sum(lost) > len(lost) / 2
    planes = []
    for i, (rival, distance) in enumerate(rivals):
        away = reach if all_lost else distance if rival <= CERTAIN else 0.0
        x, y, z = room.normal[0, i].tolist()
        offset, gain = float(room.offset[0, i]), float(room.gain[0, i])
        planes.append(Plane((x, y, z), offset, gain, 1000 * max(std[i], away), not (lost[i] or all_lost)))
    verdict = f"{len(planes)} planes, {sum(plane.certain for plane in planes)} of them certain{doubt}"
    return RoomEstimate(planes, room.order, score, unexplained, verdict, covariance, residual)


def _rival(scene: Scene, room: Planes, plane: int, twins: list[tuple[Planes, Tensor]]) -> tuple[float, float]:
    """By how many standard errors the plane's place is better than the best rival's, and how far that is away [m].

    Rivals are the best place of a scan around the plane, and the places where a wave of the other sign is in step, each
    refined together with all other planes; and `twins`, the rooms in which several planes are flipped, with how
    well each explains the spectra.
    """
    turn = turn_of(scene, room.normal, room.offset, plane)
    step = torch.arange(turn / 2, 3.5 * turn, 0.4 / scene.wavenumber, dtype=torch.float64)
    beside = torch.cat([-step.flip(0), step])
    offset = room.offset.repeat(len(beside), 1)
    offset[:, plane] += beside
    rest = [s for s in room.sequence if plane not in s]
    own = [s for s in room.sequence if plane in s]
    base = scene.wave(scene.transmitter) + field(scene, room.normal, room.offset, room.gain, rest)[0]
    value = torch.stack([scene.score(base + field(scene, room.normal, o[None], room.gain, own)[0]) for o in offset])
    moved = room.offset.clone()
    moved[:, plane] += beside[value.argmin()]
    here = explained(scene.coherence(room.field(scene)))
    nearest = math.inf, 0.0
    near = [other.refined(scene, 5) for other in (replace(room, offset=moved), *in_step(scene, room, plane))]
    for other, there in [*((other, explained(scene.coherence(other.field(scene)))) for other in near), *twins]:
        distance = abs(float(other.offset[0, plane] - room.offset[0, plane]))
        if distance > turn / 4:
            nearest = min(nearest, (advantage(here, there), distance))
    return nearest


def _flat(scene: Scene) -> str:
    """A doubt where the positions lie on a line or in a plane, from where many rooms look alike."""
    extent = torch.linalg.svdvals(scene.moving - scene.moving.mean(0)) / math.sqrt(len(scene))
    if float(extent[2]) * scene.wavenumber > FLAT:
        return ""
    shape = "a line" if float(extent[1]) * scene.wavenumber <= FLAT else "a plane"
    return f"; the positions lie on {shape}, from where many rooms look alike"


def _other_carrier(scene: Scene, room: Planes) -> str:
    """A doubt where another carrier explains the spectra clearly better, else nothing."""
    for scale in SCALES:
        other = replace(scene, wavenumber=scale * scene.wavenumber)
        rival = other.coherence(room.refined(other, 6).field(other))
        if advantage(rival, scene.coherence(room.field(scene))) > CERTAIN:
            return f"; a carrier {100 * (scale - 1):+.0f} % from the given one explains the spectra better"
    return ""
