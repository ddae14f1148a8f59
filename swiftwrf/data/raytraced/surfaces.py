"""What a scene consists of: triangles, and the material that they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        name: of the recommendation, or one's own.
        thickness_m: of the slab that reflects.
        relative_permittivity, conductivity: where it is none of the recommendation [1, S/m].
    """

    name: str
    thickness_m: float
    relative_permittivity: float | None = None
    conductivity: float = 0.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one material.

    Args:
        name: of the thing.
        material: that it is of.
        vertex: corners (V, 3) [m].
        triangle: numbers of three corners (F, 3).
    """

    name: str
    material: Material
    vertex: NDArray[np.float64]
    triangle: NDArray[np.int64]

    @classmethod
    def joined(cls, name: str, material: Material, meshes: Sequence[Mesh]) -> Surface:
        """Several meshes as one."""
        first = np.cumsum([0, *(len(vertex) for vertex, _ in meshes[:-1])])
        triangles = [triangle + start for (_, triangle), start in zip(meshes, first, strict=True)]
        return cls(name, material, np.concatenate([vertex for vertex, _ in meshes]), np.concatenate(triangles))


def box(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """The twelve triangles of an axis-parallel box; they share its eight corners, so its edges are known as such."""
    ends = np.array([low, high], dtype=np.float64)
    vertex = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return vertex, _halved(FACES)


def rectangle(corner: Sequence[float], a: Sequence[float], b: Sequence[float]) -> Mesh:
    """Two triangles between a corner and the vectors a and b from it."""
    p, u, v = (np.array(x, dtype=np.float64) for x in (corner, a, b))
    return np.array([p, p + u, p + u + v, p + v]), _halved([(0, 1, 2, 3)])


def outline(surface: Surface) -> NDArray[Any]:
    """Segments (E, 2, 3) [m] where faces meet at an angle or end: what a drawing of the surface needs."""
    corner = surface.vertex[surface.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    sides: dict[tuple[int, int], list[int]] = {}
    for number, (a, b, c) in enumerate(surface.triangle.tolist()):
        for side in ((a, b), (b, c), (c, a)):
            sides.setdefault((min(side), max(side)), []).append(number)
    kept = [
        side
        for side, (first, *others) in sides.items()
        if not others or min(abs(normal[first] @ normal[other]) for other in others) < 0.999
    ]
    return surface.vertex[np.array(kept, dtype=np.int64).reshape(-1, 2)]


def _halved(faces: Sequence[tuple[int, int, int, int]]) -> NDArray[np.int64]:
    return np.array([half for a, b, c, d in faces for half in ((a, b, c), (a, c, d))])
