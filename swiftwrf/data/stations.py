"""Common part of the DICHASUS and ESPARGOS readers: TFRecord files, and a JSON file that describes their arrays.

The JSON's `antennas` give each array's `location`, `spacingX` (along its rows) and `spacingY` [m], and its orientation:
`rightvector` and `upvector` as seen from its front, or its `direction` alone for an upright array. The carrier is
`frequency` [Hz]. Row 0 of an array is its upper one and column 0 its left one, seen from the front.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.archives import MAX_UNPACKED_BYTES
from swiftwrf.data.files import check_carrier, digests, read_text
from swiftwrf.data.formats.base import Format, ReadOptions
from swiftwrf.data.snapshots import Snapshots, check_spacing, round_trip_array, without_null
from swiftwrf.data.tfrecords import records
from swiftwrf.errors import InputError
from swiftwrf.positions import MAX_COORDINATE_M

SUFFIX = ".tfrecords"
SUBCARRIERS = 64  # kept of each measurement, evenly spaced: more do not improve directions
MAX_COSINE = 0.1  # between right and up: beyond, they are no axes of a plane
MAX_ANTENNAS = 4096
Cell = tuple[int, int, int]  # row and column of an element, and the index of its antenna


class Record(NamedTuple):
    """One measurement: channel and position."""

    csi: NDArray[Any]  # (arrays, rows, columns, subcarriers) or (antennas, subcarriers)
    position: NDArray[Any]  # (3,) [m]


@dataclass(frozen=True, eq=False)
class Station:
    """One array of a data set.

    Args:
        number: Its number in the file, counted from 0.
        name: Its name.
        location: Position of its centre [m].
        rotation: Matrix that rotates array into world coordinates, float64 (3, 3).
        spacing: Distance between elements along rows and along columns [m].
        assignments: Antenna of each row and column, None for a missing one. None if the file does not assign antennas.
        frequency_hz: Frequency of the carrier [Hz].
    """

    number: int
    name: str
    location: tuple[float, ...]
    rotation: Tensor
    spacing: tuple[float, float]
    assignments: list[list[int | None]] | None
    frequency_hz: float

    def array(self, cells: Sequence[Cell], shape: tuple[int, int]) -> PlanarArray:
        """Return the elements of these cells of an array of that shape, x to the right and y up, seen from the front."""
        place = [
            (self.spacing[0] * (column - (shape[1] - 1) / 2), self.spacing[1] * ((shape[0] - 1) / 2 - row))
            for row, column, _ in cells
        ]
        return PlanarArray(torch.tensor(place, dtype=torch.float64), LIGHT_SPEED / self.frequency_hz)


class RecordFormat(Format[Snapshots]):
    """Reader of TFRecord files with channel and position, one record a measurement."""

    takes = frozenset({"beamformer", "grid", "every", "station", "drop_null", "round_trip"})
    assigned: ClassVar[bool]
    """whether the description assigns antennas to rows and columns"""

    @abstractmethod
    def cells(self, station: Station, file: Path) -> tuple[list[Cell], tuple[int, int]]:
        """Return the elements of an array, and its numbers of rows and columns."""

    @abstractmethod
    def parse(self, features: dict[str, bytes], file: Path) -> Record:
        """Return the measurement in the features of a record; refuse others by ValueError."""

    @abstractmethod
    def select(self, csi: NDArray[Any], station: Station, antennas: list[int]) -> NDArray[Any]:
        """Return the channels of the elements of an array, (K, subcarriers)."""

    def prepare(self, files: list[Path]) -> tuple[list[Path], tuple[str, ...]]:
        """Read what lies beside the records; return its files and notes."""
        return [], ()

    def recognises(self, path: Path) -> bool:
        described = _description(path) if _record_files(path) else None
        return bool(_record_files(path)) and self.assigned == (described is not None and _assigns(described))

    def read(self, path: Path, options: ReadOptions) -> Snapshots:
        files, described = _record_files(path), _description(path)
        if described is None:
            raise InputError(
                f"{path} holds records, but no JSON with antennas, which describes their arrays, lies beside them"
            )
        station = _read_station(described, options.station)
        cells, shape = self.cells(station, described)
        array = station.array(cells, shape)
        check_spacing(described, array)
        beside, notes = self.prepare(files)
        channels, positions, index, without = [], [], [], 0
        for number, (channel, position) in self._records(files, options.every or 1, station, cells):
            channel = channel[:, :: max(1, channel.shape[1] // SUBCARRIERS)].T
            power = float(np.abs(channel).astype(np.float64).max())
            if not (0 < power < math.inf and (np.abs(position) <= MAX_COORDINATE_M).all()):
                without += 1
                continue
            channels.append((channel / power).astype(np.complex64))
            positions.append(position.astype(np.float64))
            index.append(number)
            if len(channels) * channel.nbytes > MAX_UNPACKED_BYTES:
                raise InputError(
                    f"{path} holds more than {MAX_UNPACKED_BYTES} bytes of channels; take one record of several: every"
                )
        if not channels:
            raise InputError(f"{path} holds no record with a position and a channel")
        if without:
            notes = (*notes, f"records without a finite position or channel are left out: {without}")
        kept, null = without_null(torch.from_numpy(np.stack(channels)), options.drop_null)
        array, turned = round_trip_array(array) if options.round_trip else (array, ())
        name = path.resolve().name if path.is_dir() else path.stem
        return Snapshots(
            kept,
            np.stack(positions),
            array=array,
            name=f"{name}-{station.name}" if station.name else name,
            fixed_position=station.location,
            rotation=station.rotation,
            index=index,
            source=digests([*files, described, *beside]),
            notes=(*notes, *null, *turned),
        )

    def _records(
        self, files: list[Path], stride: int, station: Station, cells: list[Cell]
    ) -> Iterator[tuple[int, Record]]:
        """Yield number, channels (K, subcarriers) and position of every stride-th record of all files."""
        antennas = [antenna for _, _, antenna in cells]
        for number, (file, features) in enumerate((source, f) for source in files for f in records(source)):
            if number % stride == 0:
                try:
                    csi, position = self.parse(features, file)
                    record = Record(self.select(csi, station, antennas), position)
                except (KeyError, IndexError, ValueError) as error:
                    raise InputError(
                        f"{file}: record {number + 1} of all is not what the data set has ({error})"
                    ) from None
                yield number, record


def _record_files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob(f"*{SUFFIX}"))
    return [path] if path.suffix == SUFFIX else []


def _description(path: Path) -> Path | None:
    """Return the JSON file beside the records that describes their arrays."""
    folder = path if path.is_dir() else path.parent
    return next((file for file in sorted(folder.glob("*.json")) if _antennas(file)), None)


def _assigns(file: Path) -> bool:
    return any("assignments" in antenna for antenna in _antennas(file))


def _antennas(file: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(read_text(file))
    except (ValueError, RecursionError):  # InputError is such
        return []
    found = content.get("antennas") if isinstance(content, dict) else None
    return found if isinstance(found, list) and found and all(isinstance(a, dict) for a in found) else []


def _read_station(file: Path, number: int | None) -> Station:
    """Return the array with that number, counted from 1.

    Raises:
        InputError: Several arrays and no number, a number that is too large, or an incomplete description.
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
    return Station(
        index,
        names[index],
        location,
        _rotation(file, antenna),
        (spacing[0][0], spacing[1][0]),
        _assignments(file, antenna.get("assignments")),
        frequency[0],
    )


def _numbers(value: Any) -> tuple[float, ...]:
    """Return the finite numbers of a JSON number or list, none if it is something else."""
    values = value if isinstance(value, list) else [value]
    if all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_COORDINATE_M * 1e4 for v in values):
        return tuple(map(float, values))
    return ()


def _vector(file: Path, antenna: dict[str, Any], name: str) -> tuple[float, ...]:
    vector = _numbers(antenna.get(name))
    if len(vector) != 3 or max(map(abs, vector)) > MAX_COORDINATE_M:
        raise InputError(f"{file}: each array needs {name}, 3 finite numbers, got {antenna.get(name)}")
    return vector


def _rotation(file: Path, antenna: dict[str, Any]) -> Tensor:
    """Return the matrix of the axes to the right, up and to the front, seen from the front."""
    if "rightvector" in antenna:
        right, up = (np.array(_vector(file, antenna, name)) for name in ("rightvector", "upvector"))
    else:
        front = np.array(_vector(file, antenna, "direction"))
        right = np.cross([0.0, 0.0, 1.0], front)
        up = np.cross(front, right)
    size = np.linalg.norm(right) * np.linalg.norm(up)
    if not size > 1e-12 or abs(right @ up) > MAX_COSINE * size:
        raise InputError(
            f"{file}: rightvector and upvector of an array must be at right angles, or its direction not vertical"
        )
    right, front = (vector / np.linalg.norm(vector) for vector in (right, np.cross(right, up)))
    return torch.from_numpy(np.stack([right, np.cross(front, right), front], axis=1))


def _assignments(file: Path, assignments: Any) -> list[list[int | None]] | None:
    if assignments is None:
        return None
    rows: list[list[int | None]] = assignments if isinstance(assignments, list) else []
    if not rows or not all(isinstance(row, list) and len(row) == len(rows[0]) for row in rows):
        raise InputError(f"{file}: assignments must be rows of equal length, with null where an antenna is missing")
    cells = [cell for row in rows for cell in row]
    used = [cell for cell in cells if isinstance(cell, int) and not isinstance(cell, bool) and 0 <= cell < MAX_ANTENNAS]
    if len(used) + cells.count(None) != len(cells) or len(set(used)) != len(used) or len(used) < 2:
        raise InputError(
            f"{file}: assignments must name at least 2 antennas by their numbers, each once, got {assignments}"
        )
    return rows
