"""Reader of ray paths (`paths.npz`): spectra computed from traced paths by the array equations."""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.angles import AngularGrid, to_angles
from swiftwrf.arrays import PlanarArray
from swiftwrf.data.files import FARTHEST, MOST_PIXELS, sha256
from swiftwrf.data.formats.base import SPECTRA_FORMATS, Format
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.data.splits import read_split, split_names
from swiftwrf.errors import InputError

ARRAY_SIDE = 4
GRID = AngularGrid.hemisphere(90, 360)
NAMES = (
    "transmitter_position",
    "receiver_position",
    "path_count",
    "last_point",
    "gain",
    "line_of_sight",
    "frequency_hz",
)
CARRIERS_HZ = (1e6, 1e13)
NEAREST = 1e-9  # [m]: closer points are one
LARGEST_GAIN = 1e100  # sums of larger ones overflow
MOST_BYTES = 2**30  # unpacked
# what zipfile, zlib and NumPy raise on broken archives
BROKEN = (
    OSError,
    EOFError,
    zipfile.BadZipFile,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    SyntaxError,
    RuntimeError,
    RecursionError,
    MemoryError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    lzma.LZMAError,
)


@SPECTRA_FORMATS.register("paths", meaning="ray paths in paths.npz")
class Paths(Format[Spectra]):
    """Traced paths, turned into spectra."""

    def recognises(self, path: Path) -> bool:
        return (path / "paths.npz").is_file()

    def read(self, path: Path) -> Spectra:
        return load_paths(path)


def load_paths(folder: Path, grid: AngularGrid = GRID) -> Spectra:
    """Spectra of a 4 x 4 array at half a wavelength, lying level at each receiver (array axes are world axes).

    The array sees the upper half space and folds what comes from below.

    Raises:
        InputError: an array that is missing, of the wrong length or not finite; a receiver without a path; a file that
            is not an npz archive or holds pickled objects.
    """
    file = folder / "paths.npz"
    arrays = _read(file)
    transmitter, receiver = arrays["transmitter_position"], arrays["receiver_position"]
    count = arrays["path_count"]
    owner = torch.repeat_interleave(torch.arange(len(count)), count)
    offset = arrays["last_point"] - receiver[owner]
    direction = offset / offset.norm(dim=1, keepdim=True)
    array = PlanarArray.square(ARRAY_SIDE, float(arrays["frequency_hz"]))
    moving: Moving = "receiver" if len(receiver.unique(dim=0)) >= len(transmitter.unique(dim=0)) else "transmitter"
    fixed = transmitter if moving == "receiver" else receiver
    return Spectra(
        name=folder.resolve().name,
        position=receiver if moving == "receiver" else transmitter,
        spectrum=array.spectrum(array.channel(direction, arrays["gain"], owner, len(count)), grid),
        grid=grid,
        label=torch.stack(to_angles(transmitter - receiver), dim=-1),
        line_of_sight=arrays["line_of_sight"],
        moving=moving,
        index=torch.arange(len(count)),
        named_splits={name: read_split(folder, name, len(count), first=1) for name in split_names(folder)},
        array=array,
        source={f.name: sha256(f) for f in [file, *sorted(folder.glob("*_index*.txt"))]},
        fixed_position=fixed[0].double() if len(fixed.unique(dim=0)) == 1 else None,
        rotation=torch.eye(3, dtype=torch.float64),
    )


def _read(file: Path) -> dict[str, Tensor]:
    """The arrays, of fitting shapes, in double precision."""
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(file) as archive:
            missing = [name for name in NAMES if f"{name}.npy" not in archive.namelist()]
            if missing:
                raise InputError(f"{file} lacks {', '.join(missing)}; it must hold {', '.join(NAMES)}")
            members = [archive.getinfo(f"{name}.npy") for name in NAMES]
            if (total := sum(member.file_size for member in members)) > MOST_BYTES:
                raise InputError(f"{file} unpacks to {total} bytes; at most {MOST_BYTES} are read, so split the data")
            for name, member in zip(NAMES, members, strict=True):
                arrays[name] = _read_array(archive, member)
    except InputError as error:
        raise InputError(f"{file}: {error}" if str(file) not in str(error) else str(error)) from None
    except BROKEN as error:
        raise InputError(f"{file} is not an npz archive of plain numbers ({error})") from None
    return _checked(file, arrays)


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array; what its header claims must be what lies behind it, before memory is taken for it."""
    with archive.open(member) as stream:
        readers = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}
        shape, by_columns, dtype = readers[read_magic(stream)](stream)
        if dtype.kind not in "biufc":
            raise ValueError(f"{member.filename} holds {dtype}, expected numbers")
        if math.prod(shape) * dtype.itemsize != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} does not hold the {shape} numbers that it claims")
        return np.frombuffer(stream.read(), dtype).reshape(shape, order="F" if by_columns else "C")


def _checked(file: Path, arrays: dict[str, NDArray[Any]]) -> dict[str, Tensor]:
    count = arrays["path_count"]
    if count.ndim != 1 or count.dtype.kind not in "iu":
        raise InputError(
            f"{file}: path_count must be one whole number a receiver, got {count.dtype} of shape {count.shape}"
        )
    n = len(count)
    if n == 0 or int(count.min()) < 1:
        raise InputError(f"{file}: every receiver needs at least one path; leave out those without")
    if n * GRID.n_elevation * GRID.n_azimuth > MOST_PIXELS:
        raise InputError(
            f"{file} has {n} receivers, whose spectra would have more than {MOST_PIXELS:.3g} pixels; take fewer"
        )
    n_paths = sum(count.tolist())
    shapes = {
        "transmitter_position": (n, 3),
        "receiver_position": (n, 3),
        "path_count": (n,),
        "last_point": (n_paths, 3),
        "gain": (n_paths,),
        "line_of_sight": (n,),
        "frequency_hz": (),
    }
    tensors = {}
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape:
            raise InputError(
                f"{file}: {name} has shape {array.shape}, but path_count ({n} receivers, {n_paths} paths) calls for {shape}"
            )
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            raise InputError(f"{file}: {name} holds a value that is not finite at row {bad[0, :1].tolist()}")
        if array.dtype.kind == "c" and name != "gain":
            raise InputError(f"{file}: {name} holds complex numbers, expected real ones")
        kind = {"gain": np.complex128, "path_count": np.int64, "line_of_sight": np.bool_}.get(name, np.float64)
        tensors[name] = torch.from_numpy(array.astype(kind))
    _check_physics(file, tensors)
    return tensors


def _check_physics(file: Path, arrays: dict[str, Tensor]) -> None:
    """What would give spectra or labels that say nothing."""
    low, high = CARRIERS_HZ
    if not low <= float(arrays["frequency_hz"]) <= high:
        raise InputError(
            f"{file}: frequency_hz is {float(arrays['frequency_hz'])}; expected the carrier in Hz, {low:g} to {high:g}"
        )
    for name in ("transmitter_position", "receiver_position", "last_point"):
        if float(arrays[name].abs().max()) > FARTHEST:
            raise InputError(
                f"{file}: {name} holds a coordinate beyond {FARTHEST:g} m; give metres from a nearer origin"
            )
    receiver = arrays["receiver_position"]
    same = ((arrays["transmitter_position"] - receiver).norm(dim=1) < NEAREST).nonzero()
    if len(same):
        raise InputError(f"{file}: transmitter and receiver of row {int(same[0])} are at one place; leave it out")
    if float(arrays["gain"].abs().max()) > LARGEST_GAIN:
        raise InputError(f"{file}: gain holds a value beyond {LARGEST_GAIN:g}; give amplitudes")
    owner = torch.arange(len(receiver)).repeat_interleave(arrays["path_count"])
    none = ((arrays["last_point"] - receiver[owner]).norm(dim=1) < NEAREST).nonzero()
    if len(none):
        raise InputError(
            f"{file}: last_point of path {int(none[0])} is the receiver itself, so the path comes from no direction"
        )
    heard = torch.zeros(len(receiver), dtype=torch.bool).index_put((owner[arrays["gain"] != 0],), torch.tensor(True))
    if not bool(heard.all()):
        raise InputError(
            f"{file}: receiver {int((~heard).nonzero()[0])} has no path with a gain other than 0; leave it out"
        )
