"""Uncertainty of estimated planes: standard deviations, alternatives, and conditions under which no plane is certain."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.models.geometry.ambiguity import phase_alternatives
from swiftwrf.models.geometry.batched import batched, batched_field, batched_score
from swiftwrf.models.geometry.images import PhaseObservations, field, phase_period_m
from swiftwrf.models.geometry.planes import (
    Plane,
    PlaneSet,
    RoomEstimate,
    advantage,
    correlation_score,
    log_explained,
    refined,
    sign_alternatives,
)
from swiftwrf.models.geometry.refine import offset_covariance
from swiftwrf.runtime.threads import parallel_map

MAX_STD_RAD = 0.5  # of phase, beyond which a plane is not certain
MIN_SPREAD_RAD = 0.8  # of phase: positions with less spread in any direction count as flat
CARRIER_SCALES = (0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05)  # of alternative carriers
SYSTEMATIC_STD_WAVELENGTHS = 0.02  # of planes that explain nothing, because unmodelled paths are no random noise


def assess(
    train: Spectra, scene: PhaseObservations, room: PlaneSet, score: float, reach: float, certainty: float
) -> RoomEstimate:
    """Return the planes of a room with their standard deviations, and which of them are identifiable.

    Args:
        train: Training spectra, for the array.
        scene: Observed phases.
        room: Refined planes in world coordinates.
        score: Score at held-out positions.
        reach: Standard deviation [m] of planes that are not identifiable.
        certainty: Standard errors by which a plane must explain the spectra better than its alternatives.
    """
    assert train.array is not None
    unexplained = 1 - (1 - correlation_score(scene, room, train.array)) ** 2
    if not room.normal.shape[1]:
        nothing = torch.zeros(0, 0, dtype=torch.float64)
        return RoomEstimate([], room.order, score, unexplained, "no plane explains the spectra", nothing)
    covariance = offset_covariance(scene, room.normal, room.offset, room.gain, room.sequence)
    systematic = SYSTEMATIC_STD_WAVELENGTHS * train.array.wavelength * math.sqrt(max(unexplained, 0))
    covariance = covariance + systematic**2 * torch.eye(len(covariance), dtype=torch.float64)
    reason = _flat(scene) or _other_carrier(scene, room, certainty)
    std = covariance.diagonal().clamp_min(0).sqrt().tolist()
    alternatives = [
        (room_, log_explained(scene.coherence(room_.field(scene)))) for room_ in phase_alternatives(scene, room)
    ]
    nearest = parallel_map(lambda plane: _nearest_alternative(scene, room, plane, alternatives), range(len(std)))
    lost = [lead <= certainty or s * scene.wavenumber > MAX_STD_RAD for s, (lead, _) in zip(std, nearest, strict=True)]
    # a room most of whose planes have alternatives may be wrong as a whole, because each plane holds the others
    all_lost = bool(reason) or sum(lost) > len(lost) / 2
    planes = []
    for i, (lead, distance) in enumerate(nearest):
        away = reach if all_lost else distance if lead <= certainty else 0.0
        x, y, z = room.normal[0, i].tolist()
        offset, gain = float(room.offset[0, i]), float(room.gain[0, i])
        planes.append(Plane((x, y, z), offset, gain, 1000 * max(std[i], away), not (lost[i] or all_lost)))
    conclusion = f"{len(planes)} planes, {sum(plane.certain for plane in planes)} of them certain{reason}"
    return RoomEstimate(planes, room.order, score, unexplained, conclusion, covariance)


def _nearest_alternative(
    scene: PhaseObservations, room: PlaneSet, plane: int, alternatives: list[tuple[PlaneSet, Tensor]]
) -> tuple[float, float]:
    """Return the standard errors by which a plane explains the spectra better than its best alternative.

    Also return the distance of that alternative [m]. Alternatives are the best offset of a scan around the plane and the
    offsets at which a wave of the other sign has the same phase, each refined together with all other planes.

    Args:
        scene: Observed phases.
        room: Refined planes.
        plane: Number of the plane.
        alternatives: Rooms in which several planes are moved, and how well each explains the spectra.
    """
    period = phase_period_m(scene, room.normal, room.offset, plane)
    step = torch.arange(period / 2, 3.5 * period, 0.4 / scene.wavenumber, dtype=torch.float64)
    beside = torch.cat([-step.flip(0), step])
    offset = room.offset.repeat(len(beside), 1)
    offset[:, plane] += beside
    rest = [s for s in room.sequence if plane not in s]
    own = [s for s in room.sequence if plane in s]
    base = scene.wave(scene.transmitter) + field(scene, room.normal, room.offset, room.gain, rest)[0]
    expanded = room.normal.expand(len(offset), -1, -1), offset, room.gain.expand(len(offset), -1)
    value = batched_score(scene, batched(base) + batched_field(scene, *expanded, own))
    moved = room.offset.clone()
    moved[:, plane] += beside[value.argmin()]
    here = log_explained(scene.coherence(room.field(scene)))
    nearest = math.inf, 0.0
    near = refined([replace(room, offset=moved), *sign_alternatives(scene, room, plane)], scene, 5)
    for other, there in [*((o, log_explained(scene.coherence(o.field(scene)))) for o in near), *alternatives]:
        distance = abs(float(other.offset[0, plane] - room.offset[0, plane]))
        if distance > period / 4:
            nearest = min(nearest, (advantage(here, there), distance))
    return nearest


def _flat(scene: PhaseObservations) -> str:
    """Return the reason if the positions lie on a line or in a plane, which leaves the room ambiguous, else nothing."""
    extent = torch.linalg.svdvals(scene.moving - scene.moving.mean(0)) / math.sqrt(len(scene))
    if float(extent[2]) * scene.wavenumber > MIN_SPREAD_RAD:
        return ""
    shape = "a line" if float(extent[1]) * scene.wavenumber <= MIN_SPREAD_RAD else "a plane"
    return f"; the positions lie on {shape}, from where many rooms look alike"


def _other_carrier(scene: PhaseObservations, room: PlaneSet, certainty: float) -> str:
    """Return the reason if another carrier explains the spectra significantly better, else nothing."""
    here = scene.coherence(room.field(scene))

    def lead(scale: float) -> float:
        other = replace(scene, wavenumber=scale * scene.wavenumber)
        return advantage(other.coherence(room.refined(other, 6).field(other)), here)

    for scale, found in zip(CARRIER_SCALES, parallel_map(lead, CARRIER_SCALES), strict=True):
        if found > certainty:
            return f"; a carrier {100 * (scale - 1):+.0f} % from the given one explains the spectra better"
    return ""
