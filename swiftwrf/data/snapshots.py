"""Array snapshots: the channel of each antenna element at known positions (channel state information or IQ samples)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid, ArrayPose
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.dataset import Arrays, Numbers, PositionedData, to_positions, to_rotation
from swiftwrf.data.spectra import GRID, Spectra, array_spectra, check_pixels, snapshot_frequencies
from swiftwrf.errors import InputError
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.validation import checked


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Snapshots(PositionedData):
    """Complex channels of a fixed array for n positions of the transmitter.

    Args:
        channel: Channel of each of the K elements in S snapshots (subcarriers or packets), complex (n, S, K) or (n, K).
        position: Positions of the transmitter, (n, 3) [m].
        array: The K elements and the wavelength of the carrier.
        pose: Position and orientation of the array.
        line_of_sight: Whether the direct path is unobstructed, bool (n,). Defaults to True for all.
        time: Time of each row, (n,) [s], if it is known.
        name: Name of the data set.
        fixed_position: Position of the array, (3,) [m], in place of `pose`.
        rotation: Matrix that rotates array into world coordinates, (3, 3), in place of `pose`.
        frequency_hz: Frequency of each snapshot, (S,) [Hz]. Defaults to the carrier of the array, as of packets.
        details: index, named_splits, source and notes of `PositionedData`.

    Raises:
        InputError: A shape that does not match, a number that is not finite, or no pose.

    Example:
        >>> array = PlanarArray.grid(2, 2, spacing=0.06, frequency_hz=2.4e9)
        >>> channel, position = torch.ones(20, 4, dtype=torch.complex64), torch.rand(20, 3)
        >>> Snapshots(channel, position, array=array, pose=ArrayPose((0.0, 2.0, 1.0))).spectra().store.shape
        (20, 90, 360)
    """

    channel: Tensor
    position: Tensor
    array: PlanarArray
    fixed_position: Tensor
    rotation: Tensor
    line_of_sight: Tensor
    time: Tensor | None
    frequency_hz: Tensor | None

    row_fields: ClassVar[tuple[str, ...]] = ("position", "channel", "line_of_sight", "time", "index")

    @checked
    def __init__(
        self,
        channel: Numbers,
        position: Numbers,
        *,
        array: PlanarArray,
        pose: ArrayPose | None = None,
        line_of_sight: Numbers | None = None,
        time: Numbers | None = None,
        name: str = "snapshots",
        fixed_position: Numbers | None = None,
        rotation: Numbers | None = None,
        frequency_hz: Numbers | None = None,
        **details: Any,
    ) -> None:
        if pose is not None:
            fixed_position, rotation = pose.position, pose.rotation
        if fixed_position is None or rotation is None:
            raise InputError(f"{name} needs the pose of the array: pose=ArrayPose(position, orientation)")
        position = to_positions("position", position)
        shape = (len(position), None, len(array.element))
        several = np.ndim(channel) == 3
        channel = to_tensor("channel", channel, torch.complex64, shape if several else shape[::2])
        channel = channel if several else channel[:, None]
        free = torch.ones(len(position)) if line_of_sight is None else line_of_sight
        super().__init__(
            name,
            **details,
            channel=channel,
            position=position,
            array=array,
            fixed_position=to_positions("fixed_position", fixed_position, (3,)),
            rotation=to_rotation(rotation),
            line_of_sight=to_tensor("line_of_sight", free, torch.bool, (None,)),
            time=None if time is None else to_tensor("time", time, torch.float64, (None,)),
            frequency_hz=snapshot_frequencies(frequency_hz, channel, array),
        )

    @property
    def away(self) -> Tensor:
        """Vectors from the array to the transmitter in array coordinates, float64 (n, 3) [m]. z may be negative."""
        return (self.position - self.fixed_position) @ self.rotation

    @property
    def direction(self) -> Tensor:
        """Unit vectors of `away`, (n, 3)."""
        return functional.normalize(self.away, dim=1)

    def spectra(self, grid: AngularGrid | tuple[int, int] | None = None, beamformer: str = PHASE) -> Spectra:
        """Return the spectra of the array, from all snapshots of a position together.

        Args:
            grid: Directions, or their numbers of elevations and azimuths. Defaults to 90 x 360.
            beamformer: Name in `swiftwrf.array.beamforming`: phase, bartlett or capon.

        Raises:
            InputError: An unknown beamformer, too few snapshots for it, or spectra of too many pixels.
        """
        grid = AngularGrid.of(grid or GRID)
        check_pixels(self.name, len(self), grid.shape)
        same = "position line_of_sight index named_splits array source fixed_position rotation channel frequency_hz"
        return Spectra(
            store=array_spectra(self.array, self.channel, grid, beamformer),
            grid=grid,
            moving="transmitter",
            name=self.name,
            notes=self.notes,
            **{field: getattr(self, field) for field in same.split()},
        )

    def _columns(self) -> dict[str, Any]:
        time = {} if self.time is None else {"time_s": self.time.numpy()}
        return time | {"line_of_sight": self.line_of_sight.numpy()}

    def variables(self) -> Arrays:
        return {"channel": (("position", "snapshot", "element"), self.channel.numpy())}

    def _summary(self) -> str:
        return f"{len(self)} channels of {self.channel.shape[1]} snapshots, {self.array.summary}"
