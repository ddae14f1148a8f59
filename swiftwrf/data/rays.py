"""Traced ray paths and the spectra that an array makes of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import to_angles
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.files import sha256
from swiftwrf.data.reading import Reading
from swiftwrf.data.spectra import GRID, Moving, Spectra, array_spectra, check_pixels
from swiftwrf.errors import InputError

ARRAY_SIDE = 4


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths from transmitters to receivers, one pair after the other.

    Args:
        transmitter, receiver: positions of the n pairs, float64 (n, 3) [m].
        count: paths of each pair, at least one, int64 (n,).
        direction: unit vectors from the receiver to where the path comes from, in world coordinates, (sum, 3).
        gain: complex amplitude of each path at the receiver with the phase of its whole length, (sum,).
        line_of_sight: whether the direct path is free, bool (n,).
        index: number of each pair in the data set, counted from 0, int64 (n,).
        frequency_hz: of the carrier.
    """

    transmitter: Tensor
    receiver: Tensor
    count: Tensor
    direction: Tensor
    gain: Tensor
    line_of_sight: Tensor
    index: Tensor
    frequency_hz: float

    def spectra(self, folder: Path, how: Reading, files: Iterable[Path], **more: Any) -> Spectra:
        """Spectra of an array that lies level at each receiver (array axes are world axes); it sees the upper half space
        and folds what comes from below.

        Args:
            folder: that the paths come from.
            how: array and grid.
            files: whose digests are kept.
            more: of the spectra's fields.

        Raises:
            InputError: an array for another carrier; spectra of too many pixels.
        """
        grid = how.grid or GRID
        n = len(self.count)
        check_pixels(str(folder), n, grid)
        array = how.array or PlanarArray.square(ARRAY_SIDE, self.frequency_hz)
        own = LIGHT_SPEED / self.frequency_hz
        if abs(array.wavelength - own) > 1e-3 * own:
            raise InputError(
                f"{folder} has a carrier of {self.frequency_hz:.6g} Hz, but the array was given with a wavelength of "
                f"{array.wavelength:.4g} m, not {own:.4g} m"
            )
        owner = torch.arange(n).repeat_interleave(self.count)
        transmitters, receivers = (len(end.unique(dim=0)) for end in (self.transmitter, self.receiver))
        moving: Moving = "receiver" if receivers >= transmitters else "transmitter"
        position, fixed = (self.receiver, self.transmitter)[:: 1 if moving == "receiver" else -1]
        return Spectra(
            name=folder.resolve().name,
            position=position,
            store=array_spectra(array, array.channel(self.direction, self.gain, owner, n), grid),
            grid=grid,
            label=torch.stack(to_angles(self.transmitter - self.receiver), dim=-1),
            line_of_sight=self.line_of_sight,
            moving=moving,
            index=self.index,
            array=array,
            source={file.name: sha256(file) for file in files},
            fixed_position=fixed[0].double() if min(transmitters, receivers) == 1 else None,
            rotation=torch.eye(3, dtype=torch.float64),
            **more,
        )
