"""Arrays in npy files, npz archives and HDF5: never unpickled, with sizes checked before memory is allocated."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray

from swiftwrf.errors import InputError

MAX_UNPACKED_BYTES, MAX_STORED_BYTES = 2**30, 2**33  # of arrays that are compressed, and not
MAX_ROWS_BYTES = 2**36  # of an array that is read some rows at a time
NUMPY, HDF5 = (".npz",), (".h5", ".hdf5")
ARCHIVES = (*NUMPY, *HDF5)  # suffixes of files that hold arrays by name
Arrays = dict[str, NDArray[Any]]


def array_names(file: Path) -> set[str]:
    """Return the names of the arrays in an npz archive or HDF5 file, none if it is no such file."""
    try:
        if file.suffix in HDF5:
            with _hdf5(file) as content:
                return set(content)
        with zipfile.ZipFile(file) as archive:
            return _stored(archive)
    except InputError:
        raise
    except Exception:  # zipfile and h5py raise exceptions of many types for broken files
        return set()


def read_arrays(file: Path, needed: Sequence[str], optional: Sequence[str] = ()) -> Arrays:
    """Return arrays of numbers from an npz archive or HDF5 file.

    Raises:
        InputError: No such file, a broken one, an array that is missing or holds no numbers, or one that unpacks to more
            than 1 GiB from a smaller file.
    """
    if not file.is_file():
        raise InputError(f"{file} is missing")
    with refusing_broken(file, f"{'an HDF5 file' if file.suffix in HDF5 else 'an npz archive'} of plain numbers"):
        if file.suffix in HDF5:
            with _hdf5(file) as content:
                names = _choose(file, set(content), needed, optional)
                return _read_hdf5(content, names, file)
        with zipfile.ZipFile(file) as archive:
            names = _choose(file, _stored(archive), needed, optional)
            members = {name: archive.getinfo(f"{name}.npy") for name in names}
            _check_total(sum(member.file_size for member in members.values()), file)
            return {name: _read_member(archive, member) for name, member in members.items()}


def array_header(file: Path, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of the array in an npy file, or of the array of that name in an npz archive.

    Raises:
        InputError: As `read_rows`.
    """
    with _opened(file, name) as (stream, size):
        shape, _, dtype = _header(stream, name, size)
        return shape, dtype


def read_rows(file: Path, name: str, rows: int) -> Iterator[NDArray[Any]]:
    """Yield the array of `array_header`, at most `rows` rows at a time.

    Raises:
        InputError: No such file, one that is broken or holds no numbers, or more than 64 GiB.
    """
    with _opened(file, name) as (stream, size):
        shape, by_columns, dtype = _header(stream, name, size)
        if by_columns:  # rows are not contiguous
            _check_total(size, file)
            yield np.frombuffer(stream.read(), dtype).reshape(shape, order="F")
            return
        row = math.prod(shape[1:]) * dtype.itemsize
        for start in range(0, shape[0], rows):
            count = min(rows, shape[0] - start)
            yield np.frombuffer(stream.read(count * row), dtype).reshape(count, *shape[1:])


@contextmanager
def _opened(file: Path, name: str) -> Iterator[tuple[Any, int]]:
    """Open an npy file or a member of an npz archive; yield the stream and its length."""
    if not file.is_file():
        raise InputError(f"{file} is missing")
    if file.suffix not in NUMPY:
        with refusing_broken(file, "an npy file of plain numbers"), file.open("rb") as stream:
            _check_total(file.stat().st_size, file, MAX_ROWS_BYTES)
            yield stream, file.stat().st_size
        return
    with refusing_broken(file, "an npz archive of plain numbers"), zipfile.ZipFile(file) as archive:
        _choose(file, _stored(archive), [name], ())
        member = archive.getinfo(f"{name}.npy")
        _check_total(member.file_size, file, MAX_ROWS_BYTES)
        with archive.open(member) as stream:
            yield stream, member.file_size


@contextmanager
def refusing_broken(file: Path, kind: str) -> Iterator[None]:
    """Turn exceptions on a broken file into an InputError that names the file and its expected kind."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{file}: {error}" if str(file) not in str(error) else str(error)) from None
    except Exception as error:  # zipfile, zlib, NumPy, h5py, pyarrow and Pillow raise exceptions of many types
        raise InputError(f"{file} is not {kind} ({error})") from None


def _choose(file: Path, stored: set[str], needed: Sequence[str], optional: Sequence[str]) -> list[str]:
    missing = [name for name in needed if name not in stored]
    if missing:
        raise InputError(f"{file} lacks {', '.join(missing)}; it must hold {', '.join(needed)}")
    return [*needed, *(name for name in optional if name in stored)]


def _check_total(total: int, file: Path, most: int = MAX_STORED_BYTES) -> None:
    """Refuse arrays that unpack to far more than the size of the file, or exceed any memory."""
    most = max(MAX_UNPACKED_BYTES, min(file.stat().st_size, most))
    if total > most:
        raise InputError(f"it unpacks to {total} bytes; at most {most} are read, so split the data")


def _stored(archive: zipfile.ZipFile) -> set[str]:
    return {name.removesuffix(".npy") for name in archive.namelist()}


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as stream:
        shape, by_columns, dtype = _header(stream, member.filename, member.file_size)
        return np.frombuffer(stream.read(), dtype).reshape(shape, order="F" if by_columns else "C")


def _header(stream: Any, name: str, size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order and type of an array, once the stream is as long as the header claims."""
    readers = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}
    shape, by_columns, dtype = readers[read_magic(stream)](stream)
    if dtype.kind not in "biufc":
        raise ValueError(f"{name} holds {dtype}, expected numbers")
    if math.prod(shape) * dtype.itemsize != size - stream.tell():
        raise ValueError(f"{name} does not hold the {shape} numbers that it claims")
    return shape, by_columns, dtype


def _hdf5(file: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(
            f"{file} is HDF5, which h5py reads; install it with pip install 'swiftwrf-tasks[formats]'"
        ) from None
    return h5py.File(file, "r")


def _read_hdf5(content: Any, names: Sequence[str], file: Path) -> Arrays:
    """Return datasets of an HDF5 file. Links to other files are refused, because HDF5 follows them silently."""
    import h5py

    for name in names:
        own = isinstance(content.get(name, getlink=True), h5py.HardLink) and isinstance(content[name], h5py.Dataset)
        if not own or content[name].is_virtual or content[name].external or content[name].dtype.kind not in "biufc":
            raise ValueError(f"{name} is no array of numbers in this file")
    _check_total(sum(math.prod(content[name].shape) * content[name].dtype.itemsize for name in names), file)
    return {name: np.asarray(content[name][()]) for name in names}
