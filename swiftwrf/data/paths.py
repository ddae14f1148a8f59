"""Propagation paths of links, and the spectra that an array computes from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, to_angles
from swiftwrf.array.beamforming import unit_phasor
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray, folded_angles
from swiftwrf.choices import Moving
from swiftwrf.data.spectra import GRID, Spectra, array_spectra, check_pixels
from swiftwrf.errors import InputError


@dataclass(frozen=True, eq=False)
class PropagationPaths:
    """The P propagation paths of n links, the paths of one link after those of the other.

    Args:
        transmitter: Position of each link's transmitter, float64 (n, 3) [m].
        receiver: Position of each link's receiver, float64 (n, 3) [m].
        count: Number of paths of each link, which may be 0, int64 (n,).
        direction: Unit vectors from the receiver to where a path arrives from, world coordinates, float64 (P, 3).
        gain: Complex amplitude of each path at the receiver, with the phase of its whole length, complex128 (P,).
        line_of_sight: Whether the direct path is unobstructed, bool (n,).
        frequency_hz: Frequency of the carrier [Hz].
        length: Length of each path [m], float64 (P,), if it is known.
        corner: Points of interaction from transmitter to receiver, nan after the last one, float64 (P, order, 3) [m], if
            they are known.

    Example:
        >>> ends = torch.zeros(1, 3).double(), torch.tensor([[3.0, 0, 0]]).double()
        >>> one, up = torch.ones(1), torch.tensor([[-1.0, 0, 0]]).double()
        >>> PropagationPaths(*ends, one.long(), up, one.cfloat(), one.bool(), 2.4e9).owner
        tensor([0])
    """

    transmitter: Tensor
    receiver: Tensor
    count: Tensor
    direction: Tensor
    gain: Tensor
    line_of_sight: Tensor
    frequency_hz: float
    length: Tensor | None = None
    corner: Tensor | None = None

    @classmethod
    def joined(cls, parts: Sequence[PropagationPaths]) -> PropagationPaths:
        """Return the links of all parts, which have one carrier and the same known fields."""
        first = parts[0]
        columns = [f.name for f in fields(cls) if isinstance(getattr(first, f.name), Tensor)]
        joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in columns}
        return replace(first, **joined)

    @property
    def owner(self) -> Tensor:
        """Index of the link of each path, int64 (P,)."""
        return torch.arange(len(self.count)).repeat_interleave(self.count)

    @property
    def order(self) -> Tensor:
        """Number of interactions of each path, int64 (P,)."""
        assert self.corner is not None
        return self.corner[..., 0].isfinite().sum(dim=1)

    @property
    def reached(self) -> PropagationPaths:
        """The links that have a path."""
        has_path = self.count > 0
        per_link = ("transmitter", "receiver", "count", "line_of_sight")
        kept: dict[str, Any] = {name: getattr(self, name)[has_path] for name in per_link}
        return replace(self, **kept)

    def last_point(self) -> Tensor:
        """Return the last point of each path before the receiver, float64 (P, 3) [m]."""
        assert self.corner is not None
        order, point = self.order, self.transmitter[self.owner].clone()
        bent = order > 0
        point[bent] = self.corner[bent, order[bent] - 1]
        return point

    def channel(self, array: PlanarArray, rotation: Tensor | None = None) -> Tensor:
        """Return the channel of an array, level or rotated into world coordinates, at each receiver, complex128 (n, K)."""
        direction = self.direction if rotation is None else self.direction @ rotation
        return array.channel(direction, self.gain, self.owner, len(self.count))

    def subcarriers(self, array: PlanarArray, number: int = 1, bandwidth_hz: float = 0.0) -> tuple[Tensor, Tensor]:
        """Return the channel of a level array at frequencies around the carrier.

        Args:
            array: The array.
            number: Number S of frequencies, at equal distances. One is that of the carrier.
            bandwidth_hz: Distance of the first and the last frequency [Hz].

        Returns:
            Channels, complex128 (n, S, K), and frequencies, float64 (S,) [Hz].

        Raises:
            InputError: Several frequencies where the lengths of the paths are unknown, one frequency with a bandwidth, or a
                bandwidth that no carrier has.
        """
        if not (bandwidth_hz == 0 if number == 1 else 1e3 <= bandwidth_hz < self.frequency_hz):
            raise InputError(
                f"a bandwidth in Hz goes with several subcarriers, got {bandwidth_hz:g} Hz and {number}; give e.g. 8 "
                "subcarriers and 80e6 Hz"
            )
        offset = bandwidth_hz * (torch.arange(number, dtype=torch.float64) / max(1, number - 1) - (number > 1) / 2)
        delay = (self._known_length() if bandwidth_hz else self.gain.abs()) / LIGHT_SPEED
        channel = []
        for change in offset.tolist():
            at = PlanarArray(array.element, LIGHT_SPEED / (self.frequency_hz + change))
            gain = self.gain * unit_phasor(-2 * math.pi * change * delay)
            channel.append(at.channel(self.direction, gain, self.owner, len(self.count)))
        return torch.stack(channel, dim=1), self.frequency_hz + offset

    def _known_length(self) -> Tensor:
        """Return the length of each path [m]. Free-space amplitudes contain it, and the phases show whether they do."""
        if self.length is not None:
            return self.length
        wavelength = LIGHT_SPEED / self.frequency_hz
        length = wavelength / (4 * math.pi * self.gain.abs())
        turned = self.gain * unit_phasor(2 * math.pi / wavelength * length)
        if not bool((turned.angle().abs() < 0.1).double().mean() > 0.99):
            raise InputError(
                "several subcarriers need the length of each path, and these paths have none; add the array length, or take "
                "one subcarrier"
            )
        return length

    def spectra(
        self,
        name: str,
        array: PlanarArray | None = None,
        grid: AngularGrid | tuple[int, int] | None = None,
        *,
        subcarriers: int | None = None,
        bandwidth_hz: float | None = None,
        **details: Any,
    ) -> Spectra:
        """Return the spectra of a level array at each receiver, which folds paths from below to the upper half space.

        Args:
            name: Name of the data set.
            array: The array. Defaults to 4 x 4 elements at half a wavelength.
            grid: Directions, or their numbers of elevations and azimuths. Defaults to 90 x 360.
            subcarriers: Number of frequencies at which the channel is kept. Defaults to spectra alone.
            bandwidth_hz: Distance of the first and the last of them [Hz].
            details: index, named_splits, source and notes of `Spectra`.

        Raises:
            InputError: An array for another carrier, spectra of too many pixels, or as `subcarriers`.
        """
        grid = AngularGrid.of(grid or GRID)
        check_pixels(name, len(self.count), grid.shape)
        array, wavelength = array or PlanarArray.square(4, self.frequency_hz), LIGHT_SPEED / self.frequency_hz
        if abs(array.wavelength - wavelength) > 1e-3 * wavelength:
            raise InputError(
                f"{name} has a carrier of {self.frequency_hz:.6g} Hz, but the array was given with a wavelength of "
                f"{array.wavelength:.4g} m, not {wavelength:.4g} m"
            )
        transmitters, receivers = (len(end.unique(dim=0)) for end in (self.transmitter, self.receiver))
        moving: Moving = "receiver" if receivers >= transmitters else "transmitter"
        position, fixed = (self.receiver, self.transmitter)[:: 1 if moving == "receiver" else -1]
        channel, frequency = self.subcarriers(array, subcarriers or 1, bandwidth_hz or 0.0)
        return Spectra(
            store=array_spectra(array, channel, grid),
            position=position,
            array=array,
            grid=grid,
            label=folded_angles(array, torch.stack(to_angles(self.transmitter - self.receiver), dim=-1)),
            line_of_sight=self.line_of_sight,
            moving=moving,
            name=name,
            fixed_position=fixed[0] if min(transmitters, receivers) == 1 else None,
            rotation=torch.eye(3, dtype=torch.float64),
            channel=channel if subcarriers else None,
            frequency_hz=frequency,
            **details,
        )
