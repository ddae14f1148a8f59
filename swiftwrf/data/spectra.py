"""Spatial spectra measured at known positions."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any, Literal

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, to_angles
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.splits import MIN_TRAINING, choose_split
from swiftwrf.data.store import AT_ONCE, MOST_PIXELS, Store, stored, too_many
from swiftwrf.errors import InputError
from swiftwrf.metrics import WINDOW

Moving = Literal["transmitter", "receiver"]
GRID = AngularGrid.hemisphere(90, 360)  # of spectra that are computed


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra and where the moving end of the link stood when each was taken.

    Args:
        name: of the data set.
        position: of the moving end, float64 (n, 3) [m].
        store: the spectra as they were measured, (n, n_elevation, n_azimuth); by the batch or all at once float32.
        grid: the directions of a spectrum's pixels.
        label: azimuth and elevation of the line of sight in array coordinates, float64 (n, 2) [rad].
        line_of_sight: whether the direct path is free, bool (n,); where it is unknown it is taken to be.
        moving: which end moves.
        index: number of each spectrum in the data set it comes from, counted from 0, int64 (n,).
        named_splits: training and test rows of the splits that came with the data.
        array: the antenna array, where it is known.
        source: sha256 of each file that says what the data are, by file name.
        fixed_position: of the end that does not move, float64 (3,) [m]; None where it is unknown or both ends move.
        rotation: turns array into world coordinates, float64 (3, 3); the array stands at the fixed end when the
            transmitter moves, and else moves with constant orientation. None where it is unknown.
        notes: what the reader found or did that a user should know, a sentence each.
    """

    name: str
    position: Tensor
    store: Store
    grid: AngularGrid
    label: Tensor
    line_of_sight: Tensor
    moving: Moving
    index: Tensor
    named_splits: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    array: PlanarArray | None = None
    source: dict[str, str] = field(default_factory=dict)
    fixed_position: Tensor | None = None
    rotation: Tensor | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)

    @property
    def spectrum(self) -> Tensor:
        """All magnitudes, float32 (n, n_elevation, n_azimuth) in [0, 1].

        Raises:
            InputError: more than fit into memory.
        """
        if math.prod(self.store.shape) > MOST_PIXELS:
            raise InputError(
                f"{self.name} has {len(self)} spectra, which do not fit into memory at once; take some (subset) or read "
                "them by the batch (store)"
            )
        return self.store[:]

    def in_memory(self) -> Spectra:
        """The same with their spectra as float32, for those who look at them again and again."""
        return replace(self, store=Store(self.spectrum))

    def subset(self, rows: Tensor) -> Spectra:
        """The given rows, in the given order; splits named for the whole set are dropped."""
        return replace(
            self,
            position=self.position[rows],
            store=self.store.subset(rows),
            label=self.label[rows],
            line_of_sight=self.line_of_sight[rows],
            index=self.index[rows],
            named_splits={},
        )

    def split(self, name: str = "random", seed: int = 0) -> tuple[Spectra, Spectra]:
        """Training and test part: a split that came with the data, or a seeded `random` or `block` one.

        Raises:
            InputError: an unknown name; fewer than 10 training spectra.
        """
        train, test = choose_split(name, seed, self.position, self.named_splits, self.name)
        return self.subset(train), self.subset(test)

    def direction_at(self, position: Tensor) -> Tensor:
        """Azimuth and elevation (n, 2) [rad] of the line of sight with the moving end at positions (n, 3) [m].

        Raises:
            InputError: the fixed end or the array's orientation is unknown.
        """
        if self.fixed_position is None or self.rotation is None:
            raise InputError(
                f"{self.name} does not say where the fixed end stands and how the array is turned, so the direction at "
                "further positions is unknown"
            )
        return direction_of_link(position, self.fixed_position, self.rotation, self.moving)

    def coarsen(self, factor: int) -> Spectra:
        """The same spectra averaged over squares of factor x factor pixels.

        Raises:
            InputError: the numbers of rows and columns are not multiples of the factor.
        """
        if factor == 1:
            return self
        if any(size % factor for size in self.grid.shape):
            raise InputError(f"spectra of {self.grid.shape} pixels cannot be averaged over {factor} x {factor} of them")
        return replace(self, store=self.store.coarsen(factor), grid=self.grid.coarsen(factor))

    def at_most(self, azimuths: int) -> Spectra:
        """The same spectra averaged down to at most so many columns, with rows enough for SSIM; 0 keeps all pixels."""
        return self.coarsen(coarsening(self.grid.shape, azimuths, least_rows=WINDOW))


def array_spectra(array: PlanarArray, channel: Tensor, grid: AngularGrid, beamformer: str = PHASE) -> Store:
    """What an array reports of channels, as `PlanarArray.spectrum`, whatever their number.

    Raises:
        InputError: as there; a cache directory without room.
    """

    def key() -> str:
        how = version("swiftwrf-tasks"), beamformer, array.wavelength, array.element.tolist(), grid
        digest = hashlib.sha256(repr(how).encode())
        digest.update(channel.contiguous().numpy().data)
        return digest.hexdigest()

    shape = (len(channel), *grid.shape)
    rows = torch.arange(len(channel)).split(max(1, AT_ONCE // math.prod(grid.shape)))
    return stored(shape, torch.float32, key, lambda: (array.spectrum(channel[r], grid, beamformer) for r in rows))


def direction_of_link(position: Tensor, fixed_position: Tensor, rotation: Tensor, moving: Moving) -> Tensor:
    """Azimuth and elevation (n, 2) [rad] at which the array sees the transmitter, with the moving end at positions
    (n, 3) [m]; the other arguments as in `Spectra`."""
    away = position.double() - fixed_position
    towards = away if moving == "transmitter" else -away
    return torch.stack(to_angles(towards @ rotation), dim=-1)


def check_pixels(name: str, n: int, grid: AngularGrid) -> None:
    """Refuses more spectra than anybody measures.

    Raises:
        InputError: so many.
    """
    if too_many((n, *grid.shape)):
        raise InputError(
            f"{name} has {n} positions, whose spectra would have {n * math.prod(grid.shape):.3g} pixels; take "
            "one measurement of several (every) or a coarser grid"
        )


def coarsening(shape: Sequence[int], max_azimuths: int, least_rows: int = 1) -> int:
    """The smallest factor that brings spectra of `shape` (rows, columns) to at most `max_azimuths` columns and divides
    both sizes; 1 where there is none that leaves `least_rows`, and for `max_azimuths` 0, which stands for all pixels."""
    least = math.ceil(shape[1] / max_azimuths) if max_azimuths else 1
    factors = range(least, shape[0] // least_rows + 1)
    return next((factor for factor in factors if all(size % factor == 0 for size in shape)), 1)


def check_training(train: Spectra) -> None:
    """Enough spectra to learn from, all finite.

    Raises:
        InputError: fewer than 10, or the first that is not finite.
    """
    if len(train) < MIN_TRAINING:
        raise InputError(f"a fit needs at least {MIN_TRAINING} spectra, got {len(train)}")
    bad = [("position", int(row)) for row in _not_finite(train.position)[:1]]
    if train.store.values.is_floating_point():
        for rows in train.store.parts():
            bad += [("spectrum", rows.start + int(row)) for row in _not_finite(train.store[rows])[:1]]
    if bad:
        name, row = bad[0]
        raise InputError(f"{name} of training spectrum {row} is not finite; mend or leave it out")


def _not_finite(values: Tensor) -> Tensor:
    """Rows of values (n, ...) that hold something not finite."""
    return (~values.isfinite()).flatten(1).any(dim=1).nonzero()[:, 0]


def fingerprint(train: Spectra, *settings: Any) -> str:
    """Tells whether something kept belongs to these spectra, what is known of their scene, and settings (plain values)."""
    array = train.array and [train.array.wavelength, train.array.element.tolist()]
    known = [None if value is None else value.tolist() for value in (train.rotation, train.fixed_position)]
    scene = [asdict(train.grid), train.moving, array, *known]
    digest = hashlib.sha256(json.dumps([*settings, scene, train.store.digest()]).encode())
    digest.update(train.position.numpy().tobytes())
    return digest.hexdigest()
