"""The options of all commands that say how files are read, where they leave it open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from swiftwrf import AngularGrid, InputError
from swiftwrf.array.beamforming import BEAMFORMERS
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import Reading
from tasks.run import choice

MOST_ELEMENTS = 32  # a side of an array: its spectra have 7,938 numbers


@dataclass(frozen=True, kw_only=True)
class SpectraSource:
    """How spectra are read."""

    array: tuple[int, float, float] | None = None
    """square array that took the spectra, where the data do not say, or that ray paths are computed for: elements a side,
    spacing [m], carrier [Hz]"""
    beamformer: Annotated[
        str | None, choice("what makes spectra of array snapshots (phase unless given)", BEAMFORMERS)
    ] = None
    grid: tuple[int, int] | None = None
    """elevations and azimuths of spectra that are computed (90 360 unless given)"""
    every: int | None = None
    """takes one measurement of so many"""
    station: int | None = None
    """which array of a file with several, counted from 1"""


@dataclass(frozen=True, kw_only=True)
class TableSource:
    """How survey tables are read."""

    columns: tuple[str, ...] = ()
    """of a survey table whose columns are not recognised: x=NAME y=NAME receiver=NAME rssi=NAME ... (several with
    rssi='WAP*')"""


def reading(config: SpectraSource | TableSource) -> Reading:
    """What the options say.

    Raises:
        InputError: one that makes no sense whatever the data.
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
    return Reading(array, beamformer, grid, every, station, columns)


def _array(config: SpectraSource) -> PlanarArray | None:
    if config.array is None:
        return None
    side, spacing, frequency = config.array
    if not (2 <= side <= MOST_ELEMENTS and min(spacing, frequency) > 0):
        raise InputError(
            f"--array takes 2 to {MOST_ELEMENTS} elements a side, a spacing [m] and a carrier [Hz], got {config.array}"
        )
    return PlanarArray.square(side, frequency, spacing)


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
