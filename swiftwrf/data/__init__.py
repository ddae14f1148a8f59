"""Measurements at known positions: spectra, array snapshots and RSSI, their splits, formats, and simulated rooms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.coordinates import Coordinates, Up
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, ReadOptions, read, read_spectra
from swiftwrf.data.formats.stations import read_stations
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.stations import Stations
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, checked


@checked
def load_spectra(
    path: str | Path,
    *,
    array: PlanarArray | None = None,
    arrays: Mapping[str, str] | None = None,
    beamformer: str | None = None,
    grid: AngularGrid | tuple[PositiveInt, PositiveInt] | None = None,
    every: PositiveInt | None = None,
    station: PositiveInt | None = None,
    subcarriers: PositiveInt | None = None,
    bandwidth: PositiveFloat | None = None,
    drop_null: bool = False,
    drop_elements: tuple[int, ...] = (),
    round_trip: bool = False,
    sender: str | None = None,
) -> Spectra:
    """Read spectra in any format of docs/formats.md: images or arrays of spectra, ray paths, array snapshots.

    Args:
        path: Folder or file.
        array: Array of the spectra if the files do not describe it, or for which spectra of ray paths are computed. Defaults
            to 4 x 4 elements at half a wavelength.
        arrays: Names of the arrays in a file of array snapshots that has others than snapshots.npz, by the name there.
        beamformer: Beamformer for array snapshots: phase (default), bartlett or capon.
        grid: Directions of computed spectra, or their numbers of elevations and azimuths. Defaults to 90 x 360.
        every: Reads one measurement of that many.
        station: Number of the array in a file with several, counted from 1.
        subcarriers: Number of subcarriers at which the channel is computed from ray paths. Defaults to spectra alone.
        bandwidth: Distance of the first and the last of these subcarriers [Hz], at most the carrier.
        drop_null: Leaves out null subcarriers of array snapshots, which are the same at every position and element.
        drop_elements: Elements of array snapshots to leave out, counted from 0.
        round_trip: Phases of array snapshots are those of the way there and back, as of RFID and backscatter.
        sender: Hardware address of the sender whose packets are used, of captures with several.

    Raises:
        InputError: A part that is missing or invalid, parts that do not match, or an argument that does not apply.

    Example:
        >>> load_spectra("nowhere")
        Traceback (most recent call last):
        swiftwrf.errors.InputError: nowhere is not a folder or file; expected measurements (formats: ...)
    """
    given = locals().copy()
    return read_spectra(given.pop("path"), ReadOptions(**given))


def load_snapshots(path: str | Path, **options: Any) -> Snapshots:
    """Read array snapshots, with `arrays`, `every`, `station`, `drop_null`, `drop_elements`, `round_trip` of `load_spectra`.

    Raises:
        InputError: As `load_spectra`.

    Example:
        >>> load_snapshots("nowhere")
        Traceback (most recent call last):
        swiftwrf.errors.InputError: nowhere is not a folder or file; ...
    """
    data: Snapshots = read(path, ReadOptions(**options), SNAPSHOT_FORMATS)
    return data


def load_stations(path: str | Path, **options: Any) -> Stations:
    """Read the spectra of several stations: a folder with one of `load_spectra` for each, or files with several arrays.

    Rows of one position, or of one number in the files packets.txt of all folders, are one transmission.

    Args:
        path: Folder or file.
        options: Options of `load_spectra`, which hold for all stations, without `station`.

    Raises:
        InputError: As `load_spectra`, no stations, or transmissions that cannot be joined.

    Example:
        >>> load_stations("nowhere")
        Traceback (most recent call last):
        swiftwrf.errors.InputError: nowhere has no stations: expected a folder of measurements for each, or ...
    """
    return read_stations(Path(path), ReadOptions(**options))


@checked
def load_rssi(
    path: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    filler: Sequence[float] | None = None,
    coordinates: Coordinates | None = None,
    offset_by: str | None = None,
    transmitter: Sequence[str] = (),
    pool_by: str | None = None,
    scale: PositiveFloat | None = None,
    y_down: bool = False,
    up: Up = "z",
    window: PositiveFloat | None = None,
    quantity: str | None = None,
    unit: str | None = None,
    receiver_positions: Path | str | None = None,
) -> Rssi:
    """Read RSSI in any format of docs/formats.md: the NeRF2 layout, or a survey table (CSV, Parquet).

    Args:
        path: Folder or file.
        columns: Names of columns of a table that are not recognised, by role: x, y, z, longitude, latitude, floor, time,
            session, receiver, rssi.
        filler: Values that stand for not detected, [] for none. Defaults to those that are recognised.
        coordinates: "degrees" or "metres", of the positions in a table. Defaults to the unit that is recognised.
        offset_by: Column of a table with groups of rows, e.g. devices, between which RSSI has constant offsets.
        transmitter: Columns of a table with the position of the transmitter where both ends move: x, y and optionally z, or
            the one column with names of its positions, which receivers.csv contains. Defaults to those recognised.
        pool_by: Radios of one access point to pool by the mean of their powers: "mac" for the first five bytes of MAC
            addresses, a regular expression whose group is the access point, or the column of a long table that contains it.
        scale: Units of x and y in a metre, e.g. pixels of a floor plan. Defaults to the scale that lines above the
            header or names of columns state.
        y_down: y points down, as in images of floor plans.
        up: Axis that points up, "y" as in ARCore, ARKit and Unity.
        window: Length [s] of the windows in which packets of several receivers are joined to a row by their means.
        quantity: What the values of a table are, if not RSSI, e.g. throughput.
        unit: Unit of the quantity. For RSSI that is not in dBm, "percent" or "positive", which are converted.
        receiver_positions: Table with positions of the receivers. Defaults to receivers.csv beside the data.

    Raises:
        InputError: A part that is missing or invalid, parts that do not match, or an argument that does not apply.

    Example:
        >>> import tempfile, pandas as pd
        >>> rssi = [-40.0 - i for i in range(20)]
        >>> survey = pd.DataFrame({"x": range(20), "y": range(20), "kitchen": rssi, "hall": rssi[::-1]})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "survey.csv"
        ...     survey.to_csv(file, index=False)
        ...     load_rssi(file).receiver_names
        ('kitchen', 'hall')
    """
    options = locals().copy()
    data: Rssi = read(options.pop("path"), ReadOptions(**options), RSSI_FORMATS)
    return data


__all__ = ["PropagationPaths", "ReadOptions", "Rssi", "Snapshots", "Spectra", "Stations"]
__all__ += ["load_rssi", "load_snapshots", "load_spectra", "load_stations"]
