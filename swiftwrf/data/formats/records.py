"""Readers of DICHASUS and ESPARGOS data sets: TFRecord files, and a JSON file that describes their arrays.

The JSON's `antennas` give each array's `location`, `spacingX` (along its rows) and `spacingY` [m], and its orientation:
`rightvector` and `upvector` as seen from its front, or its `direction` alone for an upright array. The carrier is
`frequency` [Hz]. Row 0 of an array is its upper one and column 0 its left one, seen from the front.

TFRecord files are read without TensorFlow: a frame around each record, and four protocol-buffer messages inside.

    record:     length (8 bytes, little-endian), its checksum (4), data, checksum of the data (4)
    Example:    1: Features
    Features:   1: map entry, 1: name, 2: Feature
    Feature:    1: BytesList, 2: FloatList, 3: Int64List, each with 1: value
    TensorProto 1: dtype, 2: shape, with 2: dimension, with 1: size; 4: the numbers, little-endian

A checksum is the CRC-32C, rotated right by 15 bits, plus 0xa282ead8.
"""

from __future__ import annotations

import json
import math
import struct
from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import google_crc32c
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.archives import MAX_UNPACKED_BYTES
from swiftwrf.data.files import check_carrier, digests, read_text
from swiftwrf.data.formats.base import SNAPSHOT_FORMATS, Format, ReadOptions
from swiftwrf.data.snapshots import Snapshots, check_spacing, round_trip_array, without_null
from swiftwrf.errors import InputError
from swiftwrf.positions import MAX_COORDINATE_M

SUFFIX = ".tfrecords"
SUBCARRIERS = 64  # kept of each measurement, evenly spaced: more do not improve directions
MAX_COSINE = 0.1  # between right and up: beyond, they are no axes of a plane
MAX_ANTENNAS = 4096
ROWS, COLUMNS = 2, 4  # of an array of ESPARGOS
MAX_RECORD_BYTES = 2**28
DTYPES: dict[Any, np.dtype[Any]] = {
    number: np.dtype(name) for number, name in ((1, "<f4"), (2, "<f8"), (3, "<i4"), (8, "<c8"), (9, "<i8"))
}
DTYPES[18] = np.dtype("<c16")
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types
NO_OFFSETS = (
    "no reftx-offsets-NAME.json lies beside the records, so the elements' phases are as measured: calibrate them"
)
Assignments = list[list[int | None]]  # antenna of each row and column of an array, None for a missing one


class RecordFormat(Format[Snapshots]):
    """Reader of TFRecord files with channel and position, one record a measurement."""

    takes = frozenset({"beamformer", "grid", "every", "station", "drop_null", "round_trip"})
    assigned: ClassVar[bool]
    """whether the description assigns antennas to rows and columns"""

    @abstractmethod
    def parse(self, features: dict[str, bytes], file: Path) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return channel (antennas, subcarriers) and position (3,) [m] of a record; refuse others by ValueError."""

    def prepare(self, files: list[Path]) -> tuple[list[Path], tuple[str, ...]]:
        """Read what lies beside the records; return its files and notes."""
        return [], ()

    def recognises(self, path: Path) -> bool:
        described = _description(path) if _record_files(path) else None
        assigns = described is not None and any("assignments" in antenna for antenna in _antennas(described))
        return bool(_record_files(path)) and self.assigned == assigns

    def read(self, path: Path, options: ReadOptions) -> Snapshots:
        files, described = _record_files(path), _description(path)
        if described is None:
            raise InputError(
                f"{path} holds records, but no JSON with antennas, which describes their arrays, lies beside them"
            )
        station, link, antennas = _read_station(described, options.station, self.assigned)
        check_spacing(described, link["array"])
        beside, notes = self.prepare(files)
        channels, positions, index, without, stride = [], [], [], 0, options.every or 1
        for number, (file, features) in enumerate((source, f) for source in files for f in records(source)):
            if number % stride:
                continue
            try:
                csi, position = self.parse(features, file)
                channel = csi[antennas]
            except (KeyError, IndexError, ValueError) as error:
                raise InputError(f"{file}: record {number + 1} of all is not what the data set has ({error})") from None
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
        turned: tuple[str, ...] = ()
        if options.round_trip:
            link["array"], turned = round_trip_array(link["array"])
        name = path.resolve().name if path.is_dir() else path.stem
        return Snapshots(
            kept,
            np.stack(positions),
            **link,
            name=f"{name}-{station}" if station else name,
            index=index,
            source=digests([*files, described, *beside]),
            notes=(*notes, *null, *turned),
        )


@SNAPSHOT_FORMATS.register("espargos")
class Espargos(RecordFormat):
    """Data sets of https://espargos.net/datasets: `csi` complex (arrays, 2, 4, subcarriers), `pos` (3,) [m]."""

    assigned = False

    def parse(self, features: dict[str, bytes], file: Path) -> tuple[NDArray[Any], NDArray[Any]]:
        csi, position = tensor(features["csi"]), tensor(features["pos"])
        fits = csi.ndim == 4 and csi.shape[1:3] == (ROWS, COLUMNS) and csi.dtype.kind == "c" and 0 not in csi.shape
        if not fits or position.shape != (3,):
            raise ValueError(f"csi of shape {csi.shape} and pos of shape {position.shape}")
        return csi.reshape(-1, csi.shape[3]), position


@SNAPSHOT_FORMATS.register("dichasus")
class Dichasus(RecordFormat):
    """Data sets of https://dichasus.inue.uni-stuttgart.de.

    `csi` is float32 (antennas, subcarriers, 2) of real and imaginary parts, `pos-tachy` (3,) [m]. The phase and time offsets
    of the antennas are those of reftx-offsets-NAME.json if it lies beside NAME.tfrecords.
    """

    assigned = True

    def prepare(self, files: list[Path]) -> tuple[list[Path], tuple[str, ...]]:
        found = {file: file.with_name(f"reftx-offsets-{file.stem}.json") for file in files}
        self._offsets = {file: _read_offsets(source) for file, source in found.items() if source.is_file()}
        return [found[file] for file in self._offsets], () if len(self._offsets) == len(files) else (NO_OFFSETS,)

    def parse(self, features: dict[str, bytes], file: Path) -> tuple[NDArray[Any], NDArray[Any]]:
        parts, position = tensor(features["csi"]), tensor(features["pos-tachy"])
        fits = parts.ndim == 3 and parts.shape[2] == 2 and parts.dtype.kind == "f" and 0 not in parts.shape
        if not fits or position.shape != (3,):
            raise ValueError(f"csi of shape {parts.shape} and pos-tachy of shape {position.shape}")
        joined = parts.view(np.result_type(parts.dtype, np.complex64))[..., 0]
        csi = np.fft.fftshift(joined, axes=1)  # from the order of the FFT to that of frequency
        if (offsets := self._offsets.get(file)) is not None:
            if len(offsets) != len(csi):
                raise ValueError(f"{len(csi)} antennas, but offsets of {len(offsets)}")
            cycles = np.arange(csi.shape[1]) / csi.shape[1]
            with np.errstate(invalid="ignore", over="ignore"):  # `read` omits channels that are not finite
                csi = csi * np.exp(1j * (offsets[:, :1] + offsets[:, 1:] * 2 * np.pi * cycles))
        return csi, position


def _read_offsets(file: Path) -> NDArray[Any]:
    """Return carrier phase [rad] and sampling time [samples] to add to each antenna, (antennas, 2)."""
    try:
        content = json.loads(read_text(file))
        values = np.array([content["cpo"], content["sto"]], dtype=np.float64).T
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise InputError(f"{file} must hold lists cpo and sto with a number for each antenna ({error})") from None
    if values.ndim != 2 or not np.isfinite(values).all():
        raise InputError(f"{file} must hold lists cpo and sto with a finite number for each antenna")
    return values


def _record_files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob(f"*{SUFFIX}"))
    return [path] if path.suffix == SUFFIX else []


def _description(path: Path) -> Path | None:
    """Return the JSON file beside the records that describes their arrays."""
    folder = path if path.is_dir() else path.parent
    return next((file for file in sorted(folder.glob("*.json")) if _antennas(file)), None)


def _antennas(file: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(read_text(file))
    except (ValueError, RecursionError):  # InputError is such
        return []
    found = content.get("antennas") if isinstance(content, dict) else None
    return found if isinstance(found, list) and found and all(isinstance(a, dict) for a in found) else []


def _read_station(file: Path, number: int | None, assigned: bool) -> tuple[str, dict[str, Any], list[int]]:
    """Return name, array with position and rotation, and antennas of its elements, of the array with that number from 1.

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
    rotation = _rotation(file, antenna)
    rows: Assignments = [[row * COLUMNS + column for column in range(COLUMNS)] for row in range(ROWS)]
    first = index * ROWS * COLUMNS  # of the antennas of ESPARGOS, whose arrays follow each other
    if assigned:
        rows, first = _assignments(file, antenna.get("assignments"), names[index]), 0
    middle, ((right,), (up,)) = ((len(rows) - 1) / 2, (len(rows[0]) - 1) / 2), spacing
    cells = [(r, c, antenna) for r, row in enumerate(rows) for c, antenna in enumerate(row) if antenna is not None]
    element = [(right * (column - middle[1]), up * (middle[0] - row)) for row, column, _ in cells]
    array = PlanarArray(torch.tensor(element, dtype=torch.float64), LIGHT_SPEED / frequency[0])
    link = {"array": array, "fixed_position": location, "rotation": rotation}
    return names[index], link, [first + antenna for _, _, antenna in cells]


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


def _assignments(file: Path, assignments: Any, name: str) -> Assignments:
    if assignments is None:
        raise InputError(f"{file}: array {name} lacks assignments, the antenna of each row and column")
    rows: Assignments = assignments if isinstance(assignments, list) else []
    if not rows or not all(isinstance(row, list) and len(row) == len(rows[0]) for row in rows):
        raise InputError(f"{file}: assignments must be rows of equal length, with null where an antenna is missing")
    cells = [cell for row in rows for cell in row]
    used = [cell for cell in cells if isinstance(cell, int) and not isinstance(cell, bool) and 0 <= cell < MAX_ANTENNAS]
    if len(used) + cells.count(None) != len(cells) or len(set(used)) != len(used) or len(used) < 2:
        raise InputError(
            f"{file}: assignments must name at least 2 antennas by their numbers, each once, got {assignments}"
        )
    return rows


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
    crc = google_crc32c.value(content)
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
        if wire == VARINT:
            value, at = _varint(message, at)
            yield field, value
            continue
        if wire == BYTES:
            length, at = _varint(message, at)
        elif wire in (FIXED64, FIXED32):
            length = 8 if wire == FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire}")
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
