"""Arrays in npy, npz, HDF5 and MATLAB files: never unpickled, with sizes checked before memory is allocated."""

from __future__ import annotations

import gzip
import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray

from swiftwrf.data.matlab import Stored, matlab_arrays
from swiftwrf.errors import InputError, listed, optional_module

MAX_UNPACKED_BYTES, MAX_STORED_BYTES = 2**30, 2**33  # of arrays that are compressed, and not
MAX_ROWS_BYTES = 2**36  # of an array that is read some rows at a time
NUMPY, HDF5, MATLAB = (".npz",), (".h5", ".hdf5"), (".mat",)
ARCHIVES = (*NUMPY, *HDF5, *MATLAB)  # suffixes of files that hold arrays by name
MATLAB_HDF5 = (b"MATLAB 7.3", b"\x89HDF")  # first bytes of .mat files that are HDF5, of MATLAB and of Octave
PACKED = (".gz", ".zip")  # suffixes of files that hold one compressed text
NUMBERS = "biufc"  # kinds of NumPy types
Arrays = dict[str, NDArray[Any]]


def array_names(file: Path) -> set[str]:
    """Return the names of the arrays in an npz archive, HDF5 or MATLAB file, none if it is no such file."""
    try:
        with _opened(file) as (names, _):
            return names
    except InputError:
        raise
    except Exception:  # zipfile, SciPy and h5py raise exceptions of many types for broken files
        return set()


def read_arrays(file: Path, needed: Sequence[str], optional: Sequence[str] = (), kinds: str = NUMBERS) -> Arrays:
    """Return arrays of numbers from an npz archive, HDF5 or MATLAB file. Compounds of real and imaginary parts are complex.

    Arrays of an npz archive may be of other NumPy `kinds`.

    Raises:
        InputError: No such file, a broken one, an array that is missing or holds no numbers, or one that unpacks to more
            than 1 GiB from a smaller file.
    """
    if not file.is_file():
        raise InputError(f"{file} is missing")
    kind = "an HDF5 file" if _is_hdf5(file) else "a MATLAB file" if file.suffix in MATLAB else "an npz archive"
    with refusing_broken(file, f"{kind} of plain numbers"), _opened(file, kinds) as (names, find):
        stored = {name: find(name) for name in _choose(file, names, needed, optional)}
        _check_total(sum(size for size, _ in stored.values()), file)
        return {name: read() for name, (_, read) in stored.items()}


@contextmanager
def _opened(file: Path, kinds: str = NUMBERS) -> Iterator[tuple[set[str], Callable[[str], Stored]]]:
    """Open an archive; yield the names of its arrays, and a function that finds an array by name."""
    if _is_hdf5(file):
        with optional_module("h5py", f"{file} is HDF5, which h5py reads", "formats").File(file, "r") as content:
            yield set(content), partial(_in_hdf5, content)
    elif file.suffix in MATLAB:
        variables = matlab_arrays(file)
        yield set(variables), variables.__getitem__
    else:
        if not zipfile.is_zipfile(file):  # NumPy would advise to load it as a pickle
            raise ValueError("it is no zip archive")
        with np.load(file, allow_pickle=False) as archive:
            members = {info.filename.removesuffix(".npy"): info.file_size for info in archive.zip.infolist()}

            def member(name: str) -> Stored:
                def read() -> NDArray[Any]:
                    with archive.zip.open(f"{name}.npy") as stream:
                        _header(stream, name, members[name], kinds)  # refuses a claim of more than the archive holds
                    return np.asarray(archive[name])

                return members[name], read

            yield set(members), member


def array_header(file: Path, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of the array in an npy file, or of the array of that name in an npz archive.

    Raises:
        InputError: As `read_rows`.
    """
    with _stream(file, name) as (stream, size):
        shape, _, dtype = _header(stream, name, size)
        return shape, dtype


def read_rows(file: Path, name: str, rows: int) -> Iterator[NDArray[Any]]:
    """Yield the array of `array_header`, at most `rows` rows at a time.

    Raises:
        InputError: No such file, one that is broken or holds no numbers, or more than 64 GiB.
    """
    with _stream(file, name) as (stream, size):
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
def _stream(file: Path, name: str) -> Iterator[tuple[Any, int]]:
    """Open an npy file or a member of an npz archive; yield the stream and its length."""
    if not file.is_file():
        raise InputError(f"{file} is missing")
    if file.suffix not in NUMPY:
        with refusing_broken(file, "an npy file of plain numbers"), file.open("rb") as stream:
            _check_total(file.stat().st_size, file, MAX_ROWS_BYTES)
            yield stream, file.stat().st_size
        return
    with refusing_broken(file, "an npz archive of plain numbers"), zipfile.ZipFile(file) as archive:
        _choose(file, {stored.removesuffix(".npy") for stored in archive.namelist()}, [name], ())
        member = archive.getinfo(f"{name}.npy")
        _check_total(member.file_size, file, MAX_ROWS_BYTES)
        with archive.open(member) as stream:
            yield stream, member.file_size


def unpacked(file: Path, most: int) -> bytes:
    """Return the text in a gzip file, or the only one in a zip archive.

    Raises:
        InputError: A broken file, none or several texts in an archive, or a text of more than `most` bytes.
    """
    kind = "a gzip file" if file.suffix.lower() == ".gz" else "a zip archive"
    with refusing_broken(file, kind), file.open("rb") as stream:
        if file.suffix.lower() == ".gz":
            content = gzip.GzipFile(fileobj=stream).read(most + 1)
        else:
            with zipfile.ZipFile(stream) as archive, archive.open(_only_text(archive.namelist())) as member:
                content = member.read(most + 1)
        if len(content) > most:
            raise InputError(f"it unpacks to more than {most} bytes; split the table")
        return content


def _only_text(names: Sequence[str]) -> str:
    texts = [n for n in names if n.lower().endswith((".csv", ".tsv", ".txt")) and not n.startswith("__MACOSX")]
    tables = [name for name in texts if not name.lower().endswith(".txt")] or texts  # beside a readme
    if len(tables) != 1:
        raise InputError(f"it holds {len(tables)} tables ({listed(names)}); unpack it and name the one to read")
    return tables[0]


@contextmanager
def refusing_broken(file: object, kind: str) -> Iterator[None]:
    """Turn exceptions on a broken file, or on any source of data, into an InputError with its expected kind."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{file}: {error}" if str(file) not in str(error) else str(error)) from None
    except Exception as error:  # readers of files raise exceptions of many types
        raise InputError(f"{file} is not {kind} ({error})") from None


def _choose(file: Path, stored: set[str], needed: Sequence[str], optional: Sequence[str]) -> list[str]:
    missing = [name for name in needed if name not in stored]
    if missing:
        held = listed(sorted(stored)) or "nothing"
        raise InputError(f"{file} lacks {', '.join(missing)}; it must hold {', '.join(needed)}, and holds {held}")
    return [*needed, *(name for name in optional if name in stored)]


def _check_total(total: int, file: Path, most: int = MAX_STORED_BYTES) -> None:
    """Refuse arrays that unpack to far more than the size of the file, or exceed any memory."""
    most = max(MAX_UNPACKED_BYTES, min(file.stat().st_size, most))
    if total > most:
        raise InputError(f"it unpacks to {total} bytes; at most {most} are read, so split the data")


def _header(stream: Any, name: str, size: int, kinds: str = NUMBERS) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order and type of an array, once the stream is as long as the header claims."""
    readers = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}
    shape, by_columns, dtype = readers[read_magic(stream)](stream)
    if dtype.kind not in kinds:
        raise ValueError(f"{name} holds {dtype}, expected numbers")
    if math.prod(shape) * dtype.itemsize != size - stream.tell():
        raise ValueError(f"{name} does not hold the {shape} numbers that it claims")
    return shape, by_columns, dtype


def _is_hdf5(file: Path) -> bool:
    """Return True for the suffixes of HDF5, and for MATLAB files of version 7.3."""
    if file.suffix not in MATLAB:
        return file.suffix in HDF5
    with file.open("rb") as stream:
        return stream.read(len(MATLAB_HDF5[0])).startswith(MATLAB_HDF5)


def _in_hdf5(content: Any, name: str) -> Stored:
    """Find a dataset of an HDF5 file. Links to other files are refused, because HDF5 follows them silently."""
    import h5py

    def is_own(owner: Any, key: str, kind: type) -> bool:
        return isinstance(owner.get(key, getlink=True), h5py.HardLink) and isinstance(owner[key], kind)

    owner, key = content, name
    if is_own(content, name, h5py.Group) and {"type", "value"} <= set(content[name]):  # as Octave saves variables
        owner, key = content[name], "value"
    is_inside = is_own(owner, key, h5py.Dataset) and not (owner[key].is_virtual or owner[key].external)
    dtype: Any = owner[key].dtype if is_inside else np.dtype(object)
    if dtype.names == ("real", "imag") and dtype[0] == dtype[1] and dtype[0].kind == "f" and dtype.itemsize in (8, 16):
        dtype = np.dtype(f"{dtype[0].byteorder}c{dtype.itemsize}")  # as MATLAB saves complex numbers
    if dtype.kind not in NUMBERS:
        raise ValueError(f"{name} is no array of numbers in this file")
    return math.prod(owner[key].shape) * dtype.itemsize, lambda: np.asarray(owner[key][()]).view(dtype)
