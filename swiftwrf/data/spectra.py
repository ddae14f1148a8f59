"""Spatial spectra measured at known positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge, Lt
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, ArrayPose, to_angles
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray, folded_angles
from swiftwrf.choices import CARRIERS_HZ, Moving
from swiftwrf.data.dataset import Arrays, Numbers, PositionedData, to_positions, to_rotation
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.data.store import BATCH_PIXELS, MAX_FILE_PIXELS, MAX_FINE_PIXELS, MAX_MEMORY_PIXELS, Store, stored
from swiftwrf.errors import InputError
from swiftwrf.metrics import WINDOW
from swiftwrf.plotting import Axes, mark_direction, polar_spectrum
from swiftwrf.positions import to_tensor
from swiftwrf.runtime.digest import digest
from swiftwrf.runtime.validation import check_value, checked

GRID = AngularGrid.hemisphere(90, 360)  # of spectra that are computed
OF_SPECTRA = ("line_of_sight", "label", "channel", "frequency_hz")  # arrays beside the spectra in spectrum.npz
DIRECTION = ("elevation", "azimuth")  # names of the dimensions of a spectrum


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Spectra(PositionedData):
    """Spatial spectra at n positions of the moving end of a link.

    Args:
        spectra: Magnitudes in [0, 1], or bytes of which 255 stands for 1, (n, n_elevation, n_azimuth).
        position: Positions of the moving end, (n, 3) [m].
        array: The antenna array, if it is known.
        pose: Pose of the array. If the transmitter moves, its position is that of the fixed end; if the receiver moves, only
            its orientation counts.
        moving: The end that moves: "transmitter" or "receiver". The array is at the receiver.
        grid: Directions of the pixels. Defaults to elevations up to 90 degrees and azimuths from 0 on.
        label: Azimuth and elevation of the line of sight in array coordinates, (n, 2) [rad]. Defaults to the directions that
            follow from the pose and the fixed end, nan if these are unknown.
        line_of_sight: Whether the direct path is unobstructed, bool (n,). Defaults to True for all.
        name: Name of the data set.
        fixed_position: Position of the end that does not move, (3,) [m], if it does not follow from `pose`.
        rotation: Matrix that rotates array into world coordinates, (3, 3), in place of `pose`.
        store: Spectra as a `Store`, in place of `spectra`; readers of files give one.
        channel: Snapshots that the spectra are computed from, complex (n, S, K), if they are kept.
        frequency_hz: Frequency of each snapshot, (S,) [Hz]. Defaults to the carrier of the array, as of packets.
        details: index, named_splits, source and notes of `PositionedData`.

    Raises:
        InputError: A length that does not match, a number that is not finite, a magnitude outside [0, 1], another `moving`.

    Example:
        >>> spectra, position = torch.rand(20, 9, 36), torch.rand(20, 3)
        >>> data = Spectra(spectra, position, pose=ArrayPose((0.0, 2.0, 1.0)), moving="transmitter")
        >>> data.grid.shape, data.label.shape
        ((9, 36), torch.Size([20, 2]))
    """

    position: Tensor
    store: Store
    grid: AngularGrid
    label: Tensor
    line_of_sight: Tensor
    moving: Moving
    array: PlanarArray | None
    fixed_position: Tensor | None
    rotation: Tensor | None
    channel: Tensor | None
    frequency_hz: Tensor | None

    row_fields: ClassVar[tuple[str, ...]] = ("position", "store", "label", "line_of_sight", "index", "channel")

    @checked
    def __init__(
        self,
        spectra: Numbers | None = None,
        position: Numbers | None = None,
        *,
        array: PlanarArray | None = None,
        pose: ArrayPose | None = None,
        moving: Moving = "transmitter",
        grid: AngularGrid | None = None,
        label: Numbers | None = None,
        line_of_sight: Numbers | None = None,
        name: str = "spectra",
        fixed_position: Numbers | None = None,
        rotation: Numbers | None = None,
        store: Store | None = None,
        channel: Numbers | None = None,
        frequency_hz: Numbers | None = None,
        **details: Any,
    ) -> None:
        if position is None or (spectra is None) == (store is None):
            raise InputError("Spectra takes spectra and their positions: Spectra(spectra, position, ...)")
        position = to_positions("position", position)
        if store is None:
            store = Store(to_magnitudes("spectra", spectra, (None, None, None)))
        grid = grid or AngularGrid.of((store.shape[1], store.shape[2]))
        if grid.shape != store.shape[1:]:
            raise InputError(f"spectra of shape {store.shape} do not fit a grid of {grid.shape} directions")
        if pose is not None:
            if rotation is not None or (fixed_position is not None and moving == "transmitter"):
                raise InputError(
                    "pose gives the orientation and, if the transmitter moves, the fixed position; leave them out"
                )
            rotation = pose.rotation
            fixed_position = pose.position if moving == "transmitter" else fixed_position
        if fixed_position is not None:
            fixed_position = to_positions("fixed_position", fixed_position, (3,))
        if rotation is not None:
            rotation = to_rotation(rotation)
        if label is not None:
            label = to_directions("label", label, missing=True)
        elif fixed_position is not None and rotation is not None:
            if bool((same := (position == fixed_position).all(dim=1)).any()):
                raise InputError(
                    f"position {int(same.nonzero()[0])} of {name} is that of the fixed end, so it has no direction"
                )
            label = direction_of_link(position, fixed_position, rotation, moving, array)
        else:
            label = torch.full((len(position), 2), torch.nan, dtype=torch.float64)
        free = torch.ones(len(position)) if line_of_sight is None else line_of_sight
        if channel is not None:
            channel = to_tensor("channel", channel, torch.complex64, (None, None, None))
        super().__init__(
            name,
            **details,
            position=position,
            store=store,
            grid=grid,
            label=label,
            line_of_sight=to_tensor("line_of_sight", free, torch.bool, (None,)),
            moving=moving,
            array=array,
            fixed_position=fixed_position,
            rotation=rotation,
            channel=channel,
            frequency_hz=None if channel is None else snapshot_frequencies(frequency_hz, channel, array),
        )

    @property
    def spectrum(self) -> Tensor:
        """All magnitudes, float32 (n, n_elevation, n_azimuth) in [0, 1].

        Raises:
            InputError: More spectra than fit into memory.
        """
        if math.prod(self.store.shape) > MAX_MEMORY_PIXELS:
            raise InputError(
                f"{self.name} has {len(self)} spectra, which do not fit into memory at once; take some (subset) or read "
                "them by the batch (store)"
            )
        return self.store[:]

    def in_memory(self) -> Spectra:
        """Return the data with the spectra as float32 in memory, for repeated access."""
        return replace(self, store=Store(self.spectrum))

    def direction_at(self, position: Numbers) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of the line of sight with the moving end at positions (n, 3) [m].

        Raises:
            InputError: The fixed end or the array's orientation is unknown.
        """
        if self.fixed_position is None or self.rotation is None:
            raise InputError(
                f"{self.name} does not describe the position of the fixed end and the orientation of the array, so the "
                "direction at synthetic positions is unknown"
            )
        position = to_positions("position", position)
        return direction_of_link(position, self.fixed_position, self.rotation, self.moving, self.array)

    def peak_direction(self, rows: Tensor) -> Tensor:
        """Return azimuth and elevation (m, 2) [rad] of the largest magnitude of some spectra, folded as the labels."""
        return folded_angles(self.array, self.grid.peak_direction(self.store[rows]))

    def coarsen(self, factor: int) -> Spectra:
        """Return the spectra averaged over squares of factor x factor pixels.

        Raises:
            InputError: The numbers of rows and columns are not multiples of the factor.
        """
        if factor == 1:
            return self
        if any(size % factor for size in self.grid.shape):
            raise InputError(f"spectra of {self.grid.shape} pixels cannot be averaged over {factor} x {factor} of them")
        return replace(self, store=self.store.coarsen(factor), grid=self.grid.coarsen(factor))

    def at_most(self, azimuths: int) -> Spectra:
        """Return the spectra averaged to at most that many columns, with enough rows for SSIM; 0 keeps all pixels."""
        return self.coarsen(coarsening(self.grid.shape, azimuths, least_rows=WINDOW))

    def plot(self, row: int = 0, ax: Axes | None = None) -> Axes:
        """Draw a spectrum and the direction of the line of sight, seen along the normal of the array.

        Args:
            row: Number of the spectrum.
            ax: Polar axes to draw into. Defaults to those of a new figure.

        Raises:
            InputError: No spectrum of this number.

        Example:
            >>> import swiftwrf
            >>> swiftwrf.simulated_room(n=20).plot(3).get_title()
            'simulated-room 3 at ... m'
        """
        check_value("row", row, Annotated[int, Ge(-len(self)), Lt(len(self))])
        one = self.subset(torch.arange(len(self))[[row]])
        ax = polar_spectrum(one.spectrum[0], self.grid, ax)
        if bool(one.label.isfinite().all()):
            azimuth, elevation = one.label[0].tolist()
            mark_direction(ax, azimuth, elevation, "line of sight")
        at = ", ".join(f"{coordinate:.2f}" for coordinate in one.position[0].tolist())
        ax.set_title(f"{self.name} {int(one.index[0])} at ({at}) m")
        return ax

    def _columns(self) -> dict[str, Any]:
        azimuth, elevation = self.label.rad2deg().numpy().T
        return {"azimuth_deg": azimuth, "elevation_deg": elevation, "line_of_sight": self.line_of_sight.numpy()}

    def coordinates(self) -> Arrays:
        return super().coordinates() | direction_coordinates(self.grid)

    def variables(self) -> Arrays:
        label = self.label.rad2deg().numpy()
        return {
            "spectrum": (("position", *DIRECTION), self.spectrum.numpy(), {"units": "1"}),
            "label": (("position", "angle"), label, {"units": "degree"}),
            "line_of_sight": (("position",), self.line_of_sight.numpy()),
        }

    def _summary(self) -> str:
        rows, columns = self.grid.shape
        array = f", {self.array.summary}" if self.array else ""
        return f"{len(self)} spectra of {rows} x {columns} directions{array}, moving {self.moving}"


def to_magnitudes(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return spectra as float32, or as the bytes that they are; refuse magnitudes outside [0, 1] and other shapes."""
    is_bytes = getattr(value, "dtype", None) in (torch.uint8, "uint8")
    magnitudes = to_tensor(name, value, torch.uint8 if is_bytes else torch.float32, shape)
    low, high = (0.0, 1.0) if is_bytes or not magnitudes.numel() else map(float, magnitudes.aminmax())
    if low < -1e-6 or high > 1 + 1e-6:  # from rounding
        raise InputError(f"{name} are magnitudes in [0, 1], got {low:.4g} to {high:.4g}; divide them by the largest")
    return magnitudes if is_bytes else magnitudes.clamp(0, 1)


def to_directions(name: str, value: Any, n: int | None = None, missing: bool = False) -> Tensor:
    """Return azimuth and elevation [rad] of n spectra as float64 (n, 2); refuse other numbers, e.g. degrees."""
    directions = to_tensor(name, value, torch.float64, (n, 2), missing)
    largest = torch.tensor([math.tau, math.pi / 2], dtype=torch.float64) + 1e-6  # from rounding
    if bool((bad := (directions.abs() > largest).any(dim=1)).any()):
        raise InputError(
            f"{name} must be azimuth up to 2 pi and elevation up to pi / 2 [rad], got {directions[bad][0].tolist()}; "
            "convert degrees by deg2rad"
        )
    return directions


def snapshot_frequencies(
    frequency_hz: Numbers | None, channel: Tensor, array: PlanarArray | None, max_ratio: float = 2.05
) -> Tensor | None:
    """Return the frequency of each snapshot of channels (n, S, K), float64 (S,) [Hz], checked; None if none are given.

    The ratio to the frequency of the array is at most `max_ratio`; 2 is the way there and back.

    Raises:
        InputError: Another number of frequencies than snapshots, one that no carrier has, or one far from the array's.
    """
    if frequency_hz is None:
        return None
    frequency = to_tensor("frequency_hz", frequency_hz, torch.float64, (channel.shape[1],))
    low, high = CARRIERS_HZ
    if array is not None:
        low, high = array.frequency_hz / max_ratio, array.frequency_hz * max_ratio
    if len(frequency) and not low <= float(frequency.max()) <= 2 * float(frequency.min()) <= 2 * high:
        raise InputError(
            f"frequency_hz must be frequencies of one carrier's snapshots, {low:.4g} to {high:.4g} Hz, got "
            f"{float(frequency.min()):.6g} to {float(frequency.max()):.6g}; give Hz of the array's band"
        )
    return frequency


def direction_coordinates(grid: AngularGrid) -> Arrays:
    """Return elevation and azimuth [deg] of the rows and columns of spectra.

    Example:
        >>> direction_coordinates(AngularGrid.hemisphere(3, 4))["azimuth"][1].tolist()
        [0.0, 90.0, 180.0, 270.0]
    """
    angles = zip(DIRECTION, (grid.elevation, grid.azimuth), strict=True)
    return {name: ((name,), angle.rad2deg().numpy(), {"units": "degree"}) for name, angle in angles}


def array_spectra(array: PlanarArray, channel: Tensor, grid: AngularGrid, beamformer: str = PHASE) -> Store:
    """Return the spectra of channels, as `PlanarArray.spectrum` for any number of them.

    Raises:
        InputError: As `PlanarArray.spectrum`, or a cache directory without room.
    """
    shape = (len(channel), *grid.shape)
    rows = torch.arange(len(channel)).split(max(1, BATCH_PIXELS // math.prod(grid.shape)))
    how = version("swiftwrf-tasks"), beamformer, array, grid
    return stored(
        shape,
        torch.float32,
        lambda: digest(how, channel),
        lambda: (array.spectrum(channel[r], grid, beamformer) for r in rows),
    )


def direction_of_link(
    position: Tensor, fixed_position: Tensor, rotation: Tensor, moving: Moving, array: PlanarArray | None = None
) -> Tensor:
    """Return azimuth and elevation (n, 2) [rad] of the transmitter in array coordinates, with arguments as in `Spectra`.

    Directions that the array does not distinguish are folded (`PlanarArray.folded`).
    """
    away = position.double() - fixed_position
    towards = away if moving == "transmitter" else -away
    return folded_angles(array, torch.stack(to_angles(towards @ rotation), dim=-1))


def check_pixels(name: str, n: int, shape: Sequence[int]) -> None:
    """Refuse n spectra of a shape (rows, columns) with more pixels than any measurement has.

    Raises:
        InputError: The spectra exceed 2^34 pixels, or 2^29 pixels at more than 2^20 pixels each.
    """
    each = math.prod(shape)
    if n * each > MAX_FILE_PIXELS or (n * each > MAX_MEMORY_PIXELS and each > MAX_FINE_PIXELS):
        raise InputError(
            f"{name} has {n} positions, whose spectra would have {n * each:.3g} pixels; take one measurement of several "
            "(every) or a coarser grid"
        )


def coarsening(shape: Sequence[int], max_azimuths: int, least_rows: int = 1) -> int:
    """Return the smallest factor that divides both sizes and brings spectra to at most `max_azimuths` columns.

    A maximum of 0 stands for all pixels. If no factor leaves `least_rows`, the result is 1.
    """
    least = math.ceil(shape[1] / max_azimuths) if max_azimuths else 1
    factors = range(least, shape[0] // least_rows + 1)
    return next((factor for factor in factors if all(size % factor == 0 for size in shape)), 1)


@checked
def check_training(train: Spectra, least: int = MIN_TRAINING) -> None:
    """Refuse too few spectra, and values that are not finite.

    Args:
        train: Spectra that a model is fitted to or updated by.
        least: Smallest number of spectra. Defaults to that of a fit, 10.

    Raises:
        InputError: Fewer spectra, or a spectrum that is not finite.
    """
    if len(train) < least:
        raise InputError(f"a fit needs at least {least} spectra, got {len(train)}")
    for rows in train.store.parts() if train.store.values.is_floating_point() else ():
        bad = (~train.store[rows].isfinite()).flatten(1).any(dim=1).nonzero()
        if len(bad):
            raise InputError(
                f"spectrum of training spectrum {rows.start + int(bad[0])} is not finite; mend or leave it out"
            )


def fingerprint(train: Spectra, *settings: Any) -> str:
    """Return a digest of the spectra, their channels, the description of their scene, and settings."""
    scene = train.grid, train.moving, train.array, train.rotation, train.fixed_position
    return digest(*settings, scene, train.store, train.position, train.channel, train.frequency_hz)
