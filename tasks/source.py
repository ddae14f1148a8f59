"""Options of all commands that state how files are read, where the files leave it open, and reading by them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from swiftwrf import AngularGrid, InputError, Rssi, Spectra
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import ReadOptions, read_rssi, read_spectra
from swiftwrf.data.coordinates import Coordinates
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.splits import MAX_REPEATED, repeated_fraction
from swiftwrf.data.store import Store
from swiftwrf.rssi import estimate_offsets
from tasks.run import choice

TABLE_OPTIONS = ("columns", "filler", "coordinates", "offset_by")
MAX_SIDE = 32  # elements: spectra of 32 x 32 elements have 7,938 independent numbers


@dataclass(frozen=True, kw_only=True)
class SpectraSource:
    """Options of reading spectra."""

    array: tuple[int, float, float] | tuple[int, int, float, float] | None = None
    """array of the spectra if the data do not describe it, or for which spectra of ray paths are computed: elements a side,
    spacing [m], carrier [Hz] of a square array, or rows, columns, spacing [m], carrier [Hz]"""
    beamformer: Annotated[str | None, choice("beamformer for array snapshots (default: phase)", BEAMFORMERS)] = None
    grid: tuple[int, int] | None = None
    """elevations and azimuths of computed spectra (default: 90 360)"""
    every: int | None = None
    """reads one measurement of that many"""
    station: int | None = None
    """number of the array in a file with several, counted from 1"""


@dataclass(frozen=True, kw_only=True)
class TableSource:
    """Options of reading RSSI."""

    columns: tuple[str, ...] = ()
    """names of columns of a survey table that are not recognised: x=NAME y=NAME receiver=NAME rssi=NAME ... (several with
    rssi='WAP*')"""
    filler: tuple[float, ...] = ()
    """values of RSSI that stand for not detected (default: those that are recognised)"""
    keep_filler: bool = False
    """whether all values of RSSI count as measured"""
    coordinates: Coordinates | None = None
    """unit of the positions in a survey table (default: the one that is recognised)"""


@dataclass(frozen=True, kw_only=True)
class OffsetSource(TableSource):
    """Options of reading RSSI of several devices or channels."""

    offset_by: str | None = None
    """column of a survey table with groups of rows, e.g. devices, whose constant offsets are estimated; COLUMN=VALUE makes
    that group the reference of maps (default: the most frequent one)"""


def reading(config: SpectraSource | TableSource) -> ReadOptions:
    """Return the options of a command line for reading.

    Raises:
        InputError: An option that makes no sense whatever the data.
    """
    array = beamformer = grid = every = station = columns = filler = coordinates = None
    if isinstance(config, SpectraSource):
        array, beamformer, grid = _array(config), config.beamformer, _grid(config)
        every, station = config.every, config.station
        if beamformer is not None:
            BEAMFORMERS[beamformer]  # refuses an unknown one
        for name, value in (("every", every), ("station", station)):
            if value is not None and value < 1:
                raise InputError(f"--{name} must be at least 1, got {value}")
    if isinstance(config, TableSource):
        columns, filler, coordinates = _columns(config.columns), _filler(config), config.coordinates
    offset_by = config.offset_by.partition("=")[0] if isinstance(config, OffsetSource) and config.offset_by else None
    return ReadOptions(array, beamformer, grid, every, station, columns, filler, coordinates, offset_by)


def _array(config: SpectraSource) -> PlanarArray | None:
    if config.array is None:
        return None
    *sides, spacing, frequency = config.array
    rows, columns = (int(side) for side in (sides[0], sides[-1]))
    if not (1 <= min(rows, columns) <= max(rows, columns) <= MAX_SIDE and max(rows, columns) >= 2):
        raise InputError(f"--array takes 2 to {MAX_SIDE} elements a side, got {rows} x {columns}")
    if min(spacing, frequency) <= 0:
        raise InputError(f"--array takes a spacing [m] and a carrier [Hz] above 0, got {spacing:g} and {frequency:g}")
    if rows == columns:
        return PlanarArray.square(rows, frequency, spacing)
    return PlanarArray.grid(rows, columns, spacing, frequency)


def _grid(config: SpectraSource) -> AngularGrid | None:
    if config.grid is None:
        return None
    if min(config.grid) < 2:
        raise InputError(f"--grid takes numbers of elevations and azimuths, each at least 2, got {config.grid}")
    return AngularGrid.hemisphere(*config.grid)


def _columns(columns: tuple[str, ...]) -> dict[str, str] | None:
    pairs = [text.partition("=") for text in columns]
    for text, (role, _, name) in zip(columns, pairs, strict=True):
        if not role or not name:
            raise InputError(f"--columns takes what a column holds and its name, e.g. x=NAME, got {text!r}")
    roles = {role: name for role, _, name in pairs}
    if len(roles) < len(pairs):
        raise InputError(f"--columns names something twice: {' '.join(columns)}")
    return roles or None


def _filler(config: TableSource) -> tuple[float, ...] | None:
    if config.keep_filler and config.filler:
        raise InputError("--filler and --keep-filler exclude each other")
    return config.filler if config.filler or config.keep_filler else None


def measured_rssi(data: str | None, config: TableSource) -> Rssi | None:
    """Return the RSSI of an experiment in a folder or file, None without one.

    Raises:
        InputError: RSSI that cannot be read, or options of reading without a source.
    """
    options = reading(config)
    if data is not None:
        return read_rssi(data, options)
    if given := [name for name in options.given if name in TABLE_OPTIONS]:
        raise InputError(f"--{given[0].replace('_', '-')} is for measured RSSI; give it with --data")
    return None


def asked_offsets(train: Rssi, config: OffsetSource) -> Offsets | None:
    """Return the offsets of the groups that a user asks for, estimated from training rows.

    Raises:
        InputError: One group only, or an unknown reference.
    """
    if config.offset_by is None:
        return None
    return estimate_offsets(train, config.offset_by.partition("=")[2] or None)


def split_notes(train: Rssi, test: Rssi) -> list[str]:
    """Return a note on rows that share positions, or none."""
    repeated = repeated_fraction(train.transmitter_position, test.transmitter_position)
    if repeated > MAX_REPEATED:
        return [f"this split tests look-up: {repeated:.0%} of the test rows are at positions of training rows"]
    position = torch.cat([train.transmitter_position, test.transmitter_position])
    n_places = len(position.unique(dim=0))
    shared = f"{len(position)} rows are at {n_places} positions, each of which is in one part of the split"
    return [shared] if n_places < len(position) and not repeated else []


def observed_spectra(source: str, options: ReadOptions, grid: AngularGrid, model: str) -> tuple[Store, Spectra | None]:
    """Read the spectra that a fitted model is applied to.

    Args:
        source: Measurements of any format, or a .npy file of spectra of unknown positions.
        options: Options of reading.
        grid: Directions of the spectra that the model was fitted to.
        model: What the model is, for messages.

    Returns:
        Spectra, and the measurements that they belong to if positions are known.

    Raises:
        InputError: Spectra that cannot be read, or on another grid.
    """
    known = None
    if not source.endswith(".npy"):
        known = read_spectra(source, options)
    elif options.given:
        raise InputError(f"{source} holds spectra as they are; --{options.given[0]} does not apply")
    store = Store(_read_array(Path(source))) if known is None else known.store
    if store.shape[1:] != grid.shape or (known is not None and known.grid != grid):
        shape, its = (" x ".join(map(str, s)) for s in (store.shape[1:], grid.shape))
        raise InputError(
            f"{source} has spectra of {shape} directions, the {model} was trained on others ({its}); where spectra are "
            f"computed, --grid {' '.join(map(str, grid.shape))} makes them alike"
        )
    return store, known


def _read_array(file: Path) -> Tensor:
    """Return the spectra of unknown positions in a .npy file."""
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{file} is not a readable .npy file ({error})") from None
    if not isinstance(array, np.ndarray) or array.ndim != 3 or array.dtype.kind != "f" or not len(array):
        raise InputError(f"{file} must hold floating-point spectra (n, elevations, azimuths)")
    spectrum = torch.from_numpy(np.array(array, dtype=np.float32))
    if not bool(((spectrum >= 0) & (spectrum <= 1)).all()):
        raise InputError(f"{file} must hold magnitudes in [0, 1]")
    return spectrum
