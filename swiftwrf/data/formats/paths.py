"""Reader of ray paths (`paths.npz`): spectra computed from traced paths by the array equations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from swiftwrf.data.archives import Arrays, array_names, read_arrays
from swiftwrf.data.files import FARTHEST, check_carrier
from swiftwrf.data.formats.base import SPECTRA_FORMATS, Format
from swiftwrf.data.rays import Rays
from swiftwrf.data.reading import Reading
from swiftwrf.data.spectra import GRID, Spectra, check_pixels
from swiftwrf.data.splits import read_split, split_names
from swiftwrf.errors import InputError

NAMES = (
    "transmitter_position",
    "receiver_position",
    "path_count",
    "last_point",
    "gain",
    "line_of_sight",
    "frequency_hz",
)
NEAREST = 1e-9  # [m]: closer points are one
LARGEST_GAIN = 1e100  # sums of larger ones overflow


@SPECTRA_FORMATS.register("paths")
class Paths(Format[Spectra]):
    """Traced paths, turned into spectra."""

    takes = frozenset({"array", "grid"})

    def recognises(self, path: Path) -> bool:
        return (path / "paths.npz").is_file() or (path.suffix == ".npz" and "path_count" in array_names(path))

    def read(self, path: Path, how: Reading) -> Spectra:
        file = path if path.is_file() else path / "paths.npz"
        folder, rays = file.parent, _read(file, how)
        files = [file, *sorted(folder.glob("*_index*.txt"))]
        splits = {name: read_split(folder, name, len(rays.count), first=1) for name in split_names(folder)}
        return rays.spectra(folder, how, files, named_splits=splits)


def _read(file: Path, how: Reading) -> Rays:
    """The paths, in double precision.

    Raises:
        InputError: an array that is missing, of the wrong length or not finite; a receiver without a path; a file that
            is not an npz archive or holds pickled objects.
    """
    arrays = _checked(file, read_arrays(file, NAMES), how)
    receiver, count = arrays["receiver_position"], arrays["path_count"]
    offset = arrays["last_point"] - receiver[torch.arange(len(count)).repeat_interleave(count)]
    return Rays(
        transmitter=arrays["transmitter_position"],
        receiver=receiver,
        count=count,
        direction=offset / offset.norm(dim=1, keepdim=True),
        gain=arrays["gain"],
        line_of_sight=arrays["line_of_sight"],
        index=torch.arange(len(count)),
        frequency_hz=float(arrays["frequency_hz"]),
    )


def _checked(file: Path, arrays: Arrays, how: Reading) -> dict[str, Tensor]:
    count = arrays["path_count"]
    if count.ndim != 1 or count.dtype.kind not in "iu":
        raise InputError(
            f"{file}: path_count must be one whole number a receiver, got {count.dtype} of shape {count.shape}"
        )
    n = len(count)
    if n == 0 or int(count.min()) < 1:
        raise InputError(f"{file}: every receiver needs at least one path; leave out those without")
    check_pixels(str(file), n, how.grid or GRID)
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
    check_carrier(file, float(arrays["frequency_hz"]))
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
