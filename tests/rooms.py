"""Spectra of rooms in closed form: planes that mirror, each with a gain of its own, and phase noise at every element."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import torch
from small import FLOOR
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.data.simulated import ShoeboxRoom
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.store import Store
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.images import SIDES, LinkAt, PlaneSet
from swiftwrf.models.geometry.planes import Plane
from swiftwrf.models.link import Link

Normal = tuple[float, float, float]
GRID = AngularGrid.hemisphere(10, 40)
ARRAY = PlanarArray.square(4, 915e6)
OFFICE_WALLS = [
    Plane(normal, offset, -0.6)
    for normal, offset in (
        ((-1.0, 0.0, 0.0), 0.0),
        ((1.0, 0.0, 0.0), 8.0),
        ((0.0, -1.0, 0.0), 0.0),
        ((0.0, 1.0, 0.0), 6.0),
        ((0.0, 0.0, -1.0), 0.0),
        ((0.0, 0.0, 1.0), 3.0),
    )
]


def mirror_room(
    planes: Mapping[Normal, float],
    gain: float | tuple[float, ...] = -0.6,
    moving: Moving = "receiver",
    n: int = 30,
    noise: float = 0.0,
    low: Normal = (1.5, 1.2, 0.9),
    high: Normal = (3.5, 3.2, 1.6),
    array: PlanarArray = ARRAY,
    seed: int = 0,
) -> Spectra:
    """Spectra with images up to the second order.

    Args:
        planes: outward normal, of any length, to offset [m].
        gain: of all planes or of each.
        moving: the end that is anywhere between `low` and `high` [m]; the other one hangs below the ceiling or, if it is the
            receiver, stands on the floor.
        n: positions.
        noise: standard deviation of the phases [rad].
        low: corner of the region.
        high: the opposite one.
        array: at the receiver, level.
        seed: of positions and noise.
    """
    generator = torch.Generator().manual_seed(seed)
    least, most = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    position = least + (most - least) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    fixed = torch.tensor([2.6, 2.2, 2.4 if moving == "receiver" else 0.3], dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64)
    scene = LinkAt.of(position, Link(moving, fixed, rotation, array))
    channel = scene.wave(scene.transmitter)
    if planes:
        normal = torch.tensor(list(planes), dtype=torch.float64)
        normal = torch.nn.functional.normalize(normal, dim=1)[None]
        offset = torch.tensor([list(planes.values())], dtype=torch.float64)
        gains = torch.tensor(gain).expand(offset.shape)
        channel = PlaneSet(normal, offset, gains).channel(scene)
    turn: Tensor = noise * torch.randn(channel.shape, generator=generator)
    return Spectra(
        name="closed form",
        position=position,
        store=Store(array.spectrum(channel * torch.polar(torch.ones_like(turn), turn), GRID)),
        grid=GRID,
        label=torch.zeros(n, 2, dtype=torch.float64),
        line_of_sight=torch.ones(n, dtype=torch.bool),
        moving=moving,
        index=torch.arange(n),
        array=array,
        fixed_position=fixed,
        rotation=rotation,
    )


@cache
def floor_channels() -> Spectra:
    """Return spectra of the channels that a floor reflects at five subcarriers, which rise in frequency."""
    base = mirror_room({}, moving="transmitter", n=40)
    away = torch.tensor([-20.0, -9, 1, 8, 20], dtype=torch.float64)
    frequency = LIGHT_SPEED / base.array.wavelength + 1e6 * away
    channel = GeometryModel.of_planes(base, [FLOOR]).channel(base.position, frequency)
    return replace(base, channel=channel, frequency_hz=frequency)


def built_in_walls(gain: float = -0.6) -> list[Plane]:
    """Return the planes of the built-in room, all of one gain."""
    x, y, z = ShoeboxRoom().size
    sides = zip(SIDES.tolist(), (0.0, x, 0.0, y, 0.0, z), strict=True)
    return [Plane(tuple(normal), offset, gain) for normal, offset in sides]


def room_with_box(centre: tuple[float, float], side_m: float = 0.6, height_m: float = 1.8) -> ShoeboxRoom:
    """Return the built-in room after a box was put on its floor.

    Args:
        centre: x and y of the centre [m].
        side_m: Side of the square that the box covers [m].
        height_m: Height [m].
    """
    room, (x, y), half = ShoeboxRoom(), centre, side_m / 2
    box = ((x - half, y - half, 0.0), (x + half, y + half, height_m))
    return replace(room, boxes=(*room.boxes, box))
