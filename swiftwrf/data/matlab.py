"""Arrays of numbers in MATLAB files (MathWorks, "MAT-File Format"), read without the compiled parser of SciPy.

That parser believes the sizes in a file of version 5: one damaged byte can end the process.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # of elements
MATRIX, COMPRESSED = 14, 15  # types of variables
STRUCTURE, OPAQUE, NUMBERS = 2, 17, range(6, 16)  # classes of variables; objects have no shape; double to uint64
MAX_STRUCTURE_BYTES = 2**28
CLASS, COMPLEX = 0xFF, 0x800  # bits of the flags of a variable
HEAD_BYTES = 1024  # of flags, shape and name, at most
Stored = tuple[int, Callable[[], NDArray[Any]]]  # bytes of an array in memory, and what reads it


def matlab_arrays(file: Path) -> dict[str, Stored]:
    """Return the variables of a file by name, or the fields of its only one.

    A broken file, or one without numbers, raises an error of any type.
    """
    arrays: dict[str, Stored] = {}
    with file.open("rb") as stream:
        header, end = stream.read(128), file.stat().st_size
        if 0 in header[:4]:  # version 4, whose parser is not compiled
            for name, shape, kind in whosmat(file):
                if kind not in ("char", "sparse"):
                    arrays[name] = 16 * math.prod(shape), partial(_of_version_4, file, name)
            return arrays
        order = {b"IM": "<", b"MI": ">"}[header[126:]]
        while tag := stream.read(8):
            kind, size = np.frombuffer(tag, f"{order}u4", 2).tolist()
            start = stream.tell()
            if kind not in (MATRIX, COMPRESSED) or start + size > end:
                raise ValueError("a variable is not complete")
            content = partial(_content, file, start, size, kind == COMPRESSED)
            flags, shape, text = islice(_elements(content(HEAD_BYTES), order), 3)
            name = (shape if flags[0] & CLASS == OPAQUE else text).tobytes().decode()
            if name in arrays:
                raise ValueError(f"{name} is stored twice")
            sizes = shape.tolist()
            is_structure = bool(flags[0] & CLASS == STRUCTURE) and math.prod(sizes) == 1
            arrays[name] = 16 * math.prod(sizes), partial(_array, content, order, int(flags[0]), sizes)  # if complex
            stream.seek(start + size)
    return _fields(content, order) if len(arrays) == 1 and is_structure else arrays


def _fields(content: Callable[[int], bytes], order: str) -> dict[str, Stored]:
    """Return the fields of a structure by name. Fields that hold no numbers raise an error when they are read."""
    whole = content(MAX_STRUCTURE_BYTES)
    spans = [*_spans(whole, order)]
    (_, start, size), names = spans[3], spans[4]
    width = int(np.frombuffer(whole, f"{order}i4", 1, start)[0])
    text = whole[names[1] : names[1] + names[2]]
    if width <= 0 or len(text) % width or len(text) // width != len(spans) - 5:
        raise ValueError("a structure does not have the fields that it names")
    fields: dict[str, Stored] = {}
    for number, (kind, start, size) in enumerate(spans[5:]):
        if kind != MATRIX:
            raise ValueError("a field is no variable")
        name = text[number * width : (number + 1) * width].split(b"\0")[0].decode()
        own = partial(_first, whole[start : start + size])
        flags, shape, _ = islice(_elements(own(HEAD_BYTES), order), 3)
        fields[name] = 16 * math.prod(shape.tolist()), partial(_array, own, order, int(flags[0]), shape.tolist())
    return fields


def _first(content: bytes, most: int) -> bytes:
    return content[:most]


def _of_version_4(file: Path, name: str) -> NDArray[Any]:
    return np.ascontiguousarray(loadmat(file, variable_names=[name])[name])


def _content(file: Path, start: int, size: int, is_compressed: bool, most: int) -> bytes:
    """Return the elements of a variable from its bytes in the file, at most `most` bytes."""
    with file.open("rb") as stream:
        stream.seek(start)
        if not is_compressed:
            return stream.read(min(size, most))
        return zlib.decompressobj().decompress(stream.read(size), most + 8)[8:]  # without the tag inside


def _elements(content: bytes, order: str) -> Iterator[NDArray[Any]]:
    """Yield the elements of a variable: flags, shape, name, real and imaginary parts."""
    for kind, start, size in _spans(content, order):
        if kind not in TYPES:
            raise ValueError(f"it has an element of the unknown type {kind}")
        dtype = np.dtype(order + TYPES[kind])
        yield np.frombuffer(content, dtype, size // dtype.itemsize, start)


def _spans(content: bytes, order: str) -> Iterator[tuple[int, int, int]]:
    """Yield type, start and size [bytes] of the elements of a variable."""
    at = 0
    while at < len(content):
        kind, size = np.frombuffer(content, f"{order}u4", 2, at).tolist()
        start, step = at + 8, 8 + -(-size // 8) * 8
        if kind >> 16:  # a small element, whose tag contains it
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        yield kind, start, size
        at += step


def _array(content: Callable[[int], bytes], order: str, flags: int, shape: list[int]) -> NDArray[Any]:
    """Return a variable, in the type in which it is stored."""
    if flags & CLASS not in NUMBERS:
        raise ValueError("it holds a cell, structure, text or object, expected numbers")
    count = math.prod(shape)
    parts = list(islice(_elements(content(17 * count + HEAD_BYTES), order), 3, None))
    if len(parts) != 1 + bool(flags & COMPLEX) or any(len(part) != count for part in parts):
        raise ValueError(f"an array does not hold the {shape} numbers that it claims")
    values = parts[0].astype(
        np.result_type(parts[0], np.complex64) if len(parts) > 1 else parts[0].dtype.newbyteorder("=")
    )
    if len(parts) > 1:
        values.imag = parts[1]
    return np.ascontiguousarray(values.reshape(shape, order="F"))
