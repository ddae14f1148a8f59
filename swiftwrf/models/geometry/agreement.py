"""Rooms of several stations that agree: one station's phases leave a plane ambiguous, those of another determine it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import torch

from swiftwrf.data.spectra import Spectra
from swiftwrf.models.geometry.fit import observe, refine_room, widened_room
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.planes import Plane, RoomEstimate, plane_set, robust_advantage


def agreed(
    rooms: Mapping[str, GeometryModel],
    spectra: Mapping[str, Spectra],
    max_tilt: float = 0.05,
    max_wavelengths: float = 1.5,
    significance: float = 2.5,
) -> dict[str, GeometryModel]:
    """Return the rooms of several stations with planes where the most certain station has them.

    Planes of two rooms are one plane if they are parallel and less than 1.5 wavelengths apart. The offset and the sign of
    the gain are those of the station with the highest probability. A station keeps its own plane where its spectra
    contradict. Identifiable planes that a station did not find are added if they explain its held-out spectra significantly
    better.

    Args:
        rooms: Fitted room of each station.
        spectra: Spectra that each room was fitted to.
        max_tilt: Sine of the angle between the normals of one plane. Not studied.
        max_wavelengths: Distance of one plane in two rooms. The phase of a wave repeats after half a wavelength over the
            cosine of incidence, and its gain has the other sign after half of that. Not studied.
        significance: Standard errors by which a station's own room must explain its spectra better to be kept, as in
            `GeometryConfig`.

    Example:
        >>> import swiftwrf
        >>> from swiftwrf.models.geometry import Plane
        >>> spectra = swiftwrf.simulated_room(n=30)
        >>> here, off = (Plane((0.0, 0.0, -1.0), z, -0.6, probability=p) for z, p in ((0.0, 1.0), (0.15, 0.6)))
        >>> rooms = {name: GeometryModel.of_planes(spectra, [plane]) for name, plane in (("a", here), ("b", off))}
        >>> abs(agreed(rooms, {"a": spectra, "b": spectra})["b"].planes[0].offset_m) < 0.03
        True
    """
    reference = list[Plane]()
    within = Within(max_tilt, max_wavelengths * max(room.array.wavelength for room in rooms.values()))
    for plane in sorted((p for room in rooms.values() for p in room.planes), key=lambda p: (-p.probability, p.std_mm)):
        if not any(within.same(plane, other) for other in reference):
            reference.append(plane)
    return {name: _placed(room, spectra[name], reference, within, significance) for name, room in rooms.items()}


class Within(NamedTuple):
    """Largest differences of one plane in two rooms.

    Args:
        tilt: Sine of the angle between the normals.
        distance_m: Distance [m].
    """

    tilt: float
    distance_m: float

    def same(self, a: Plane, b: Plane) -> bool:
        """Return True if two planes are one."""
        normals = torch.tensor([a.normal, b.normal], dtype=torch.float64)
        is_parallel = float(torch.linalg.cross(*normals).norm()) < self.tilt and float(normals[0] @ normals[1]) > 0
        return is_parallel and abs(a.offset_m - b.offset_m) < self.distance_m


def _placed(
    room: GeometryModel, spectra: Spectra, reference: list[Plane], within: Within, significance: float
) -> GeometryModel:
    """Return a room whose planes are moved where the reference has them elsewhere: all of them, else one after the other.

    One wrong plane keeps others from their right offsets, because images of higher order are reflected in both.
    """
    config, wavelength = room.config, room.array.wavelength
    elsewhere, unknown = dict[int, Plane](), [plane for plane in reference if plane.certain]
    for number, plane in enumerate(room.planes):
        other = next(each for each in reference if within.same(plane, each))
        unknown = [each for each in unknown if each is not other]
        if abs(other.offset_m - plane.offset_m) > wavelength / 8:
            gain = abs(plane.gain) * (1 if other.gain > 0 else -1)
            elsewhere[number] = replace(plane, offset_m=other.offset_m, gain=gain)
    scene, _ = observe(spectra, config)

    def moved(estimate: RoomEstimate, numbers: Iterable[int]) -> RoomEstimate:
        """Return a room with some planes at the offsets of the reference, or as it is where the spectra contradict."""
        planes = [elsewhere[n] if n in numbers else plane for n, plane in enumerate(estimate.planes)]
        tried = refine_room(replace(estimate, planes=planes), spectra, config)
        here, there = (plane_set(each.planes, each.order).coherence(scene) for each in (estimate, tried))
        return tried if robust_advantage(here, there) < significance else estimate

    found = copy(room)
    if elsewhere:
        found.estimate = moved(room.estimate, elsewhere)
        if found.estimate is room.estimate:
            for number in elsewhere:
                found.estimate = moved(found.estimate, [number])
    if unknown:
        found.estimate = widened_room(found.estimate, unknown, spectra, config)
    if found.estimate is not room.estimate:  # furniture reflects in the planes, too
        found.furnish(found.link.aligned(spectra))
    return found
