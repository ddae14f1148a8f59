"""Surfaces of a scene: triangles, and their material."""

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
FLAT_COSINE = 0.999  # between normals of faces that form one plane
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

    def outline(self) -> NDArray[Any]:
        """Return the segments (E, 2, 3) [m] at which faces meet at an angle or end, for a drawing."""
        corner = self.vertex[self.triangle]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        sides: dict[tuple[int, int], list[int]] = {}
        for number, (a, b, c) in enumerate(self.triangle.tolist()):
            for side in ((a, b), (b, c), (c, a)):
                sides.setdefault((min(side), max(side)), []).append(number)
        kept = [
            side
            for side, (first, *others) in sides.items()
            if not others or min(abs(normal[first] @ normal[other]) for other in others) < FLAT_COSINE
        ]
        return self.vertex[np.array(kept, dtype=np.int64).reshape(-1, 2)]


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
