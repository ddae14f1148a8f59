"""Options of all commands that state how files are read, where the files leave it open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from swiftwrf import AngularGrid, InputError
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import ReadOptions
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
    array = beamformer = grid = every = station = columns = None
    if isinstance(config, SpectraSource):
        array, beamformer, grid = _array(config), config.beamformer, _grid(config)
        every, station = config.every, config.station
        if beamformer is not None:
            BEAMFORMERS[beamformer]  # refuses an unknown one
        for name, value in (("every", every), ("station", station)):
            if value is not None and value < 1:
                raise InputError(f"--{name} must be at least 1, got {value}")
    if isinstance(config, TableSource):
        columns = _columns(config.columns)
    return ReadOptions(array, beamformer, grid, every, station, columns)


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
