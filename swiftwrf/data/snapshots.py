"""What an antenna array heard, element by element, from known positions: channel state information or IQ samples."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, to_angles
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.spectra import GRID, Spectra, array_spectra, check_pixels
from swiftwrf.data.splits import choose_split
from swiftwrf.errors import InputError

SPACING = (0.01, 20.0)  # [wavelengths] between neighbours: beyond, positions are in another unit than metres


@dataclass(frozen=True, eq=False)
class Snapshots:
    """Complex channels at a fixed array, and where the transmitter stood when each was taken.

    Args:
        name: of the data set.
        channel: of each element in several snapshots (subcarriers or packets), complex64 (n, S, K).
        position: of the transmitter, float64 (n, 3) [m].
        array: K elements and the carrier's wavelength.
        array_position: of the origin of the elements' coordinates, float64 (3,) [m].
        rotation: turns array into world coordinates, float64 (3, 3).
        line_of_sight: whether the direct path is free, bool (n,); where it is unknown it is taken to be.
        index: number of each row in the data set it comes from, counted from 0, int64 (n,).
        time: of each row [s], float64 (n,), where it is known.
        named_splits, source, notes: as of `Spectra`.
    """

    name: str
    channel: Tensor
    position: Tensor
    array: PlanarArray
    array_position: Tensor
    rotation: Tensor
    line_of_sight: Tensor
    index: Tensor
    time: Tensor | None = None
    named_splits: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    source: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)

    def subset(self, rows: Tensor) -> Snapshots:
        """The given rows, in the given order; splits named for the whole set are dropped."""
        return replace(
            self,
            channel=self.channel[rows],
            position=self.position[rows],
            line_of_sight=self.line_of_sight[rows],
            index=self.index[rows],
            time=None if self.time is None else self.time[rows],
            named_splits={},
        )

    def split(self, name: str = "random", seed: int = 0) -> tuple[Snapshots, Snapshots]:
        """Training and test part, as `Spectra.split`.

        Raises:
            InputError: an unknown name; fewer than 10 training rows.
        """
        train, test = choose_split(name, seed, self.position, self.named_splits, self.name)
        return self.subset(train), self.subset(test)

    @property
    def direction(self) -> Tensor:
        """Unit vectors of the line of sight in array coordinates, float64 (n, 3); z may be negative."""
        away = self.position - self.array_position
        direction: Tensor = away / away.norm(dim=1, keepdim=True) @ self.rotation
        return direction

    def spectra(self, grid: AngularGrid | None = None, beamformer: str = PHASE) -> Spectra:
        """The spectra of the array, all snapshots of a position together.

        Args:
            grid: directions; 90 x 360 unless given.
            beamformer: phase, bartlett or capon, see `swiftwrf.array.beamforming`.

        Raises:
            InputError: an unknown beamformer, too few snapshots for it, or spectra of too many pixels.
        """
        grid = grid or GRID
        check_pixels(self.name, len(self), grid)
        return Spectra(
            name=self.name,
            position=self.position,
            store=array_spectra(self.array, self.channel, grid, beamformer),
            grid=grid,
            label=torch.stack(to_angles(self.direction), dim=-1),
            line_of_sight=self.line_of_sight,
            moving="transmitter",
            index=self.index,
            named_splits=self.named_splits,
            array=self.array,
            source=self.source,
            fixed_position=self.array_position,
            rotation=self.rotation,
            notes=self.notes,
        )


def check_spacing(file: Path, array: PlanarArray) -> None:
    """Refuses elements at distances that no array has, as positions in millimetres give.

    Raises:
        InputError: such distances.
    """
    if len(array.element) < 2:
        raise InputError(f"{file} describes an array of one element, which sees no directions; at least 2 are needed")
    apart = torch.cdist(array.element, array.element).fill_diagonal_(torch.inf).amin(dim=1).median() / array.wavelength
    low, high = SPACING
    if not low <= float(apart) <= high:
        raise InputError(
            f"{file}: neighbouring elements are {float(apart) * array.wavelength:.4g} m, {float(apart):.3g} wavelengths "
            f"apart; expected {low:g} to {high:g} wavelengths, so is the spacing in metres and the carrier in Hz?"
        )
