"""Planar antenna arrays: their channels, the spectra that a beamformer computes from them, and their co-array."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le, Lt
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, folded_to_front, to_angles, to_direction
from swiftwrf.array.beamforming import BEAMFORMERS, PHASE
from swiftwrf.errors import InputError
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.validation import PositiveFloat, check_value, checked

LIGHT_SPEED = 299_792_458.0  # [m / s]
MAX_ELEMENTS = 4096  # of an array: the co-array grows with their square
MAX_BASIS_VALUES = 2**28  # of the co-array's basis functions on a grid: 2 GiB
MAX_CACHED_VALUES = 2**25  # of basis functions that are kept: 256 MiB
Side = Annotated[int, Ge(1), Le(MAX_ELEMENTS)]


@dataclass(frozen=True, eq=False)
class PlanarArray:
    """Antenna elements in the plane z = 0 of the array's coordinates.

    Args:
        element: Positions of the K elements, (K, 2) [m], stored as float64.
        wavelength: Wavelength of the carrier [m].

    Raises:
        InputError: Elements of another shape, none or more than 4096 of them, a number that is not finite, or a
            wavelength that is not above 0.

    Example:
        >>> PlanarArray.grid(2, 8, spacing=0.06, frequency_hz=2.4e9)
        <PlanarArray: 16 elements at 2.4 GHz>
    """

    element: Annotated[Tensor, "float64 k 2"]
    wavelength: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "element", to_tensor("element", self.element, torch.float64, (None, 2)))
        if not 1 <= len(self.element) <= MAX_ELEMENTS:
            raise InputError(f"an array has 1 to {MAX_ELEMENTS} elements at positions (K, 2), got {len(self.element)}")
        check_value("wavelength", self.wavelength, Annotated[float, Gt(0), Lt(math.inf)])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PlanarArray) and self._content == other._content

    def __hash__(self) -> int:  # equal arrays share cached results
        return hash(self._content)

    def __repr__(self) -> str:
        return f"<PlanarArray: {self.summary}>"

    @property
    def summary(self) -> str:
        """Number of elements and carrier, in words."""
        return f"{len(self.element)} elements at {self.frequency_hz / 1e9:.4g} GHz"

    @cached_property
    def _content(self) -> tuple[float, ...]:
        return (self.wavelength, *self.element.flatten().tolist())

    @property
    def frequency_hz(self) -> float:
        """Frequency of the carrier [Hz]."""
        return LIGHT_SPEED / self.wavelength

    @classmethod
    @checked
    def square(cls, side: Side, frequency_hz: PositiveFloat, spacing: PositiveFloat | None = None) -> PlanarArray:
        """Return side x side elements, the first at the origin, `spacing` [m] apart. Defaults to half a wavelength.

        Raises:
            InputError: No elements or too many, or a frequency or spacing that is not above 0.

        Example:
            >>> PlanarArray.square(4, frequency_hz=2.4e9)
            <PlanarArray: 16 elements at 2.4 GHz>
        """
        wavelength = LIGHT_SPEED / frequency_hz
        steps = torch.arange(side, dtype=torch.float64) * (spacing or wavelength / 2)
        return cls(torch.cartesian_prod(steps, steps), wavelength)

    @classmethod
    @checked
    def grid(cls, rows: Side, columns: Side, spacing: PositiveFloat, frequency_hz: PositiveFloat) -> PlanarArray:
        """Return rows x columns elements, `spacing` [m] apart and centred on the origin.

        Columns ascend along x and rows along y. Element r * columns + c is that of row r and column c.

        Raises:
            InputError: As `square`.
        """
        y, x = (spacing * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n in (rows, columns))
        return cls(torch.cartesian_prod(y, x).flip(1), LIGHT_SPEED / frequency_hz)

    def subset(self, elements: Tensor) -> PlanarArray:
        """Return the array of some of the elements, by their indices."""
        return PlanarArray(self.element[elements], self.wavelength)

    @property
    def spacing_wavelengths(self) -> float:
        """Median distance of an element from the nearest other one [wavelengths]."""
        apart = torch.cdist(self.element, self.element).fill_diagonal_(torch.inf).amin(dim=1)
        return float(apart.median()) / self.wavelength

    @property
    def opposite(self) -> Tensor | None:
        """Index of the element at the point reflection of each one in the array's centre, (K,). None if one has none.

        Such an array does not distinguish a channel from its conjugate, received by the array rotated by 180 degrees.
        """
        centre = (self.element.amax(dim=0) + self.element.amin(dim=0)) / 2
        apart, number = torch.cdist(2 * centre - self.element, self.element).min(dim=1)
        return number if bool((apart < 1e-2 * self.wavelength).all()) else None

    @cached_property
    def axis(self) -> Tensor | None:
        """Unit vector along the elements of a linear array in array coordinates, float64 (3,). None if they span a plane."""
        offset = self.element.double() - self.element.double().mean(dim=0)
        _, size, axes = torch.linalg.svd(offset, full_matrices=True)
        beside = float((offset @ axes[1]).abs().max())
        if float(size[0]) == 0 or beside > 1e-2 * self.wavelength:
            return None
        first = axes[0] * torch.sign(axes[0][axes[0].abs().argmax()])
        return torch.nn.functional.pad(first, (0, 1))

    def folded(self, direction: Tensor) -> Tensor:
        """Return unit vectors (..., 3), folded to one of the directions that the array does not distinguish.

        A planar array does not distinguish +z from -z, so directions behind it are folded to the front. A linear array
        receives the angle to its axis only, so directions are folded to the half-plane of its axis and +z. The angle between
        two folded directions is the difference of their angles to the axis.

        Example:
            >>> row = PlanarArray.grid(1, 3, spacing=0.06, frequency_hz=2.4e9)
            >>> row.folded(torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)).tolist()
            [0.6, 0.0, 0.8]
        """
        if self.axis is None:
            return folded_to_front(direction)
        along = (direction @ self.axis.to(direction)).clamp(-1, 1)
        beside = (1 - along.square()).sqrt()
        return along[..., None] * self.axis.to(direction) + torch.nn.functional.pad(beside[..., None], (2, 0))

    def phase(self, direction: Tensor) -> Tensor:
        """Return the phase lead (..., K) [rad] of each element over the origin for waves from unit vectors (..., 3).

        It is the phase difference Delta alpha of the paper.
        """
        return 2 * math.pi / self.wavelength * (direction[..., :2].to(self.element) @ self.element.T)

    def phase_at(self, source: Tensor) -> Tensor:
        """Return the phase lead (n, K) [rad] of each element over the origin for waves from points (n, 3) [m].

        The waves are spheres; far away they become those of `phase`.
        """
        element = torch.nn.functional.pad(self.element, (0, 1))
        difference = 2 * source @ element.T - element.square().sum(dim=1)  # of squared distances to origin and element
        total: Tensor = source.norm(dim=-1, keepdim=True) + torch.cdist(source, element)
        return math.tau / self.wavelength * difference / total

    @property
    def far_field_m(self) -> float:
        """Distance 2 D^2 / wavelength [m] beyond which waves are plane over the extent D of the array."""
        return 2 * float(torch.cdist(self.element, self.element).max()) ** 2 / self.wavelength

    @property
    def resolution(self) -> float:
        """Error of a direction [rad] that costs a tenth of the power of the direct path, near the array's normal."""
        axes = 1 if self.axis is not None else 2
        width = math.sqrt(float((self.element - self.element.mean(dim=0)).square().sum(dim=1).mean() / axes))
        return math.sqrt(0.1) * self.wavelength / (math.tau * width)

    def spectrum(self, channel: Tensor, grid: AngularGrid, beamformer: str = PHASE) -> Tensor:
        """Return the magnitude at each direction, in [0, 1], float32 (n, n_elevation, n_azimuth).

        Args:
            channel: Complex channel of each element, (n, K), or (n, S, K) of several snapshots (subcarriers or packets).
            grid: Directions to scan.
            beamformer: phase, bartlett or capon; see `swiftwrf.array.beamforming`. With phase, magnitudes of the
                channel have no effect, as in the paper.

        Raises:
            InputError: An unknown beamformer, or too few snapshots for it.
        """
        if beamformer not in BEAMFORMERS:
            raise InputError(f"unknown beamformer {beamformer!r}; choose from {', '.join(BEAMFORMERS)}")
        snapshots = channel[:, None] if channel.dim() == 2 else channel
        make, functions = BEAMFORMERS[beamformer], basis(self, grid)
        spectrum = torch.empty(len(channel), *grid.shape)
        for rows in torch.arange(len(channel)).split(max(1, min(256, 2**24 // len(self.element) ** 2))):
            squared = make(
                snapshots[rows], lambda matrix: (self.coefficients(matrix) @ functions).reshape(-1, *grid.shape)
            )
            spectrum[rows] = squared.clamp(0, 1).sqrt().float()
        return spectrum

    def coefficients(self, matrix: Tensor) -> Tensor:
        """Return the coefficients (n, 1 + 2 P) of a^H M a in the co-array basis: sums of entries with one difference."""
        a, b, lag = pairs(self)
        half = torch.zeros(len(matrix), len(differences(self)), dtype=torch.complex128)
        half = half.index_add(1, lag, matrix[:, a, b])
        trace = matrix.diagonal(dim1=1, dim2=2).sum(1, keepdim=True).real
        return torch.cat([trace, 2 * half.real, 2 * half.imag], dim=1)

    def channel(self, direction: Tensor, gain: Tensor, owner: Tensor, n: int) -> Tensor:
        """Return the sum of paths at each element, gain * exp(j phase), complex128 (n, K).

        Paths come from directions (P, 3) in array coordinates, with gains (P,) at the origin. Their owner (P,) is one of n
        channels.
        """
        phase = self.phase(direction.double())
        wave = gain.to(torch.complex128)[:, None] * torch.polar(torch.ones_like(phase), phase)
        return torch.zeros(n, len(self.element), dtype=torch.complex128).index_add(0, owner, wave)


def folded_angles(array: PlanarArray | None, angles: Tensor) -> Tensor:
    """Return azimuth and elevation (..., 2) [rad], folded as `PlanarArray.folded`; as they are if the array is unknown."""
    if array is None or array.axis is None:
        return angles
    return torch.stack(to_angles(array.folded(to_direction(*angles.unbind(-1)))), dim=-1)


def differences(array: PlanarArray) -> Tensor:
    """Return half the co-array without 0, one of each pair l, -l, float64 (P, 2) [wavelengths]."""
    return _lags(array)[0]


def pairs(array: PlanarArray) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pairs of elements (a, b) with a difference in the half co-array: a, b and the index of the difference."""
    return _lags(array)[1:]


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # cached tensors must also serve calls that record gradients
def _lags(array: PlanarArray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the half co-array (P, 2) [wavelengths], and the pairs of elements a, b with their index in it."""
    element = array.element.double() / array.wavelength
    every = (element[:, None] - element).reshape(-1, 2)
    rounded = torch.round(every / 1e-6)  # closer differences are one
    rounded, group, count = rounded.unique(dim=0, return_inverse=True, return_counts=True)
    mean = torch.zeros_like(rounded).index_add(0, group, every) / count[:, None]
    first = (rounded[:, 0] > 0) | ((rounded[:, 0] == 0) & (rounded[:, 1] > 0))
    pair = first[group].nonzero()[:, 0]
    number = (first.cumsum(0) - 1)[group[pair]]
    return mean[first], pair // len(element), pair % len(element), number


def basis(array: PlanarArray, grid: AngularGrid, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the functions whose sums are squared spectra: 1, P cosines and P sines, (1 + 2 P, pixels).

    Raises:
        InputError: All elements are at one place, or the functions take more than 2 GiB on this grid.
    """
    n_functions = 1 + 2 * len(differences(array))
    if n_functions == 1:
        raise InputError(
            f"all {len(array.element)} elements of the array are at one place, which receives no direction"
        )
    if (values := n_functions * math.prod(grid.shape)) > MAX_BASIS_VALUES:
        raise InputError(
            f"the {n_functions} functions of this array take {values:.2g} values on a grid of {grid.shape}, more "
            f"than {MAX_BASIS_VALUES:.2g}; take a coarser grid or an array of fewer elements"
        )
    compute = _basis if values <= MAX_CACHED_VALUES else _basis.__wrapped__
    return compute(array, grid, dtype)


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _basis(array: PlanarArray, grid: AngularGrid, dtype: torch.dtype) -> Tensor:
    phase = 2 * math.pi * differences(array) @ grid.direction[..., :2].reshape(-1, 2).T
    return torch.cat([torch.ones_like(phase[:1]), phase.cos(), phase.sin()]).to(dtype)
