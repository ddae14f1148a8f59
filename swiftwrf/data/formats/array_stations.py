"""Several arrays in one file of snapshots: their descriptions, and the measurements of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swiftwrf.data.archives import Arrays
from swiftwrf.data.files import read_yaml
from swiftwrf.data.formats.array_description import POSE, described_arrays
from swiftwrf.errors import InputError

STATIONS = "stations.yml"  # descriptions of several arrays, whose number is the second axis of csi
Described = tuple[
    Path, list[tuple[str, Arrays]]
]  # the file that describes several arrays, their names and descriptions


def described_stations(file: Path) -> Described | None:
    """Return the file stations.yml beside the arrays that lists several stations, and name and description of each.

    Raises:
        InputError: A file that is no list of stations with names.
    """
    beside = file.parent / STATIONS
    content = read_yaml(beside) if file.is_file() and beside.is_file() else {}
    if not content:
        return None
    each_station = content.get("stations")
    if not isinstance(each_station, list) or not all(isinstance(x, dict) and "name" in x for x in each_station):
        raise InputError(f"{beside} must have stations, a list of arrays, each with its name, got {each_station!r}")
    common = {name: value for name, value in content.items() if name != "stations"}
    return beside, [(str(each["name"]), described_arrays(beside, common | each)) for each in each_station]


def stations_of_arrays(file: Path, arrays: Arrays) -> Described | None:
    """Return the file itself, and name and description of each of several arrays whose poses are rows of arrays in it."""
    if not {"position", "array_position"} <= arrays.keys():
        return None
    position, at = arrays["position"], arrays["array_position"]
    if at.ndim != 2 or at.shape[1] != 3 or len(at) in (1, len(position)):
        return None  # one array, or one that moves
    poses, count = {array: arrays[array] for array in ("array_position", *POSE) if array in arrays}, len(at)
    several = {array: values for array, values in poses.items() if values.ndim == 2 and len(values) == count}
    return file, [(f"array{n + 1}", {array: values[n] for array, values in several.items()}) for n in range(count)]


def of_station(file: Path, arrays: Arrays, number: int, count: int) -> tuple[Arrays, NDArray[np.int64]]:
    """Return the arrays of one station, and the numbers of the rows that it received.

    Raises:
        InputError: csi without an axis of the stations, or nothing received.
    """
    csi = arrays["csi"]
    if csi.ndim not in (3, 4) or csi.shape[1] != count:
        raise InputError(
            f"{file}: csi must have shape (n, {count}, [subcarriers or packets,] elements) for its {count} arrays, got "
            f"{csi.shape}"
        )
    own = csi[:, number]
    received = (np.nan_to_num(own) != 0).reshape(len(own), -1).any(axis=1)
    if not received.any():
        raise InputError(f"{file}: array {number + 1} received nothing; leave it out")
    return arrays | {"csi": own}, received.nonzero()[0]
