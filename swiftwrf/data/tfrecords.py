"""TFRecord files without TensorFlow: a frame around each record, and four protocol-buffer messages inside.

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
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from swiftwrf.errors import InputError

MAX_RECORD_BYTES = 2**28
DTYPES: dict[int, np.dtype[Any]] = {
    1: np.dtype("<f4"),
    2: np.dtype("<f8"),
    3: np.dtype("<i4"),
    8: np.dtype("<c8"),
    9: np.dtype("<i8"),
    18: np.dtype("<c16"),
}
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types


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
    dtype: np.dtype[Any] | None = None
    shape: list[int] = []
    numbers = b""
    for field, value in _fields(content):
        if field == 1 and isinstance(value, int):
            dtype = DTYPES.get(value)
        elif field == 2 and isinstance(value, bytes):
            shape = [_size(dimension) for name, dimension in _fields(value) if name == 2]
        elif field == 4 and isinstance(value, bytes):
            numbers = value
    if dtype is None:
        raise ValueError("a tensor of another type than numbers")
    values: NDArray[Any] = np.frombuffer(numbers, dtype)  # raises for an incomplete number
    if len(values) != math.prod(shape):
        raise ValueError(f"a tensor of shape {tuple(shape)[:8]} with {len(values)} numbers")
    return values.reshape(shape)


def _size(dimension: int | bytes) -> int:
    if not isinstance(dimension, bytes):
        raise ValueError("a shape that is none")
    return next((value for name, value in _fields(dimension) if name == 1 and isinstance(value, int)), 0)


def _features(example: bytes) -> dict[str, bytes]:
    found = {}
    for outer, features in _fields(example):
        for inner, entry in _fields(features) if outer == 1 and isinstance(features, bytes) else ():
            if inner == 1 and isinstance(entry, bytes):
                pair = dict(_fields(entry))
                name, feature = pair.get(1), pair.get(2)
                if isinstance(name, bytes) and isinstance(feature, bytes):
                    found[name.decode()] = _value(feature)
    return found


def _value(feature: bytes) -> bytes:
    """Return the first value of a feature of bytes, or the packed numbers of others."""
    for _, values in _fields(feature):
        for _, value in _fields(values) if isinstance(values, bytes) else ():
            if isinstance(value, bytes):
                return value
    return b""


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
