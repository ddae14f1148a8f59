"""Reader of ray paths (`paths.npz`): spectra computed from traced paths by the array equations."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from swiftwrf.angles import AngularGrid, to_angles
from swiftwrf.arrays import PlanarArray
from swiftwrf.data.files import sha256
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
    count = arrays["path_count"].long()
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
        line_of_sight=arrays["line_of_sight"].bool(),
        moving=moving,
        index=torch.arange(len(count)),
        named_splits={name: read_split(folder, name, len(count), first=1) for name in split_names(folder)},
        array=array,
        source={f.name: sha256(f) for f in [file, *sorted(folder.glob("*_index*.txt"))]},
        fixed_position=fixed[0].double() if len(fixed.unique(dim=0)) == 1 else None,
        rotation=torch.eye(3, dtype=torch.float64),
    )


def _read(file: Path) -> dict[str, Tensor]:
    try:
        with np.load(file, allow_pickle=False) as archive:
            missing = [name for name in NAMES if name not in archive]
            if missing:
                raise InputError(f"{file} lacks {', '.join(missing)}; it must hold {', '.join(NAMES)}")
            arrays = {name: torch.from_numpy(np.asarray(archive[name])) for name in NAMES}
    except (OSError, EOFError, zipfile.BadZipFile, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file} is not an npz archive of plain numbers ({error})") from None
    _check(file, arrays)
    return arrays


def _check(file: Path, arrays: dict[str, Tensor]) -> None:
    n, n_paths = len(arrays["path_count"]), int(arrays["path_count"].sum())
    shapes = {
        "transmitter_position": (n, 3),
        "receiver_position": (n, 3),
        "path_count": (n,),
        "last_point": (n_paths, 3),
        "gain": (n_paths,),
        "line_of_sight": (n,),
        "frequency_hz": (),
    }
    for name, shape in shapes.items():
        if tuple(arrays[name].shape) != shape:
            raise InputError(
                f"{file}: {name} has shape {tuple(arrays[name].shape)}, but path_count ({n} receivers, {n_paths} paths) "
                f"calls for {shape}"
            )
        bad = (~arrays[name].isfinite()).nonzero()
        if len(bad):
            raise InputError(f"{file}: {name} holds a value that is not finite at row {bad[0, :1].tolist()}")
    if n == 0 or int(arrays["path_count"].min()) < 1:
        raise InputError(f"{file}: every receiver needs at least one path; leave out those without")
    if float(arrays["frequency_hz"]) <= 0:
        raise InputError(f"{file}: frequency_hz is {float(arrays['frequency_hz'])}; expected the carrier in Hz")
