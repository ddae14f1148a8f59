"""What the DICHASUS and ESPARGOS data sets have in common: TFRecord files, and a JSON file that describes their arrays.

The JSON's `antennas` tell each array's `location`, `spacingX` (along its rows) and `spacingY` [m], and how it is turned: by
`rightvector` and `upvector` as seen from its front, or by its `direction` alone, and then it is taken to hang upright. The
carrier is `frequency` [Hz]. Row 0 of an array is its upper one and column 0 its left one, seen from the front.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.archives import MOST_BYTES
from swiftwrf.data.files import FARTHEST, check_carrier, read_text, sha256
from swiftwrf.data.snapshots import Snapshots, check_spacing
from swiftwrf.data.tfrecords import records
from swiftwrf.errors import InputError

SUFFIX = ".tfrecords"
SUBCARRIERS = 64  # that are kept of each measurement, evenly spaced: more say nothing new of directions
SKEW = 0.1  # cosine between right and up beyond which they are no axes of a plane


class Record(NamedTuple):
    """One measurement."""

    csi: NDArray[Any]  # (arrays, rows, columns, subcarriers) or (antennas, subcarriers)
    position: NDArray[Any]  # (3,) [m]


@dataclass(frozen=True, eq=False)
class Station:
    """One array of a data set.

    Args:
        name: of the array.
        location: of its centre [m].
        rotation: turns array into world coordinates, float64 (3, 3).
        spacing: along rows and along columns [m].
        assignments: number of the antenna of each row and column, None where there is none; None where all are there.
    """

    name: str
    location: tuple[float, ...]
    rotation: Tensor
    spacing: tuple[float, float]
    assignments: list[list[int | None]] | None

    def element(self, row: int, column: int, shape: tuple[int, int]) -> tuple[float, float]:
        """Where an element stands in the array, seen from its front: x to the right and y up [m]."""
        x = self.spacing[0] * (column - (shape[1] - 1) / 2)
        return x, self.spacing[1] * ((shape[0] - 1) / 2 - row)


def record_files(path: Path) -> list[Path]:
    """The TFRecord files of a folder, or the file itself."""
    if path.is_dir():
        return sorted(path.glob(f"*{SUFFIX}"))
    return [path] if path.suffix == SUFFIX else []


def description(path: Path) -> Path | None:
    """The JSON file beside the records that describes their arrays."""
    folder = path if path.is_dir() else path.parent
    return next((file for file in sorted(folder.glob("*.json")) if _antennas(file)), None)


def has_assignments(file: Path) -> bool:
    """Whether the arrays say which antenna stands where."""
    return any("assignments" in antenna for antenna in _antennas(file))


def _antennas(file: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(read_text(file))
    except (ValueError, RecursionError):  # InputError is such
        return []
    found = content.get("antennas") if isinstance(content, dict) else None
    return found if isinstance(found, list) and found and all(isinstance(a, dict) for a in found) else []


def read_station(file: Path, number: int | None) -> tuple[int, Station, float]:
    """The array asked for with its index from 0, and the carrier [Hz].

    Raises:
        InputError: several arrays and none asked for, one that there is not, or a description that is incomplete.
    """
    antennas = _antennas(file)
    names = [str(antenna.get("name", "")) for antenna in antennas]
    if (number is None and len(antennas) > 1) or not 1 <= (number or 1) <= len(antennas):
        listed = ", ".join(f"{i} {name}" for i, name in enumerate(names, start=1))
        raise InputError(f"{file} describes {len(antennas)} arrays; choose one by its number: station ({listed})")
    index = (number or 1) - 1
    antenna = antennas[index]
    location = _vector(file, antenna, "location")
    spacing = _numbers(antenna.get("spacingX")), _numbers(antenna.get("spacingY"))
    if any(len(s) != 1 or s[0] <= 0 for s in spacing):
        raise InputError(f"{file}: array {index + 1} needs spacingX and spacingY in metres")
    frequency = _numbers(json.loads(read_text(file)).get("frequency"))
    if len(frequency) != 1:
        raise InputError(f"{file} lacks frequency, the carrier in Hz; add it")
    check_carrier(file, frequency[0])
    assignments = antenna.get("assignments")
    return (
        index,
        Station(
            names[index],
            location,
            _rotation(file, antenna),
            (spacing[0][0], spacing[1][0]),
            _checked(file, assignments),
        ),
        frequency[0],
    )


def _numbers(value: Any) -> tuple[float, ...]:
    """Finite numbers of a JSON number or list; none where it is something else."""
    values = value if isinstance(value, list) else [value]
    if all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= FARTHEST * 1e4 for v in values):
        return tuple(map(float, values))
    return ()


def _vector(file: Path, antenna: dict[str, Any], name: str) -> tuple[float, ...]:
    vector = _numbers(antenna.get(name))
    if len(vector) != 3 or max(map(abs, vector)) > FARTHEST:
        raise InputError(f"{file}: each array needs {name}, 3 finite numbers, got {antenna.get(name)}")
    return vector


def _rotation(file: Path, antenna: dict[str, Any]) -> Tensor:
    """Columns: to the right, up, and to the front, seen from the front."""
    if "rightvector" in antenna:
        right, up = (np.array(_vector(file, antenna, name)) for name in ("rightvector", "upvector"))
    else:
        front = np.array(_vector(file, antenna, "direction"))
        right = np.cross([0.0, 0.0, 1.0], front)
        up = np.cross(front, right)
    size = np.linalg.norm(right) * np.linalg.norm(up)
    if not size > 1e-12 or abs(right @ up) > SKEW * size:
        raise InputError(
            f"{file}: rightvector and upvector of an array must be at right angles, or its direction not vertical"
        )
    right, front = (vector / np.linalg.norm(vector) for vector in (right, np.cross(right, up)))
    return torch.from_numpy(np.stack([right, np.cross(front, right), front], axis=1))


def _checked(file: Path, assignments: Any) -> list[list[int | None]] | None:
    if assignments is None:
        return None
    rows: list[list[int | None]] = assignments if isinstance(assignments, list) else []
    if not rows or not all(isinstance(row, list) and len(row) == len(rows[0]) for row in rows):
        raise InputError(f"{file}: assignments must be rows of equal length, with null where an antenna is missing")
    cells = [cell for row in rows for cell in row]
    used = [cell for cell in cells if isinstance(cell, int) and not isinstance(cell, bool) and 0 <= cell < 4096]
    if len(used) + cells.count(None) != len(cells) or len(set(used)) != len(used) or len(used) < 2:
        raise InputError(
            f"{file}: assignments must name at least 2 antennas by their numbers, each once, got {assignments}"
        )
    return rows


def read_snapshots(
    path: Path,
    every: int,
    parse: Callable[[dict[str, bytes], Path], Record],
    select: Callable[[NDArray[Any]], NDArray[Any]],
    station: tuple[Station, PlanarArray],
    sources: Iterable[Path],
    notes: tuple[str, ...],
) -> Snapshots:
    """All records of a folder or file.

    Args:
        path: of the records.
        every: takes one record of so many.
        parse: the features of a record and its file to a measurement; refuses by ValueError.
        select: the channels of the station's elements (K, subcarriers), of a measurement.
        station: the array and its place.
        sources: files whose digests are kept beside those of the records.
        notes: what is said of the data.

    Raises:
        InputError: a record that is none, or more of them than fit into memory.
    """
    files = record_files(path)
    channels, positions, index, number, without = [], [], [], -1, 0
    for file in files:
        for features in records(file):
            number += 1
            if number % every:
                continue
            try:
                record = parse(features, file)
                channel = select(record.csi)
            except (KeyError, IndexError, ValueError) as error:
                raise InputError(f"{file}: record {number + 1} of all is not what the data set has ({error})") from None
            channel = channel[:, :: max(1, channel.shape[1] // SUBCARRIERS)].T
            power = float(np.abs(channel).astype(np.float64).max())
            if not (0 < power < math.inf and (np.abs(record.position) <= FARTHEST).all()):
                without += 1
                continue
            channels.append((channel / power).astype(np.complex64))
            positions.append(record.position.astype(np.float64))
            index.append(number)
            if len(channels) * channel.nbytes > MOST_BYTES:
                raise InputError(
                    f"{path} holds more than {MOST_BYTES} bytes of channels; take one record of several: every"
                )
    if not channels:
        raise InputError(f"{path} holds no record with a position and a channel")
    if without:
        notes = (*notes, f"records without a finite position or channel are left out: {without}")
    name = path.resolve().name if path.is_dir() else path.stem
    position = torch.from_numpy(np.stack(positions))
    return Snapshots(
        name=f"{name}-{station[0].name}" if station[0].name else name,
        channel=torch.from_numpy(np.stack(channels)),
        position=position,
        array=station[1],
        array_position=torch.tensor(station[0].location, dtype=torch.float64),
        rotation=station[0].rotation,
        line_of_sight=torch.ones(len(position), dtype=torch.bool),
        index=torch.tensor(index),
        source={file.name: sha256(file) for file in [*files, *sources]},
        notes=notes,
    )


def element_array(file: Path, places: list[tuple[float, float]], frequency_hz: float) -> PlanarArray:
    """Elements at these places of their plane.

    Raises:
        InputError: distances that no array has.
    """
    array = PlanarArray(torch.tensor(places, dtype=torch.float64), LIGHT_SPEED / frequency_hz)
    check_spacing(file, array)
    return array
