"""Readers of DICHASUS and ESPARGOS data sets: TFRecord files, and a JSON file that describes their arrays.

The JSON's `antennas` give each array's `location`, `spacingX` (along its rows) and `spacingY` [m], and its orientation:
`rightvector` and `upvector` as seen from its front, or its `direction` alone for an upright array. The carrier is
`frequency` [Hz]. Row 0 of an array is taken as its upper one and column 0 as its left one, seen from the front. The data
sets do not define this, so inspect the frames. For DICHASUS the JSON has `assignments`, the antenna of each row and column.

| data set | `csi` | position |
|---|---|---|
| ESPARGOS | complex (arrays, 2, 4, subcarriers) | `pos` (3,) [m] |
| DICHASUS | float32 (antennas, subcarriers, 2): real and imaginary parts, in the order of the FFT | `pos-tachy` (3,) [m] |

64 evenly spaced subcarriers are kept. Phase and time offsets are applied if `reftx-offsets-NAME.json` lies beside
`NAME.tfrecords`. Records without a finite position or channel are left out and counted.

TFRecord files are read without TensorFlow: a frame around each record, and four protocol-buffer messages inside.

    record:     length (8 bytes, little-endian), its checksum (4), data, checksum of the data (4)
    Example:    1: Features
    Features:   1: map entry, 1: name, 2: Feature
    Feature:    1: BytesList, 2: FloatList, 3: Int64List, each with 1: value
    TensorProto 1: dtype, 2: shape, with 2: dimension, with 1: size; 4: the numbers, little-endian

A checksum is the CRC-32C, rotated right by 15 bits, plus 0xa282ead8.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Lt
from numpy.typing import NDArray

from swiftwrf.data.archives import MAX_UNPACKED_BYTES, Arrays, refusing_broken
from swiftwrf.data.files import read_text
from swiftwrf.data.formats.base import Format, ReadOptions, station
from swiftwrf.data.formats.snapshots import snapshots_of
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.errors import InputError, optional_module
from swiftwrf.positions import MAX_COORDINATE_M, check_positions
from swiftwrf.runtime.plain import read_json
from swiftwrf.runtime.validation import PositiveFloat, check_value

SUFFIX = ".tfrecords"
ROWS, COLUMNS = 2, 4  # of an array of ESPARGOS
MAX_RECORD_BYTES = 2**28
NO_OFFSETS = (
    "no reftx-offsets-NAME.json lies beside the records, so the elements' phases are as measured: calibrate them"
)
DTYPES: dict[Any, np.dtype[Any]] = {
    number: np.dtype(name) for number, name in ((1, "<f4"), (2, "<f8"), (3, "<i4"), (8, "<c8"), (9, "<i8"))
}
DTYPES[18] = np.dtype("<c16")
Assignments = list[list[Annotated[int, Ge(0), Lt(4096)] | None]]  # antenna of each row and column, None if missing


class Records(Format[Snapshots]):
    """TFRecord files with channel and position, one record a measurement, of ESPARGOS or DICHASUS.

    See https://espargos.net/datasets and https://dichasus.inue.uni-stuttgart.de.
    """

    takes = frozenset({"beamformer", "grid", "every", "station", "drop_null", "drop_elements", "round_trip"})

    def recognises(self, path: Path) -> bool:
        return bool(_record_files(path))

    def stations(self, path: Path) -> list[str]:
        described = _description(path)
        return [] if described is None else _station_names(described[1])

    def read(self, path: Path, options: ReadOptions) -> Snapshots:
        files, described = _record_files(path), _description(path)
        if described is None:
            raise InputError(
                f"{path} holds records, but no JSON with antennas, which describes their arrays, lies beside them"
            )
        is_dichasus = any("assignments" in antenna for antenna in described[1]["antennas"])
        name, arrays, antennas = _read_station(*described, options.station, is_dichasus)
        beside = {file: file.with_name(f"reftx-offsets-{file.stem}.json") for file in files} if is_dichasus else {}
        offsets = {file: _read_offsets(source) for file, source in beside.items() if source.is_file()}
        notes = [NO_OFFSETS] * (len(offsets) < len(beside))
        place = "pos-tachy" if is_dichasus else "pos"
        channels, positions, index, without, stride = [], [], [], 0, options.every or 1
        for number, (file, features) in enumerate((source, f) for source in files for f in records(source)):
            if number % stride:
                continue
            try:
                csi = tensor(features["csi"])
                channel = (_of_dichasus(csi, offsets.get(file)) if is_dichasus else _of_espargos(csi))[antennas]
                position = tensor(features[place])
                if position.shape != (3,):
                    raise ValueError(f"{place} of shape {position.shape}")
            except (KeyError, IndexError, ValueError) as error:
                raise InputError(f"{file}: record {number + 1} of all is not what the data set has ({error})") from None
            channel = channel[:, :: max(1, channel.shape[1] // 64)].T  # more subcarriers do not improve directions
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
            notes.append(f"records without a finite position or channel are left out: {without}")
        arrays |= {"csi": np.stack(channels), "position": np.stack(positions)}
        name = "-".join(filter(None, [path.resolve().name if path.is_dir() else path.stem, name]))
        read = [*files, described[0], *(beside[file] for file in offsets)]
        return snapshots_of(path, arrays, options, read, name, tuple(notes), index)


def _of_espargos(csi: NDArray[Any]) -> NDArray[Any]:
    """Return the channel (antennas, subcarriers) of a record of ESPARGOS."""
    if csi.ndim != 4 or csi.shape[1:3] != (ROWS, COLUMNS) or csi.dtype.kind != "c" or 0 in csi.shape:
        raise ValueError(f"csi of shape {csi.shape}")
    return csi.reshape(-1, csi.shape[3])


def _of_dichasus(csi: NDArray[Any], offsets: NDArray[Any] | None) -> NDArray[Any]:
    """Return the channel (antennas, subcarriers) of a record of DICHASUS, with offsets applied if they are known."""
    if csi.ndim != 3 or csi.shape[2] != 2 or csi.dtype.kind != "f" or 0 in csi.shape:
        raise ValueError(f"csi of shape {csi.shape}")
    joined = csi.view(np.result_type(csi.dtype, np.complex64))[..., 0]
    channel = np.fft.fftshift(joined, axes=1)  # from the order of the FFT to that of frequency
    if offsets is None:
        return channel
    if len(offsets) != len(channel):
        raise ValueError(f"{len(channel)} antennas, but offsets of {len(offsets)}")
    cycles = np.arange(channel.shape[1]) / channel.shape[1]
    with np.errstate(invalid="ignore", over="ignore"):  # `read` omits channels that are not finite
        turned: NDArray[Any] = channel * np.exp(1j * (offsets[:, :1] + offsets[:, 1:] * 2 * np.pi * cycles))
    return turned


def _read_offsets(file: Path) -> NDArray[Any]:
    """Return carrier phase [rad] and sampling time [samples] to add to each antenna, (antennas, 2)."""
    with refusing_broken(file, "JSON with lists cpo and sto, a number for each antenna"):
        content = read_json(read_text(file))
        values = np.array([content["cpo"], content["sto"]], dtype=np.float64).T
        if values.ndim != 2 or not np.isfinite(values).all():
            raise ValueError(f"got {values.shape[::-1]} numbers, or some that are not finite")
    return values


def _record_files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob(f"*{SUFFIX}"))
    return [path] if path.suffix == SUFFIX else []


def _description(path: Path) -> tuple[Path, dict[str, Any]] | None:
    """Return the JSON file beside the records that describes their arrays, and its content."""
    folder = path if path.is_dir() else path.parent
    for file in sorted(folder.glob("*.json")):
        try:
            content = read_json(read_text(file))
        except (ValueError, RecursionError):  # InputError is such
            continue
        antennas = content.get("antennas") if isinstance(content, dict) else None
        if isinstance(antennas, list) and antennas and all(isinstance(antenna, dict) for antenna in antennas):
            return file, content
    return None


def _station_names(content: dict[str, Any]) -> list[str]:
    return [str(antenna.get("name", "")) or f"array {n}" for n, antenna in enumerate(content["antennas"], start=1)]


def _read_station(
    file: Path, content: dict[str, Any], number: int | None, assigned: bool
) -> tuple[str, Arrays, list[int]]:
    """Return name, arrays as of snapshots.npz, and antennas of the elements, of the array with that number from 1."""
    names = _station_names(content)
    index = station(f"{file} describes {len(names)} arrays", names, number)
    antenna = content["antennas"][index]
    right, up = antenna.get("spacingX"), antenna.get("spacingY")
    frequency: Any = content.get("frequency")
    sizes = {"spacingX [m] of an array": right, "spacingY [m] of an array": up, "frequency": frequency}
    for name, value in sizes.items():
        check_value(f"{file}: {name}", value, PositiveFloat)
    rows: Assignments = [[row * COLUMNS + column for column in range(COLUMNS)] for row in range(ROWS)]
    first = index * ROWS * COLUMNS  # of the antennas of ESPARGOS, whose arrays follow each other
    if assigned:
        rows, first = antenna.get("assignments"), 0
        check_value(f"{file}: assignments, the antenna of each row and column,", rows, Assignments)
        if len({len(row) for row in rows}) != 1:
            raise InputError(f"{file}: assignments must be rows of equal length, with null where an antenna is missing")
        used = [cell for row in rows for cell in row if cell is not None]
        if len(set(used)) != len(used) or len(used) < 2:
            raise InputError(
                f"{file}: assignments must name 2 or more antennas by their numbers, each once, got {rows}"
            )
    middle = (len(rows) - 1) / 2, (len(rows[0]) - 1) / 2
    cells = [(r, c, antenna) for r, row in enumerate(rows) for c, antenna in enumerate(row) if antenna is not None]
    normal, top = _facing(file, antenna)
    arrays = {
        "frequency_hz": frequency,
        "element_position": [(right * (column - middle[1]), up * (middle[0] - row)) for row, column, _ in cells],
        "array_position": _vector(file, antenna, "location"),
        "array_normal": normal,
        "array_up": top,
    }
    described = {name: np.array(values, dtype=np.float64) for name, values in arrays.items()}
    return names[index], described, [first + antenna for _, _, antenna in cells]


def _facing(file: Path, antenna: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal of an array, to its front, and its upper side, from the axes to the right and up or the normal."""
    if "rightvector" not in antenna:
        return _vector(file, antenna, "direction"), np.array([0.0, 0.0, 1.0])
    right, up = _vector(file, antenna, "rightvector"), _vector(file, antenna, "upvector")
    size = np.linalg.norm(right) * np.linalg.norm(up)
    if not size > 1e-12 or abs(right @ up) > 0.1 * size:
        raise InputError(f"{file}: rightvector and upvector of an array must be at right angles")
    normal = np.cross(right, up)
    return normal, np.cross(normal, right)


def _vector(file: Path, antenna: dict[str, Any], name: str) -> NDArray[np.float64]:
    found: NDArray[np.float64] = check_positions(antenna.get(name), f"{file}: {name}", (3,)).numpy()
    return found


def records(file: Path) -> Iterator[dict[str, bytes]]:
    """Yield the features of each record: bytes, or the message of a feature of numbers.

    Raises:
        InputError: The file ends within a record, a checksum does not match, or a record is no example.
    """
    with file.open("rb") as stream:
        number = 0
        while head := stream.read(12):
            number += 1
            length = struct.unpack("<Q", head[:8])[0] if len(head) == 12 else MAX_RECORD_BYTES + 1
            content = stream.read(length) if length <= MAX_RECORD_BYTES else b""
            tail = stream.read(4)
            if len(content) != length or len(tail) != 4:
                raise InputError(f"{file} is no TFRecord file, or ends within record {number}")
            if head[8:] != checksum(head[:8]) or tail != checksum(content):
                raise InputError(
                    f"{file}: record {number} is damaged, its checksum does not match; copy the file again"
                )
            try:
                yield _features(content)
            except (ValueError, IndexError, UnicodeDecodeError) as error:
                raise InputError(f"{file}: record {number} is no example of features ({error})") from None


def checksum(content: bytes) -> bytes:
    """Return the masked CRC-32C of a record's length or data, 4 bytes.

    Example:
        >>> checksum(b"123456789").hex()
        'e5b08ac7'
    """
    crc = optional_module("google_crc32c", "records are checked by google-crc32c", "formats").value(content)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def tensor(content: bytes) -> NDArray[Any]:
    """Return the numbers of a serialized tensor.

    Raises:
        ValueError: No tensor of numbers, or a number of them that does not match its shape.
    """
    fields: dict[int, Any] = dict(_fields(content))
    dtype, numbers = DTYPES.get(fields.get(1)), fields.get(4, b"")
    if dtype is None or not isinstance(numbers, bytes):
        raise ValueError("a tensor of another type than numbers")
    sizes = [dict(_fields(dimension)).get(1, 0) for part in _messages(content, 2) for dimension in _messages(part, 2)]
    shape = [size for size in sizes if isinstance(size, int)]
    values: NDArray[Any] = np.frombuffer(numbers, dtype)  # raises for an incomplete number
    if len(shape) < len(sizes) or len(values) != math.prod(shape):
        raise ValueError(f"a tensor of shape {tuple(sizes)[:8]} with {len(values)} numbers")
    return values.reshape(shape)


def _features(example: bytes) -> dict[str, bytes]:
    """Return the first value of each feature of bytes, or the packed numbers of others."""
    entries = (dict(_fields(entry)) for features in _messages(example, 1) for entry in _messages(features, 1))
    return {
        name.decode(): next((value for values in _messages(feature) for value in _messages(values)), b"")
        for name, feature in ((entry.get(1), entry.get(2)) for entry in entries)
        if isinstance(name, bytes) and isinstance(feature, bytes)
    }


def _messages(message: bytes, number: int | None = None) -> Iterator[bytes]:
    """Yield the values of bytes of a message, of all fields or of those with a number."""
    return (value for field, value in _fields(message) if isinstance(value, bytes) and number in (None, field))


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield numbers and values of the fields of a protocol-buffer message."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        field, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(message, at)
            yield field, value
            continue
        if wire not in (1, 2, 5):
            raise ValueError(f"wire type {wire}")
        length, at = _varint(message, at) if wire == 2 else (8 if wire == 1 else 4, at)
        if at + length > len(message):
            raise ValueError("a field that is longer than its message")
        yield field, message[at : at + length]
        at += length


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        byte = message[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise ValueError("a number of more than 64 bits")
