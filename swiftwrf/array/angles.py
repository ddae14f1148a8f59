"""Directions in array coordinates: the angular grid of a spectrum, unit vectors, angular distances, the pose of an array.

Axes and units are those of docs/conventions.md: azimuth counter-clockwise from the array's x axis, elevation from its
plane (0) to its normal (90 degrees). Angles are in radians inside the package and in degrees at its borders.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import torch
from annotated_types import Ge, Le
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, checked, configuration

MAX_GRID_PIXELS = 2**24  # of one spectrum
Size = Annotated[int, Ge(2), Le(MAX_GRID_PIXELS)]


@configuration
class AngularGrid:
    """Directions of the pixels of a spectrum: evenly spaced elevations (rows) and azimuths (columns, periodic).

    Args:
        elevation_start: Elevation of row 0 [rad].
        elevation_step: Elevation difference between rows, above 0 [rad].
        n_elevation: Number of rows.
        azimuth_start: Azimuth of column 0 [rad]. The columns cover the whole circle.
        n_azimuth: Number of columns.

    Raises:
        InputError: No pixels, more than 2^24 pixels, or an angle that is not finite.

    Example:
        >>> AngularGrid.hemisphere(90, 360).shape
        (90, 360)
    """

    elevation_start: float
    elevation_step: PositiveFloat
    n_elevation: PositiveInt
    azimuth_start: float
    n_azimuth: PositiveInt

    def check(self) -> None:
        """Refuse too many pixels, and angles that are not finite."""
        angles = self.elevation_start, self.elevation_step, self.azimuth_start
        if math.prod(self.shape) > MAX_GRID_PIXELS or not all(map(math.isfinite, angles)):
            raise InputError(f"a grid has finite angles [rad] and at most {MAX_GRID_PIXELS} pixels, got {self}")

    @classmethod
    @checked
    def hemisphere(cls, n_elevation: Size, n_azimuth: Size) -> AngularGrid:
        """Return the grid of that size whose last row is at elevation 90 degrees, the layout of the NeRF2 spectra.

        Raises:
            InputError: A size that is no whole number from 2 on, or too many pixels.
        """
        step = math.radians(90 / n_elevation)
        return cls(step, step, n_elevation, 0.0, n_azimuth)

    @classmethod
    @checked
    def ring(cls, n_azimuth: Size) -> AngularGrid:
        """Return one row of azimuths in the plane of the array, the grid of an array that does not resolve elevations.

        Raises:
            InputError: A size that is no whole number from 2 on, or too many pixels.

        Example:
            >>> AngularGrid.ring(72).direction[0, 18].round(decimals=3).tolist()
            [0.0, 1.0, 0.0]
        """
        return cls(0.0, math.tau / n_azimuth, 1, 0.0, n_azimuth)

    @classmethod
    def of(cls, grid: AngularGrid | tuple[int, int]) -> AngularGrid:
        """Return a grid as it is, or `hemisphere` of a pair of rows and columns, with one row `ring`."""
        if isinstance(grid, AngularGrid):
            return grid
        n_elevation, n_azimuth = grid
        return cls.ring(n_azimuth) if n_elevation == 1 else cls.hemisphere(n_elevation, n_azimuth)

    def coarsen(self, factor: int) -> AngularGrid:
        """Return the grid of the centres of factor x factor pixels. Both sizes must be multiples of the factor."""
        middle = (factor - 1) / 2
        return AngularGrid(
            self.elevation_start + middle * self.elevation_step,
            self.elevation_step * factor,
            self.n_elevation // factor,
            self.azimuth_start + middle * self.azimuth_step,
            self.n_azimuth // factor,
        )

    @property
    def azimuth_step(self) -> float:
        """Azimuth difference between columns [rad]."""
        return math.tau / self.n_azimuth

    @property
    def shape(self) -> tuple[int, int]:
        """(n_elevation, n_azimuth)."""
        return self.n_elevation, self.n_azimuth

    @cached_property
    @torch.inference_mode(False)  # cached tensors must also serve calls that record gradients
    def elevation(self) -> Tensor:
        """Elevation of each row, float64 (n_elevation,) [rad]."""
        return self.elevation_start + self.elevation_step * torch.arange(self.n_elevation, dtype=torch.float64)

    @cached_property
    @torch.inference_mode(False)
    def azimuth(self) -> Tensor:
        """Azimuth of each column, float64 (n_azimuth,) [rad]."""
        return self.azimuth_start + self.azimuth_step * torch.arange(self.n_azimuth, dtype=torch.float64)

    @cached_property
    @torch.inference_mode(False)
    def direction(self) -> Tensor:
        """Unit vector of each pixel in array coordinates, float64 (n_elevation, n_azimuth, 3)."""
        return to_direction(self.azimuth[None, :], self.elevation[:, None])

    def peak_direction(self, spectrum: Tensor) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of the largest magnitude of spectra (n, n_elevation, n_azimuth)."""
        pixel = spectrum.flatten(1).argmax(dim=1).cpu()
        angles = torch.stack([self.azimuth[pixel % self.n_azimuth], self.elevation[pixel // self.n_azimuth]], dim=-1)
        return angles.to(spectrum.device)


def to_direction(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Return unit vectors (..., 3) of azimuth and elevation (...) [rad], which broadcast.

    Example:
        >>> to_direction(torch.tensor(0.0), torch.tensor(0.0)).tolist()
        [1.0, 0.0, 0.0]
    """
    azimuth, elevation = torch.broadcast_tensors(azimuth, elevation)
    flat = torch.cos(elevation)
    return torch.stack([flat * torch.cos(azimuth), flat * torch.sin(azimuth), torch.sin(elevation)], dim=-1)


def to_angles(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return azimuth in [0, 2 pi) and elevation in [0, pi/2] (...) [rad] of vectors (..., 3) in array coordinates.

    A planar array does not distinguish +z from -z, so directions behind it are folded to the front.
    """
    x, y, z = direction.unbind(-1)
    azimuth = torch.remainder(torch.atan2(y, x), math.tau)
    azimuth = azimuth.where(azimuth < math.tau, torch.zeros_like(azimuth))  # remainder rounds -tiny up to 2 pi
    return azimuth, torch.atan2(z.abs(), torch.hypot(x, y))


def folded_to_front(direction: Tensor) -> Tensor:
    """Return vectors (..., 3) with z made positive: a planar array does not distinguish +z from -z."""
    return torch.cat([direction[..., :2], direction[..., 2:].abs()], dim=-1)


def wrap(angle: Tensor) -> Tensor:
    """Return the angle [rad] in [-pi, pi] that differs by a multiple of 2 pi."""
    return angle - math.tau * torch.round(angle / math.tau)


def rotation_matrix(turn: Any) -> Tensor:
    """Return the matrix (3, 3) of a rotation vector (3,) [rad], a tensor or an array."""
    return torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())


def angular_distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle in [0, pi] (...) [rad] between vectors a and b (..., 3). Unlike acos, it is exact for small angles.

    Example:
        >>> round(float(angular_distance(torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0]))), 4)
        1.5708
    """
    return torch.atan2(torch.linalg.cross(a, b, dim=-1).norm(dim=-1), (a * b).sum(dim=-1))


@dataclass(frozen=True)
class ArrayPose:
    """Position and orientation of an array.

    Args:
        position: Position of the array's reference point, 3 numbers [m].
        orientation: Unit quaternion (x, y, z, w) that rotates array into world coordinates. Defaults to no rotation.

    Raises:
        InputError: The length of the quaternion differs from 1 by more than 1e-3, or a number is not finite.

    Example:
        >>> ArrayPose((0.0, 0.0, 1.0)).rotation.diagonal().tolist()
        [1.0, 1.0, 1.0]
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("orientation", 4)):
            numbers = to_tensor(f"the array's {name}", getattr(self, name), torch.float64, (size,))
            object.__setattr__(self, name, tuple(numbers.tolist()))
        length = math.hypot(*self.orientation)
        if abs(length - 1) > 1e-3:
            raise InputError(
                f"the array's orientation must be a unit quaternion (x, y, z, w), got {list(self.orientation)} of "
                f"length {length:.4g}; divide it by its length"
            )

    @classmethod
    def facing(
        cls,
        position: tuple[float, float, float],
        normal: tuple[float, float, float],
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> ArrayPose:
        """Return the pose of an array by the direction that it faces.

        Args:
            position: Position of the array's reference point, 3 numbers [m].
            normal: Normal of the array in the world, of any length.
            up: World direction that the y axis of the array is closest to.

        Raises:
            InputError: A normal without length, one along `up`, or a number that is not finite.

        Example:
            >>> ArrayPose.facing((0.1, 2.4, 1.2), normal=(1, 0, 0)).rotation[:, 1].abs().round().tolist()
            [0.0, 0.0, 1.0]
        """
        z, y = (
            to_tensor(f"the array's {name}", axis, torch.float64, (3,))
            for name, axis in (("normal", normal), ("up", up))
        )
        z, y = z / z.norm(), y / y.norm()
        y = y - (y @ z) * z
        if not float(y.norm()) > 1e-3:
            raise InputError(
                f"the array's normal {list(normal)} has no length or lies along up {list(up)}; give as up the direction of "
                "the array's y axis"
            )
        y = y / y.norm()
        matrix = torch.stack([torch.linalg.cross(y, z), y, z], dim=1)
        return cls(position, tuple(Rotation.from_matrix(matrix.numpy()).as_quat().tolist()))

    @cached_property
    @torch.inference_mode(False)
    def rotation(self) -> Tensor:
        """Matrix that rotates array into world coordinates, float64 (3, 3)."""
        return torch.from_numpy(Rotation.from_quat(self.orientation).as_matrix())
