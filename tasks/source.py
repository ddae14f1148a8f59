"""Options of all commands that state how files are read, where the files leave it open, and reading by them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from swiftwrf import AngularGrid, InputError, Spectra
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import ReadOptions, read_spectra
from swiftwrf.data.store import Store
from tasks.run import choice

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
    drop_null: bool = False
    """whether to leave out null subcarriers of array snapshots, which are the same at every position and element"""
    round_trip: bool = False
    """whether phases of array snapshots are those of the way there and back, as of RFID and backscatter"""


@dataclass(frozen=True, kw_only=True)
class TableSource:
    """Options of reading survey tables."""

    columns: tuple[str, ...] = ()
    """names of columns of a survey table that are not recognised: x=NAME y=NAME receiver=NAME rssi=NAME ... (several with
    rssi='WAP*')"""


def reading(config: SpectraSource | TableSource) -> ReadOptions:
    """Return the options of a command line for reading.

    Raises:
        InputError: An option that makes no sense whatever the data.
    """
    array = beamformer = grid = every = station = columns = drop_null = round_trip = None
    if isinstance(config, SpectraSource):
        array, beamformer, grid = _array(config), config.beamformer, _grid(config)
        every, station = config.every, config.station
        drop_null, round_trip = config.drop_null or None, config.round_trip or None
        if beamformer is not None:
            BEAMFORMERS[beamformer]  # refuses an unknown one
        for name, value in (("every", every), ("station", station)):
            if value is not None and value < 1:
                raise InputError(f"--{name} must be at least 1, got {value}")
    if isinstance(config, TableSource):
        columns = _columns(config.columns)
    return ReadOptions(array, beamformer, grid, every, station, columns, drop_null, round_trip)


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
