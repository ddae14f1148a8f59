"""Array snapshots: the channel of each antenna element at known positions (channel state information or IQ samples)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, ArrayPose
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.dataset import Arrays, Numbers, PositionedData, to_positions, to_rotation
from swiftwrf.data.spectra import GRID, Spectra, array_spectra, check_pixels, snapshot_frequencies
from swiftwrf.errors import InputError, ranges
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
            frequency_hz=snapshot_frequencies(frequency_hz, channel),
        )

    @property
    def away(self) -> Tensor:
        """Vectors from the array to the transmitter in array coordinates, float64 (n, 3) [m]. z may be negative."""
        return (self.position - self.fixed_position) @ self.rotation

    @property
    def direction(self) -> Tensor:
        """Unit vectors of `away`, (n, 3)."""
        direction: Tensor = self.away / self.away.norm(dim=1, keepdim=True)
        return direction

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


def check_spacing(file: Path, array: PlanarArray) -> None:
    """Refuse elements at distances that no array has, e.g. because positions are in millimetres.

    Raises:
        InputError: One element only, or neighbours outside 0.01 to 20 wavelengths.
    """
    if len(array.element) < 2:
        raise InputError(
            f"{file} describes an array of one element, which resolves no directions; at least 2 are needed"
        )
    apart, (low, high) = array.spacing_wavelengths, (0.01, 20.0)  # beyond, the unit is another one
    if not low <= apart <= high:
        raise InputError(
            f"{file}: neighbouring elements are {apart * array.wavelength:.4g} m, {apart:.3g} wavelengths "
            f"apart; expected {low:g} to {high:g} wavelengths, so is the spacing in metres and the carrier in Hz?"
        )


def measured(
    source: Path, channel: Tensor, drop_null: bool = False, drop: Sequence[int] = ()
) -> tuple[Tensor, Tensor, Tensor, tuple[str, ...]]:
    """Return a channel (n, S, K) without what is missing, its snapshots and elements among those given, and notes.

    Missing are values that are 0 or NaN. They become 0, which beamformers do not use.

    Elements to drop, counted from 0, and those without any value are left out. So are snapshots if other rows have fewer of
    them. Null, guard and DC subcarriers hold a constant or nothing: they are the same at every position and element.

    Raises:
        InputError: A position without any value, fewer than 2 elements, or one to leave out that does not exist.

    Example:
        >>> channel = torch.randn(5, 4, 3, dtype=torch.complex64)
        >>> channel[:, 2] = 12 + 3j
        >>> measured(Path("a"), channel, drop_null=True)[1:]
        (tensor([0, 1, 3]), tensor([0, 1, 2]), (...are left out (1 of 4, counted from 0): 2',))
    """
    count, elements = channel.shape[1:]
    missing, notes = (channel == 0) | channel.isnan(), []
    channel = channel.masked_fill(missing, 0)
    if lost := missing.all(dim=2).all(dim=1).nonzero()[:, 0].tolist():
        raise InputError(f"{source}: csi of row {lost[0]} has no power; leave it out")
    if beyond := [number for number in drop if not 0 <= number < elements]:
        raise InputError(f"{source} has elements 0 to {elements - 1}, so element {beyond[0]} cannot be left out")
    silent = missing.all(dim=1).all(dim=0)
    used = ~silent
    used[list(drop)] = False
    if int(used.sum()) < 2:
        raise InputError(
            f"{source}: csi has values at {int(used.sum())} elements; expected at least 2 to resolve directions"
        )
    for which, reason in (
        (silent.nonzero()[:, 0].tolist(), "silent (0 or NaN everywhere)"),
        (list(drop), "to be ignored"),
    ):
        if which:
            named = f"element {which[0]} is" if len(which) == 1 else f"elements {ranges(sorted(which))} are"
            notes.append(f"{named} {reason} and left out (counted from 0)")
    channel, missing = channel[..., used], missing[..., used]
    empty = missing.all(dim=2)
    kept = torch.ones(count, dtype=torch.bool)
    if bool((empty.any(dim=0) & ~empty.all(dim=0)).any()):  # rows differ in their number of packets
        kept = ~empty.all(dim=0)
        notes.append(f"{int(empty.sum())} of {empty.numel()} snapshots are 0 or NaN at all elements and left out")
    elif len(channel) > 1:
        first = channel[:1, :, :1]
        null = ((channel - first).abs() <= 1e-3 * first.abs()).all(dim=2).all(dim=0)
        if bool(null.any()) and not bool(null.all()):
            which_null = f"({int(null.sum())} of {count}, counted from 0): {ranges(null.nonzero()[:, 0].tolist())}"
            name = "null subcarriers, the same at every position and element, are"
            kept = ~null if drop_null else kept
            notes.append(
                f"{name} left out {which_null}"
                if drop_null
                else f"{name} used like the others {which_null}; --drop-null leaves them out"
            )
    if some := int((missing & ~empty[..., None]).sum()):
        notes.append(f"{some} of {missing.numel()} values of single elements are 0 or NaN and not used")
    return channel[:, kept], kept.nonzero()[:, 0], used.nonzero()[:, 0], tuple(notes)


def round_trip_array(array: PlanarArray) -> tuple[PlanarArray, tuple[str, ...]]:
    """Return the array for phases of the way there and back, which change as those of half the wavelength, and a note."""
    note = "phases are those of the way there and back, so half the wavelength counts"
    return PlanarArray(array.element, array.wavelength / 2), (note,)
