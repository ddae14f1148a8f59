"""Measurements: spectra, array snapshots and RSSI at known positions, their splits, their formats, and simulated rooms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.data.reading import Reading
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra


def load_spectra(
    path: str | Path,
    *,
    array: PlanarArray | None = None,
    beamformer: str | None = None,
    grid: AngularGrid | None = None,
    every: int | None = None,
    station: int | None = None,
) -> Spectra:
    """Reads spectra in any format of docs/formats.md: images or arrays of spectra, ray paths, array snapshots.

    Args:
        path: a folder or file.
        array: that took the spectra where the files do not say, or that ray paths are computed for (4 x 4 elements at half
            a wavelength unless given).
        beamformer: that makes spectra of array snapshots: phase (unless given), bartlett or capon.
        grid: directions of computed spectra; 90 x 360 unless given.
        every: takes one measurement of so many.
        station: which array of a file with several, counted from 1.

    Raises:
        InputError: what is missing, does not fit together or is not what the layout says; an argument that does not apply.
    """
    return read_spectra(path, Reading(array, beamformer, grid, every, station))


def read_spectra(path: str | Path, how: Reading) -> Spectra:
    """`load_spectra` with its arguments in one.

    Raises:
        InputError: as `load_spectra`.
    """
    data = read(path, how, SPECTRA_FORMATS, SNAPSHOT_FORMATS)
    return data.spectra(how.grid, how.beamformer or PHASE) if isinstance(data, Snapshots) else data


def load_snapshots(path: str | Path, *, every: int | None = None, station: int | None = None) -> Snapshots:
    """Reads array snapshots; arguments as of `load_spectra`.

    Raises:
        InputError: as `load_spectra`.
    """
    data: Snapshots = read(path, Reading(every=every, station=station), SNAPSHOT_FORMATS)
    return data


def load_rssi(path: str | Path, *, columns: Mapping[str, str] | None = None) -> Rssi:
    """Reads RSSI in any format of docs/formats.md: the NeRF2 layout, or a survey table (CSV, Parquet).

    Args:
        path: a folder or file.
        columns: what the columns of a table are called there, where their names are not recognised, by what they hold: x,
            y, z, time, receiver, rssi.

    Raises:
        InputError: what is missing, does not fit together or is not what the layout says; an argument that does not apply.
    """
    data: Rssi = read(path, Reading(columns=columns), RSSI_FORMATS)
    return data


__all__ = ["Reading", "Rssi", "Snapshots", "Spectra", "load_rssi", "load_snapshots", "load_spectra", "read_spectra"]
