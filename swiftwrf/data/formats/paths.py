"""Reader of ray paths (`paths.npz`): spectra computed from traced paths by the array equations.

For N pairs of positions the archive has `transmitter_position` and `receiver_position` (N, 3) [m], `path_count` (N,),
`line_of_sight` (N,) and `frequency_hz`. For the paths of all pairs in order it has

- `last_point` (sum, 3): point from which the path reaches the receiver [m],
- `gain` (sum,): complex gain with the phase of the whole length,
- `length` (sum,): optional [m]. Several subcarriers need it, unless the amplitudes are those of free space.

The array lies level at each receiver. `swiftwrf scenes` writes such folders.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.data.archives import array_names, read_arrays
from swiftwrf.data.files import check_carrier, digests
from swiftwrf.data.formats.base import SPECTRA_FORMATS, Format, ReadOptions
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import read_splits
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions, to_tensor

SHAPES = {  # of n receivers and P paths
    "transmitter_position": ("n", 3),
    "receiver_position": ("n", 3),
    "path_count": ("n",),
    "last_point": ("P", 3),
    "gain": ("P",),
    "line_of_sight": ("n",),
    "frequency_hz": (),
}
LENGTH = "length"  # of each path [m], optional
TYPES = {"gain": torch.complex128, "path_count": torch.int64, "line_of_sight": torch.bool}  # others: float64
MIN_DISTANCE_M = 1e-9  # between two points
MAX_GAIN = 1e100  # sums of larger ones overflow


@SPECTRA_FORMATS.register("paths")
class PathArchive(Format[Spectra]):
    """Traced paths, from which spectra are computed."""

    takes = frozenset({"array", "grid", "subcarriers", "bandwidth"})

    def recognises(self, path: Path) -> bool:
        return (path / "paths.npz").is_file() or (path.suffix == ".npz" and "path_count" in array_names(path))

    def read(self, path: Path, options: ReadOptions) -> Spectra:
        file = path if path.is_file() else path / "paths.npz"
        paths = read_paths(file)
        return paths.spectra(
            file.parent.resolve().name,
            options.array,
            options.grid,
            subcarriers=options.subcarriers,
            bandwidth_hz=options.bandwidth,
            named_splits=read_splits(file.parent, len(paths.count), first=1),
            source=digests([file], file.parent),
        )


def read_paths(source: Path) -> PropagationPaths:
    """Return the paths in a paths.npz, or in a folder with one.

    Raises:
        InputError: No paths, arrays that do not match, or values that are not usable.
    """
    arrays = _read(source / "paths.npz" if source.is_dir() else source)
    receiver, count = arrays["receiver_position"], arrays["path_count"]
    offset = arrays["last_point"] - receiver.repeat_interleave(count, dim=0)
    return PropagationPaths(
        transmitter=arrays["transmitter_position"],
        receiver=receiver,
        count=count,
        direction=offset / offset.norm(dim=1, keepdim=True),
        gain=arrays["gain"],
        line_of_sight=arrays["line_of_sight"],
        frequency_hz=float(arrays["frequency_hz"]),
        length=arrays.get(LENGTH),
    )


def _read(file: Path) -> dict[str, Tensor]:
    """Return the checked arrays by name."""
    if not file.is_file():
        raise InputError(f"{file} does not exist; expected ray paths")
    arrays = read_arrays(file, list(SHAPES), [LENGTH])
    count = arrays["path_count"]
    if count.ndim != 1 or count.dtype.kind not in "iu":
        raise InputError(
            f"{file}: path_count must be one whole number a receiver, got {count.dtype} of shape {count.shape}"
        )
    n = len(count)
    if n == 0 or int(count.min()) < 1:
        raise InputError(f"{file}: every receiver needs at least one path; leave out those without")
    sizes = {"n": n, "P": sum(count.tolist())}
    tensors = {}
    for name, symbols in (SHAPES | dict.fromkeys({LENGTH} & {*arrays}, ("P",))).items():
        shape = tuple(sizes.get(str(symbol), symbol) for symbol in symbols)
        tensors[name] = to_tensor(f"{file}: {name}", arrays[name], TYPES.get(name, torch.float64), shape)
    _check_physics(file, tensors)
    return tensors


def _check_physics(file: Path, arrays: dict[str, Tensor]) -> None:
    """Refuse values from which no spectra or labels follow."""
    check_carrier(file, float(arrays["frequency_hz"]))
    for name in ("transmitter_position", "receiver_position", "last_point"):
        check_positions(arrays[name], f"{file}: {name}")
    receiver = arrays["receiver_position"]
    same = ((arrays["transmitter_position"] - receiver).norm(dim=1) < MIN_DISTANCE_M).nonzero()
    if len(same):
        raise InputError(f"{file}: transmitter and receiver of row {int(same[0])} are at one place; leave it out")
    if float(arrays["gain"].abs().max()) > MAX_GAIN:
        raise InputError(f"{file}: gain holds a value beyond {MAX_GAIN:g}; give amplitudes")
    owner = torch.arange(len(receiver)).repeat_interleave(arrays["path_count"])
    none = ((arrays["last_point"] - receiver[owner]).norm(dim=1) < MIN_DISTANCE_M).nonzero()
    if len(none):
        raise InputError(
            f"{file}: last_point of path {int(none[0])} is the receiver itself, so the path comes from no direction"
        )
    silent = ~torch.isin(torch.arange(len(receiver)), owner[arrays["gain"] != 0])
    if bool(silent.any()):
        raise InputError(
            f"{file}: receiver {int(silent.nonzero()[0])} has no path with a gain other than 0; leave it out"
        )
