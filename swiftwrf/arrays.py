"""What a planar antenna array reports of the paths that reach it (paper, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.angles import AngularGrid
from swiftwrf.beamforming import BEAMFORMERS, PHASE
from swiftwrf.errors import InputError

LIGHT_SPEED = 299_792_458.0  # [m / s]
MOST_ELEMENTS = 4096  # of an array: what follows grows with their square


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
            beamformer: of `swiftwrf.beamforming`: phase, bartlett or capon.

        Raises:
            InputError: an unknown beamformer, or too few snapshots for it.
        """
        steering = torch.polar(torch.ones((), dtype=torch.float64), self.phase(grid.direction)).flatten(0, 1)
        snapshots = channel[:, None] if channel.dim() == 2 else channel
        squared = BEAMFORMERS[beamformer].make(snapshots, steering)
        return squared.clamp(0, 1).sqrt().reshape(-1, *grid.shape)

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
