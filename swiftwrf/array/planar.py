"""What a planar antenna array reports of the paths that reach it (paper, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import BEAMFORMERS, PHASE
from swiftwrf.errors import InputError

LIGHT_SPEED = 299_792_458.0  # [m / s]
MOST_ELEMENTS = 4096  # of an array: what follows grows with their square
MOST_VALUES = 2**28  # of the co-array's functions on a grid: 2 GiB
SAME = 1e-6  # differences closer than this share of a wavelength are one
OPPOSITE = 1e-2  # an element closer than this share of a wavelength to where it would lie opposite does so
AT_ONCE, MOST_PAIRS = 256, 2**24  # spectra, and pairs of elements, in double precision


@dataclass(frozen=True, eq=False)
class PlanarArray:
    """Elements in the plane z = 0 of the array's coordinates.

    Args:
        element: positions (K, 2) [m], float64.
        wavelength: of the carrier [m].

    Raises:
        InputError: elements of another shape, no or too many of them, or something that is not finite.
    """

    element: Tensor
    wavelength: float

    def __post_init__(self) -> None:
        shape = tuple(self.element.shape)
        if len(shape) != 2 or shape[1] != 2 or not 1 <= shape[0] <= MOST_ELEMENTS:
            raise InputError(f"an array has 1 to {MOST_ELEMENTS} elements at positions (K, 2), got shape {shape}")
        if not bool(self.element.isfinite().all()) or not 0 < self.wavelength < math.inf:
            raise InputError(
                "an array's elements need finite positions [m] and its carrier a wavelength above 0 m, got "
                f"{self.wavelength}"
            )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PlanarArray) and self._content == other._content

    def __hash__(self) -> int:  # equal arrays share what is computed for one
        return hash(self._content)

    @cached_property
    def _content(self) -> tuple[float, ...]:
        return (self.wavelength, *self.element.flatten().tolist())

    @property
    def frequency_hz(self) -> float:
        """Of the carrier."""
        return LIGHT_SPEED / self.wavelength

    @classmethod
    def square(cls, side: int, frequency_hz: float, spacing: float | None = None) -> PlanarArray:
        """side x side elements, `spacing` [m] or else half a wavelength apart, the first at the origin."""
        wavelength = LIGHT_SPEED / frequency_hz
        steps = torch.arange(side, dtype=torch.float64) * (spacing or wavelength / 2)
        return cls(torch.cartesian_prod(steps, steps), wavelength)

    @classmethod
    def grid(cls, rows: int, columns: int, spacing: float, frequency_hz: float) -> PlanarArray:
        """rows x columns elements, `spacing` [m] apart and centred on the origin; the element of row r and column c is
        number r * columns + c, columns ascend along x and rows along y."""
        y, x = (spacing * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n in (rows, columns))
        return cls(torch.cartesian_prod(y, x).flip(1), LIGHT_SPEED / frequency_hz)

    @property
    def opposite(self) -> Tensor | None:
        """Which element lies across the array's centre from each one, (K,); None where none does for one of them.

        An array with such elements cannot tell a channel from its conjugate, seen by an array turned by half a turn.
        """
        centre = (self.element.amax(dim=0) + self.element.amin(dim=0)) / 2
        apart, number = torch.cdist(2 * centre - self.element, self.element).min(dim=1)
        return number if bool((apart < OPPOSITE * self.wavelength).all()) else None

    def phase(self, direction: Tensor) -> Tensor:
        """By how much each element leads the origin for a wave from unit vectors (..., 3), (..., K) [rad] (paper, the
        phase difference Delta alpha)."""
        return 2 * math.pi / self.wavelength * (direction[..., :2].to(self.element) @ self.element.T)

    def spectrum(self, channel: Tensor, grid: AngularGrid, beamformer: str = PHASE) -> Tensor:
        """The magnitude at each direction, in [0, 1], float32 (n, n_elevation, n_azimuth).

        With `phase`, the default, only the phases of the channel count: what the array reports is where the wave comes
        from, not its power.

        Args:
            channel: complex channel of each element, (n, K), or (n, S, K) of several snapshots (subcarriers or packets).
            grid: the directions to scan.
            beamformer: of `swiftwrf.array.beamforming`: phase, bartlett or capon.

        Raises:
            InputError: an unknown beamformer, or too few snapshots for it.
        """
        snapshots = channel[:, None] if channel.dim() == 2 else channel
        make = BEAMFORMERS[beamformer]
        drawn = torch.empty(len(channel), *grid.shape)
        for rows in torch.arange(len(channel)).split(max(1, min(AT_ONCE, MOST_PAIRS // len(self.element) ** 2))):
            squared = make(snapshots[rows], lambda matrix: self.responses(matrix, grid))
            drawn[rows] = squared.clamp(0, 1).sqrt().float()
        return drawn

    def responses(self, matrix: Tensor, grid: AngularGrid) -> Tensor:
        """a^H M a of Hermitian matrices (n, K, K) for the steering vectors a of a grid, float64 (n, n_elevation, n_azimuth).

        What elements of one difference say is added up first: a few dozen real numbers are left of a matrix (see
        `swiftwrf.models.coarray`).
        """
        a, b, lag = pairs(self)
        functions = basis(self, grid)
        half = torch.zeros(len(matrix), len(functions) // 2, dtype=torch.complex128).index_add(1, lag, matrix[:, a, b])
        trace = matrix.diagonal(dim1=1, dim2=2).sum(1, keepdim=True).real
        coefficient = torch.cat([trace, 2 * half.real, 2 * half.imag], dim=1)
        return (coefficient @ functions).reshape(-1, *grid.shape)

    def channel(self, direction: Tensor, gain: Tensor, owner: Tensor, n: int) -> Tensor:
        """Sum of paths at each element: gain exp(j phase), complex128 (n, K).

        Args:
            direction: unit vectors towards where the paths come from, in array coordinates, (paths, 3).
            gain: complex amplitude of each path at the origin, (paths,).
            owner: which of the n channels a path belongs to, (paths,).
        """
        phase = self.phase(direction.double())
        wave = gain.to(torch.complex128)[:, None] * torch.polar(torch.ones_like(phase), phase)
        return torch.zeros(n, len(self.element), dtype=torch.complex128).index_add(0, owner, wave)


def differences(array: PlanarArray) -> Tensor:
    """The co-array without 0, one of each pair l, -l, float64 (P, 2) [wavelengths]."""
    return _lags(array)[0]


def pairs(array: PlanarArray) -> tuple[Tensor, Tensor, Tensor]:
    """Of all pairs of elements (a, b) with a difference in the half co-array: a, b and the number of the difference."""
    return _lags(array)[1:]


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # what is kept must also serve calls that await gradients
def _lags(array: PlanarArray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The half co-array (P, 2) [wavelengths], and the pairs of elements a, b with their number in it."""
    element = array.element.double() / array.wavelength
    every = (element[:, None] - element).reshape(-1, 2)
    rounded, group, count = torch.round(every / SAME).unique(dim=0, return_inverse=True, return_counts=True)
    mean = torch.zeros_like(rounded).index_add(0, group, every) / count[:, None]
    first = (rounded[:, 0] > 0) | ((rounded[:, 0] == 0) & (rounded[:, 1] > 0))
    pair = first[group].nonzero()[:, 0]
    number = (first.cumsum(0) - 1)[group[pair]]
    return mean[first], pair // len(element), pair % len(element), number


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # what is kept must also serve calls that await gradients
def basis(array: PlanarArray, grid: AngularGrid, dtype: torch.dtype = torch.float64) -> Tensor:
    """The functions that squared spectra consist of: 1, P cosines, P sines, (1 + 2 P, pixels); kept for the next call."""
    between = differences(array)
    if (values := (1 + 2 * len(between)) * math.prod(grid.shape)) > MOST_VALUES:
        raise InputError(
            f"the {1 + 2 * len(between)} functions of this array take {values:.2g} values on a grid of {grid.shape}, more "
            f"than {MOST_VALUES:.2g}; take a coarser grid or an array of fewer elements"
        )
    phase = 2 * math.pi * between @ grid.direction[..., :2].reshape(-1, 2).T
    return torch.cat([torch.ones_like(phase[:1]), phase.cos(), phase.sin()]).to(dtype)
