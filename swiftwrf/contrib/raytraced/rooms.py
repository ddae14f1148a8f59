"""Furnished rooms: the built-in ones of rooms.yml, as surfaces to trace and as space to stand in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

Point = tuple[float, float, float]
Box = tuple[str, Point, Point]  # material of a piece of furniture, and two opposite corners [m]
CONTENT = yaml.safe_load(Path(__file__).with_name("rooms.yml").read_text(encoding="utf-8"))
FACES = [  # of a box, corners counted as x y z bits, counter-clockwise from outside
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
]
Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]  # vertices (V, 3) [m], triangles (F, 3)


@dataclass(frozen=True)
class Material:
    """A material of ITU-R P.2040 by its name, or any other by its constants.

    Args:
        name: Name in the recommendation, or another one.
        thickness_m: Thickness of the slab that reflects [m].
        relative_permittivity, conductivity: Constants [1, S/m] of a material that is not in the recommendation.
    """

    name: str
    thickness_m: float
    relative_permittivity: float | None = None
    conductivity: float = 0.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one material.

    Args:
        name: Name of the object.
        material: Its material.
        vertex: Corners, (V, 3) [m].
        triangle: Indices of three corners each, (F, 3).

    Example:
        >>> Surface.joined("cube", Material("wood", 0.02), [box((0, 0, 0), (1, 1, 1))]).triangle.shape
        (12, 3)
    """

    name: str
    material: Material
    vertex: NDArray[np.float64]
    triangle: NDArray[np.int64]

    @classmethod
    def joined(cls, name: str, material: Material, meshes: Sequence[Mesh]) -> Surface:
        """Return one surface of several meshes."""
        first = np.cumsum([0, *(len(vertex) for vertex, _ in meshes[:-1])])
        triangles = [triangle + start for (_, triangle), start in zip(meshes, first, strict=True)]
        return cls(name, material, np.concatenate([vertex for vertex, _ in meshes]), np.concatenate(triangles))


def box(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """Return the twelve triangles of an axis-parallel box, which share its eight corners so that edges diffract."""
    ends = np.array([low, high], dtype=np.float64)
    vertex = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return vertex, _halved(FACES)


def rectangle(corner: Sequence[float], a: Sequence[float], b: Sequence[float]) -> Mesh:
    """Return two triangles between a corner and the vectors a and b from it."""
    p, u, v = (np.array(x, dtype=np.float64) for x in (corner, a, b))
    return np.array([p, p + u, p + u + v, p + v]), _halved([(0, 1, 2, 3)])


def _halved(faces: Sequence[tuple[int, int, int, int]]) -> NDArray[np.int64]:
    return np.array([half for a, b, c, d in faces for half in ((a, b, c), (a, c, d))])


@dataclass(frozen=True)
class FurnishedRoom:
    """A rectangular room with one corner at the origin, and its furniture.

    Args:
        size: Extent along x, y and z [m].
        walls, floor, ceiling: Materials of ITU-R P.2040.
        furniture: Boxes that do not move.
        fixed: Default position of the fixed end [m].
        region: Default region of the moving end, as opposite corners [m].

    Example:
        >>> ROOMS["office"].size
        (6.0, 5.0, 2.7)
    """

    size: Point
    walls: str
    floor: str
    ceiling: str
    furniture: tuple[Box, ...]
    fixed: Point
    region: tuple[Point, Point]

    def surfaces(self) -> list[Surface]:
        """Return floor, ceiling and walls, then the furniture, one surface a material."""
        x, y, z = self.size
        level = [(0, 0, height) for height in (0, z)]
        floor, ceiling = ([rectangle(corner, (x, 0, 0), (0, y, 0))] for corner in level)
        walls = [rectangle(corner, (x, 0, 0), (0, 0, z)) for corner in ((0, 0, 0), (0, y, 0))]
        walls += [rectangle(corner, (0, y, 0), (0, 0, z)) for corner in ((0, 0, 0), (x, 0, 0))]
        meshes = {"floor": (self.floor, floor), "ceiling": (self.ceiling, ceiling), "walls": (self.walls, walls)}
        for material in dict.fromkeys(material for material, *_ in self.furniture):
            boxes = [box(*corners) for own, *corners in self.furniture if own == material]
            meshes[f"furniture-{material}"] = (material, boxes)
        return [
            Surface.joined(name, Material(material, CONTENT["thickness_m"].get(material, 0.1)), parts)
            for name, (material, parts) in meshes.items()
        ]

    def free(self, position: Tensor, clearance: float = 0.05) -> Tensor:
        """Return whether positions (n, 3) [m] keep `clearance` [m] from walls and furniture, bool (n,)."""
        size = torch.tensor(self.size, dtype=torch.float64)
        free = ((position >= clearance) & (position <= size - clearance)).all(dim=1)
        for _, *corners in self.furniture:
            low, high = torch.tensor(corners, dtype=torch.float64)
            free &= ~((position > low - clearance) & (position < high + clearance)).all(dim=1)
        return free


def _rooms() -> dict[str, FurnishedRoom]:
    def boxes(entry: Any) -> list[Box]:
        if isinstance(entry, list):
            material, low, high = entry
            return [(material, tuple(low), tuple(high))]
        return [
            (material, (x + low[0], y + low[1], low[2]), (x + high[0], y + high[1], high[2]))
            for piece, places in entry.items()
            for x, y in places
            for material, low, high in CONTENT["pieces"][piece]
        ]

    def room(values: dict[str, Any]) -> FurnishedRoom:
        furniture = tuple(piece for entry in values["furniture"] for piece in boxes(entry))
        points: dict[str, Any] = {key: tuple(values[key]) for key in ("size", "fixed")}
        region: Any = tuple(map(tuple, values["region"]))
        return FurnishedRoom(**(values | points | {"furniture": furniture, "region": region}))

    return {name: room(values) for name, values in CONTENT["rooms"].items()}


ROOMS = _rooms()
