"""A simulated room: image sources of a rectangular room with a few boxes in it.

Walls mirror the transmitter; up to two reflections give 25 image sources, each visible along a straight line through the
unfolded rooms (J. B. Allen and D. A. Berkley, "Image method for efficiently simulating small-room acoustics", J. Acoust.
Soc. Am. 65, 1979). Folding that line back into the room gives the path's corners, and with them the boxes that block it.
The geometry is exact. There is no diffraction, no scattering, and no material that depends on the angle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, configuration

MAX_ORDER = 2  # reflections
Point = tuple[float, float, float]


class Rays(NamedTuple):
    """Straight lines from receivers to the image sources of transmitters.

    Args:
        transmitter, receiver: Positions of both ends, (n, 3) [m].
        vector: From receiver to image source, (n, 25, 3) [m].
        length: Length of each path, (n, 25) [m].
        n_reflections: Number of reflections of each path, (25,).
        clear: Whether no box blocks the path, bool (n, 25).
    """

    transmitter: Tensor
    receiver: Tensor
    vector: Tensor
    length: Tensor
    n_reflections: Tensor
    clear: Tensor


@configuration
class ShoeboxRoom:
    """A rectangular room with one corner at the origin.

    Example:
        >>> room, ends = ShoeboxRoom(boxes=()), torch.tensor([[1.0, 1, 1], [4, 1, 1]])
        >>> room.paths(ends[:1], ends[1:]).count.tolist()
        [25]
    """

    size: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (6.0, 5.0, 3.0)
    """extent along x, y and z [m]"""
    boxes: tuple[tuple[Point, Point], ...] = (
        ((1.0, 0.6, 0.0), (1.6, 1.9, 1.3)),
        ((4.6, 3.6, 0.0), (5.4, 4.6, 1.8)),
        ((1.2, 3.0, 0.0), (1.5, 3.2, 2.2)),
    )
    """obstacles, as pairs of opposite corners [m]"""
    reflection: float = -0.6
    """amplitude factor of a reflection, with its sign"""
    blockage: NonNegativeFloat = 0.1
    """amplitude factor of a path that a box blocks"""
    frequency_hz: PositiveFloat = 915e6
    """frequency of the carrier [Hz]"""

    def paths(self, transmitter: Tensor, receiver: Tensor) -> PropagationPaths:
        """Return the 25 paths with at most two reflections of each link, the direct path first.

        Args:
            transmitter: Positions, (n, 3) [m]. Both ends broadcast.
            receiver: Positions, (n, 3) [m].

        Raises:
            InputError: A position outside the room, or both ends at one position.
        """
        rays = self.rays(transmitter, receiver)
        n, n_paths = rays.length.shape
        return PropagationPaths(
            transmitter=rays.transmitter,
            receiver=rays.receiver,
            count=torch.full((n,), n_paths),
            direction=(rays.vector / rays.length[..., None]).flatten(0, 1),
            gain=self.gain(rays).flatten(),
            line_of_sight=rays.clear[:, 0],
            frequency_hz=self.frequency_hz,
            length=rays.length.flatten(),
        )

    def gain(self, rays: Rays) -> Tensor:
        """Return the complex gain of each path at the carrier, (n, 25)."""
        wavelength = LIGHT_SPEED / self.frequency_hz
        amplitude = wavelength / (4 * math.pi * rays.length) * self.reflection**rays.n_reflections
        amplitude = torch.where(rays.clear, amplitude, self.blockage * amplitude)
        return amplitude * torch.polar(torch.ones_like(rays.length), -2 * math.pi / wavelength * rays.length)

    def rays(self, transmitter: Tensor, receiver: Tensor) -> Rays:
        """Return the geometry of the paths, which does not depend on the carrier; arguments and errors as `paths`."""
        transmitter, receiver = torch.broadcast_tensors(transmitter.double(), receiver.double())
        size = torch.tensor(self.size, dtype=torch.float64)
        for name, position in (("transmitter", transmitter), ("receiver", receiver)):
            if not bool(((position > 0) & (position < size)).all()):
                raise InputError(f"a {name} stands outside the room of {self.size} m")
        rooms = torch.tensor(_mirrored_rooms(), dtype=torch.float64)  # (25, 3)
        inside = torch.where(rooms % 2 == 0, transmitter[:, None], size - transmitter[:, None])
        ray = rooms * size + inside - receiver[:, None]  # (n, 25, 3)
        length = ray.norm(dim=-1)
        if bool((length == 0).any()):
            raise InputError("transmitter and receiver stand at one place, so there is no direction between them")
        clear = ~self._blocked(receiver, ray, rooms)
        return Rays(transmitter, receiver, ray, length, rooms.abs().sum(-1), clear)

    def _blocked(self, receiver: Tensor, ray: Tensor, rooms: Tensor) -> Tensor:
        """Return whether a box blocks each path, bool (n, 25)."""
        size = torch.tensor(self.size, dtype=torch.float64)
        crossing = [torch.zeros(ray.shape[:2], dtype=torch.float64), torch.ones(ray.shape[:2], dtype=torch.float64)]
        for axis, k in itertools.product(range(3), range(MAX_ORDER)):  # the k-th wall crossed along an axis
            count = rooms[:, axis]
            wall = torch.where(count > 0, k + 1.0, -float(k)) * size[axis]
            at = (wall - receiver[:, None, axis]) / ray[..., axis]
            crossing.append(torch.where(count.abs() > k, at, torch.ones_like(at)))
        parameter = torch.stack(crossing, dim=-1).sort(dim=-1).values  # corners along the line, 0 to 1
        corner = _fold(receiver[:, None, None] + parameter[..., None] * ray[:, :, None], size)
        start, step = corner[:, :, :-1], corner.diff(dim=2)
        step = torch.where(step == 0, torch.full_like(step, 1e-300), step)
        segments = [(s.contiguous(), d.contiguous()) for s, d in zip(start.unbind(-1), step.unbind(-1), strict=True)]
        blocked = torch.zeros(ray.shape[:2], dtype=torch.bool)
        for low, high in self.boxes:
            blocked |= _hits(segments, low, high).any(dim=-1)
        return blocked


def _mirrored_rooms() -> list[tuple[int, ...]]:
    """Return the mirrored rooms that at most two reflections reach, the room itself first."""
    steps = range(-MAX_ORDER, MAX_ORDER + 1)
    return sorted(
        (r for r in itertools.product(steps, repeat=3) if sum(map(abs, r)) <= MAX_ORDER), key=lambda r: sum(map(abs, r))
    )


def _fold(point: Tensor, size: Tensor) -> Tensor:
    """Return points of the unfolded rooms, folded back into the room."""
    within = torch.remainder(point, 2 * size)
    return torch.minimum(within, 2 * size - within)


def _hits(segments: Sequence[tuple[Tensor, Tensor]], low: Point, high: Point) -> Tensor:
    """Return whether segments pass through the box between the corners low and high, bool (...).

    Args:
        segments: Start and step (...) along each axis; no step is 0.
        low: Corner of lowest coordinates.
        high: Opposite corner.
    """
    enter = torch.zeros_like(segments[0][0])
    leave = torch.ones_like(enter)
    for (start, step), near, far in zip(segments, low, high, strict=True):
        a, b = (near - start) / step, (far - start) / step
        enter, leave = torch.maximum(enter, torch.minimum(a, b)), torch.minimum(leave, torch.maximum(a, b))
    return enter < leave
