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
from swiftwrf.data.formats.base import Format, ReadOptions
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import read_splits
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions, to_tensor

POSITIONS = ("transmitter_position", "receiver_position", "last_point")
NEEDED = (*POSITIONS, "path_count", "gain", "line_of_sight", "frequency_hz")


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


def read_paths(source: Path, min_distance_m: float = 1e-9, max_gain: float = 1e100) -> PropagationPaths:
    """Return the paths in a paths.npz, or in a folder with one.

    Closer points are one place, and sums of larger gains overflow.

    Raises:
        InputError: No paths, arrays that do not match, or values from which no spectra or labels follow.
    """
    file = source / "paths.npz" if source.is_dir() else source
    if not file.is_file():
        raise InputError(f"{file} does not exist; expected ray paths")
    arrays = read_arrays(file, NEEDED, ["length"])

    def checked(name: str, dtype: torch.dtype, *shape: int | None) -> Tensor:
        return to_tensor(f"{file}: {name}", arrays[name], dtype, shape)

    count = checked("path_count", torch.int64, None)
    if not len(count) or int(count.min()) < 1:
        raise InputError(f"{file}: every receiver needs at least one path; leave out those without")
    n, n_paths = len(count), sum(count.tolist())
    transmitter, receiver, last = (
        check_positions(arrays[name], f"{file}: {name}", (rows, 3))
        for name, rows in zip(POSITIONS, (n, n, n_paths), strict=True)
    )
    gain, frequency_hz = checked("gain", torch.complex128, n_paths), float(checked("frequency_hz", torch.float64))
    check_carrier(file, frequency_hz)
    same = ((transmitter - receiver).norm(dim=1) < min_distance_m).nonzero()
    if len(same):
        raise InputError(f"{file}: transmitter and receiver of row {int(same[0])} are at one place; leave it out")
    if float(gain.abs().max()) > max_gain:
        raise InputError(f"{file}: gain holds a value beyond {max_gain:g}; give amplitudes")
    owner = torch.arange(n).repeat_interleave(count)
    offset = last - receiver[owner]
    distance = offset.norm(dim=1, keepdim=True)
    if len(none := (distance[:, 0] < min_distance_m).nonzero()):
        raise InputError(
            f"{file}: last_point of path {int(none[0])} is the receiver itself, so the path comes from no direction"
        )
    silent = ~torch.isin(torch.arange(n), owner[gain != 0])
    if bool(silent.any()):
        raise InputError(
            f"{file}: receiver {int(silent.nonzero()[0])} has no path with a gain other than 0; leave it out"
        )
    return PropagationPaths(
        transmitter=transmitter,
        receiver=receiver,
        count=count,
        direction=offset / distance,
        gain=gain,
        line_of_sight=checked("line_of_sight", torch.bool, n),
        frequency_hz=frequency_hz,
        length=checked("length", torch.float64, n_paths) if "length" in arrays else None,
    )
