"""Furnished rooms, built of boxes: sizes and furniture of our own, with dimensions that such things have.

Boxes are axis-parallel, in metres, one corner of the room at the origin, z upwards. Materials are those of ITU-R P.2040,
which knows no fabric: carpet stands for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swiftwrf.data.raytraced.surfaces import Material, Surface, box, rectangle
from swiftwrf.runtime.registry import Registry

Point = tuple[float, float, float]
THICKNESS_M = {  # of panels, walls and sheets of each material
    "brick": 0.12,
    "carpet_tile": 0.02,
    "ceiling_board": 0.02,
    "chipboard": 0.02,
    "concrete": 0.2,
    "glass": 0.008,
    "metal": 0.001,
    "plasterboard": 0.025,
    "wood": 0.02,
}
OTHER_THICKNESS_M = 0.1


@dataclass(frozen=True)
class Box:
    """A piece of furniture between two opposite corners [m]."""

    material: str
    low: Point
    high: Point


@dataclass(frozen=True)
class FurnishedRoom:
    """A rectangular room with one corner at the origin, and what stands in it.

    Args:
        size: along x, y and z [m].
        walls, floor, ceiling: their materials.
        furniture: boxes; none of them moves.
        fixed: where the end that stays usually is [m].
        region: opposite corners of where the other end usually goes [m].
    """

    size: Point
    walls: str
    floor: str
    ceiling: str
    furniture: tuple[Box, ...]
    fixed: Point
    region: tuple[Point, Point]

    def of_materials(self, walls: str | None, floor: str | None, ceiling: str | None) -> FurnishedRoom:
        """The room with other materials where they are given."""
        return replace(self, walls=walls or self.walls, floor=floor or self.floor, ceiling=ceiling or self.ceiling)

    def surfaces(self) -> list[Surface]:
        """Floor, ceiling and four walls, then the furniture, one surface a material."""
        (x, y, z), made = self.size, []
        made.append(Surface.joined("floor", itu(self.floor), [rectangle((0, 0, 0), (x, 0, 0), (0, y, 0))]))
        made.append(Surface.joined("ceiling", itu(self.ceiling), [rectangle((0, 0, z), (x, 0, 0), (0, y, 0))]))
        walls = [
            rectangle((0, 0, 0), (x, 0, 0), (0, 0, z)),
            rectangle((0, y, 0), (x, 0, 0), (0, 0, z)),
            rectangle((0, 0, 0), (0, y, 0), (0, 0, z)),
            rectangle((x, 0, 0), (0, y, 0), (0, 0, z)),
        ]
        made.append(Surface.joined("walls", itu(self.walls), walls))
        for material in dict.fromkeys(piece.material for piece in self.furniture):
            boxes = [box(piece.low, piece.high) for piece in self.furniture if piece.material == material]
            made.append(Surface.joined(f"furniture-{material}", itu(material), boxes))
        return made

    def free(self, position: Tensor, clearance: float = 0.05) -> Tensor:
        """Whether positions (n, 3) [m] are in the room and `clearance` [m] away from walls and furniture, bool (n,)."""
        size = torch.tensor(self.size, dtype=torch.float64)
        free = ((position >= clearance) & (position <= size - clearance)).all(dim=1)
        for piece in self.furniture:
            low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (piece.low, piece.high))
            free &= ~((position > low - clearance) & (position < high + clearance)).all(dim=1)
        return free


def itu(material: str) -> Material:
    """A material of ITU-R P.2040 in its usual thickness."""
    return Material(material, THICKNESS_M.get(material, OTHER_THICKNESS_M))


ROOMS: Registry[FurnishedRoom] = Registry("room")


@ROOMS.register("conference")
def conference() -> FurnishedRoom:
    """Concrete walls, carpet on the floor, a ceiling of boards; the fixed end under the ceiling in a corner."""
    chairs = [(x, y, side) for x in (2.6, 3.4, 4.2, 5.0, 5.8) for y, side in ((1.4, "front"), (3.15, "back"))]
    return FurnishedRoom(
        size=(8.0, 5.0, 2.8),
        walls="concrete",
        floor="carpet_tile",
        ceiling="ceiling_board",
        furniture=(
            Box("wood", (2.3, 1.9, 0.70), (6.2, 3.1, 0.74)),  # table top
            Box("wood", (2.8, 2.2, 0.0), (2.85, 2.8, 0.70)),
            Box("wood", (5.65, 2.2, 0.0), (5.70, 2.8, 0.70)),
            *(piece for x, y, side in chairs for piece in _chair(x, y, side)),
            Box("wood", (0.6, 4.5, 0.0), (2.4, 4.95, 0.80)),  # sideboard
            Box("glass", (7.90, 1.7, 1.0), (7.95, 3.3, 1.9)),  # screen
            Box("metal", (0.0, 1.6, 0.9), (0.02, 3.4, 2.1)),  # whiteboard
            Box("glass", (2.5, 4.98, 0.9), (6.5, 5.0, 2.3)),  # window
            Box("wood", (7.0, 0.0, 0.0), (7.9, 0.04, 2.0)),  # door
        ),
        fixed=(0.6, 0.5, 2.5),
        region=((0.5, 0.4, 1.0), (7.5, 4.4, 1.7)),
    )


@ROOMS.register("office")
def office() -> FurnishedRoom:
    """Plasterboard walls, concrete floor, a ceiling of boards; the fixed end under the ceiling."""
    desks = [(x, y) for x in (1.6, 3.4) for y in (1.6, 2.45)]
    return FurnishedRoom(
        size=(6.0, 5.0, 2.7),
        walls="plasterboard",
        floor="concrete",
        ceiling="ceiling_board",
        furniture=(
            *(piece for x, y in desks for piece in _desk(x, y)),
            Box("chipboard", (1.6, 2.41, 0.0), (5.0, 2.44, 1.30)),  # partition
            *(Box("glass", (x + 0.5, y, 0.85), (x + 1.1, y + 0.04, 1.20)) for x in (1.6, 3.4) for y in (2.25, 2.60)),
            *(
                piece
                for x in (2.2, 4.0)
                for y, side in ((0.95, "front"), (3.45, "back"))
                for piece in _chair(x, y, side)
            ),
            Box("metal", (0.02, 0.6, 0.0), (0.47, 1.4, 1.95)),  # cabinets
            Box("metal", (0.02, 1.45, 0.0), (0.47, 2.25, 1.95)),
            Box("wood", (2.0, 4.68, 0.0), (3.6, 4.98, 2.0)),  # shelves
            Box("glass", (5.98, 1.0, 0.9), (6.0, 4.0, 2.2)),  # window
            Box("wood", (0.6, 4.96, 0.0), (1.5, 5.0, 2.0)),  # door
        ),
        fixed=(5.4, 4.5, 2.4),
        region=((0.7, 0.4, 1.0), (5.6, 4.5, 1.7)),
    )


@ROOMS.register("bedroom")
def bedroom() -> FurnishedRoom:
    """Brick walls, wooden floor, a ceiling of plasterboard; the fixed end on the wardrobe."""
    return FurnishedRoom(
        size=(4.2, 3.6, 2.5),
        walls="brick",
        floor="wood",
        ceiling="plasterboard",
        furniture=(
            Box("wood", (1.3, 0.1, 0.0), (2.9, 2.1, 0.30)),  # bed
            Box("carpet_tile", (1.32, 0.12, 0.30), (2.88, 2.08, 0.52)),  # mattress
            Box("wood", (1.25, 0.02, 0.0), (2.95, 0.08, 1.05)),  # headboard
            Box("wood", (0.75, 0.05, 0.0), (1.20, 0.45, 0.50)),  # nightstands
            Box("wood", (3.00, 0.05, 0.0), (3.45, 0.45, 0.50)),
            Box("wood", (0.2, 2.95, 0.0), (2.2, 3.55, 2.10)),  # wardrobe
            Box("wood", (3.72, 1.5, 0.0), (4.17, 2.7, 0.85)),  # chest of drawers
            Box("glass", (4.12, 1.8, 0.85), (4.15, 2.4, 1.55)),  # mirror
            Box("glass", (0.0, 0.8, 0.9), (0.02, 2.2, 2.1)),  # window
            Box("wood", (2.9, 3.56, 0.0), (3.8, 3.6, 2.0)),  # door
        ),
        fixed=(1.2, 3.1, 2.3),
        region=((0.3, 0.3, 0.9), (3.9, 2.8, 1.6)),
    )


def _chair(x: float, y: float, back: str) -> list[Box]:
    """A chair whose seat begins at (x, y): seat, back on the side away from the table, and a pedestal."""
    at = y if back == "front" else y + 0.41
    return [
        Box("chipboard", (x, y, 0.43), (x + 0.45, y + 0.45, 0.48)),
        Box("chipboard", (x, at, 0.55), (x + 0.45, at + 0.04, 0.95)),
        Box("metal", (x + 0.20, y + 0.20, 0.0), (x + 0.25, y + 0.25, 0.43)),
    ]


def _desk(x: float, y: float) -> list[Box]:
    """A desk of 1.6 x 0.8 m with a panel at each end."""
    return [
        Box("chipboard", (x, y, 0.70), (x + 1.6, y + 0.8, 0.73)),
        Box("chipboard", (x + 0.02, y + 0.05, 0.0), (x + 0.04, y + 0.75, 0.70)),
        Box("chipboard", (x + 1.56, y + 0.05, 0.0), (x + 1.58, y + 0.75, 0.70)),
    ]
