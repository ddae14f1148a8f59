"""Reader of array snapshots: snapshots.npz, snapshots.h5 or snapshots.mat with the complex channel of each element."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.archives import ARCHIVES, Arrays, array_names, read_arrays
from swiftwrf.data.files import digests
from swiftwrf.data.formats.array_description import POSE, array_of, pose_of
from swiftwrf.data.formats.array_stations import described_stations, of_station, stations_of_arrays
from swiftwrf.data.formats.base import Format, ReadOptions, station
from swiftwrf.data.formats.channel_parts import PAIRS, channel_parts, joined, paired
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.splits import read_splits
from swiftwrf.errors import InputError, listed, ranges
from swiftwrf.positions import check_positions, to_tensor

REQUIRED_ARRAYS = ("csi", "position", "frequency_hz", "array_position")
OPTIONAL = (*POSE, "element_position", "rows", "columns", "spacing_m", "line_of_sight", "time")
SCALARS = ("frequency_hz", "rows", "columns", "spacing_m")
PER_ROW = ("csi", "position", "line_of_sight", "time")
VECTORS = ("array_position", *POSE, "line_of_sight", "time", "frequency_hz")


class SnapshotArrays(Format[Snapshots]):
    """Arrays by name, one row a position of the transmitter."""

    takes = frozenset({"arrays", "beamformer", "grid", "every", "station", "drop_null", "drop_elements", "round_trip"})

    def recognises(self, path: Path) -> bool:
        return _file(path) is not None

    def stations(self, path: Path) -> list[str]:
        file = _file(path) or path
        if (described := described_stations(file)) is None and {"position", "array_position"} <= array_names(file):
            described = stations_of_arrays(file, read_arrays(file, ["position", "array_position"], POSE))
        return [] if described is None else [name for name, _ in described[1]]

    def read(self, path: Path, options: ReadOptions) -> Snapshots:
        file, stated = _file(path) or path, options.arrays or {}
        name = {array: stated.get(array, array) for array in (*REQUIRED_ARRAYS, *OPTIONAL)}
        if file.is_dir() or stated.keys() - name.keys():
            raise InputError(f"arrays takes {', '.join(name)} of a file that is named, got {listed(stated)} of {file}")
        described = described_stations(file)
        required = ("csi", "position") if described is not None else REQUIRED_ARRAYS
        names = array_names(file)
        halves = None if name["csi"] in names else channel_parts(names)
        needed = [name[array] for array in dict.fromkeys((*required, *stated)) if array != "csi" or halves is None]
        stored = read_arrays(
            file, [*needed, *(halves or ())], [name[array] for array in OPTIONAL if array not in stated]
        )
        if halves is not None:
            first, second = ((half, stored[half]) for half in halves)
            stored[name["csi"]] = joined(file, first, second)
        arrays = {array: stored[name_in_file] for array, name_in_file in name.items() if name_in_file in stored}
        described = described or stations_of_arrays(file, arrays)
        if described is None and options.station is not None:
            raise InputError(f"{file} holds one array; leave station out")
        label = file.stem if file.stem != "snapshots" else None
        if described is None:
            return snapshots_of(file, arrays, options, [file], label)
        beside, parts = described
        number = station(f"{beside} describes {len(parts)} arrays", [part for part, _ in parts], options.station)
        own, received = of_station(file, arrays | parts[number][1], number, len(parts))
        rows = received[:: options.every or 1]
        own = {array: values[rows] if array in PER_ROW else values for array, values in own.items()}
        return snapshots_of(file, own, options, [*dict.fromkeys((file, beside))], label, index=rows.tolist())


def snapshots_of(
    source: Path,
    arrays: Arrays,
    options: ReadOptions,
    files: list[Path],
    name: str | None,
    notes: tuple[str, ...] = (),
    index: list[int] | None = None,
) -> Snapshots:
    """Return the snapshots in arrays of the names of snapshots.npz.

    Args:
        source: File or folder of the arrays, for messages.
        arrays: All of `REQUIRED_ARRAYS`, and some of `OPTIONAL`.
        options: What the user states.
        files: Files that were read, in the folder of the splits.
        name: Name of the data set. Defaults to that of the folder.
        notes: What the user has to know about the arrays.
        index: Numbers of the measurements, if the arrays hold some of them.
    """
    # scalars and vectors as such, which MATLAB stores as matrices
    vectors = {name: arrays[name] for name in VECTORS if name in arrays and arrays[name].ndim == 2}
    arrays = arrays | {name: values.reshape(-1) for name, values in vectors.items() if 1 in values.shape}
    arrays |= {name: arrays[name].reshape(()) for name in SCALARS if name in arrays and arrays[name].size == 1}
    arrays, reversed_axes = _turned_round(arrays)
    arrays, polarisations = _polarisations(source, arrays)
    given, frequency, doubts = arrays["frequency_hz"], None, tuple[str, ...]()
    if given.ndim == 1 and len(given) == len(arrays["position"]) and arrays["csi"].shape[1:2] != given.shape:
        doubts, given = _carrier_notes(given), np.asarray(given.mean())  # each row has its carrier
        arrays |= {"frequency_hz": given}
    if given.ndim == 1 and arrays["csi"].ndim == 3:
        arrays |= {"frequency_hz": given.mean()}
    position, array = check_positions(arrays["position"], f"{source}: position"), array_of(source, arrays)
    n, folder, pose = len(position), files[0].parent, pose_of(source, arrays)
    apart = array.spacing_wavelengths
    if apart > 2 and "element_position" in arrays and 0.2 <= apart * array.wavelength <= 1.0:
        doubts = (
            *doubts,
            f"elements are {apart * array.wavelength:.3g} m, {apart:.3g} wavelengths apart; if element_position is in "
            f"wavelengths, multiply it by {array.wavelength:.4g} m",
        )
    pairs = paired(arrays["csi"], len(array.element))
    if pairs is not None:
        arrays |= {"csi": pairs}
    step = 1 if index is not None or options.every is None else options.every
    raw = _channel(source, arrays["csi"], n, len(array.element))
    channel, kept, elements, missing = measured(source, raw, options.drop_null, options.drop_elements)
    channel, array = _scaled(source, channel), array.subset(elements)
    if given.ndim == 1:
        frequency = to_tensor(f"{source}: frequency_hz", given, torch.float64, (raw.shape[1],))[kept]
        frequency = 2 * frequency if options.round_trip else frequency
    if options.round_trip:  # phases change as those of half the wavelength
        array = PlanarArray(array.element, array.wavelength / 2)
        missing = (*missing, "phases are those of the way there and back, so half the wavelength counts")
    if bool((position == torch.tensor(pose.position, dtype=torch.float64)).all(dim=1).any()):
        raise InputError(f"{source} has a position equal to array_position, from which there is no direction")
    data = Snapshots(
        channel,
        position,
        array=array,
        pose=pose,
        name=name or folder.resolve().name,
        index=index,
        named_splits=read_splits(folder, n, first=1) if index is None and step == 1 else None,
        source=digests(files, folder),
        line_of_sight=arrays.get("line_of_sight"),
        time=arrays.get("time"),
        frequency_hz=frequency,
        notes=(*notes, *reversed_axes, *polarisations, *[PAIRS] * (pairs is not None), *doubts, *missing),
    )
    return data if step == 1 else data.subset(torch.arange(0, n, step))


def _file(path: Path) -> Path | None:
    if path.is_dir():
        usual = [path / f"snapshots{suffix}" for suffix in ARCHIVES if (path / f"snapshots{suffix}").is_file()]
        others = [file for file in path.iterdir() if file.suffix in ARCHIVES and file.is_file()]
        return usual[0] if usual else _file(others[0]) if len(others) == 1 else None
    names = array_names(path) if path.suffix in ARCHIVES else set()
    return path if "csi" in names or channel_parts(names) else None


def _carrier_notes(carrier: NDArray[Any]) -> tuple[str, ...]:
    """Return a note on rows with different carriers [Hz], none if they have one."""
    low, high, mean = carrier.min() / 1e9, carrier.max() / 1e9, carrier.mean() / 1e9
    if low == high:
        return ()
    off = max(high - mean, mean - low) / mean
    return (
        f"each row has its carrier, {low:.4g} to {high:.4g} GHz; the array counts at their mean, {mean:.4g} GHz, by which "
        f"phases are up to {off:.1%} off",
    )


def _turned_round(arrays: Arrays) -> tuple[Arrays, tuple[str, ...]]:
    """Return the arrays with the positions as first axis, as MATLAB and Octave store them last in HDF5, and a note."""
    position, csi = arrays["position"], arrays["csi"]
    if position.ndim != 2 or (position.shape[1] == 3 and csi.shape[:1] == position.shape[:1]):
        return arrays, ()
    position = position if position.shape[1] == 3 else position.T
    if position.shape[1] != 3 or csi.shape[-1:] != position.shape[:1]:
        return arrays, ()  # refused with its shape
    turned = {"position": position, "csi": csi.T}
    element = arrays.get("element_position")
    if element is not None and element.ndim == 2 and element.shape[1] == csi.shape[0]:
        turned["element_position"] = element.T
    return arrays | turned, ("axes are in reverse order, as MATLAB and Octave write HDF5; they are turned round",)


def _polarisations(source: Path, arrays: Arrays) -> tuple[Arrays, tuple[str, ...]]:
    """Return the arrays with elements at one place, which have different polarisations, as snapshots of one element."""
    element, csi, carrier = arrays.get("element_position"), arrays["csi"], arrays["frequency_hz"]
    if element is None or element.ndim != 2 or csi.ndim < 2 or csi.shape[-1] != len(element):
        return arrays, ()  # refused with its shape
    # 1 micrometre is far below any distance of elements
    place, count = np.unique(np.round(element / 1e-6), axis=0, return_inverse=True, return_counts=True)[1:]
    ports = int(count.max(initial=1))
    if ports == 1:
        return arrays, ()
    if bool((count != ports).any()) or len(count) < 2:
        raise InputError(
            f"{source}: element_position has {int(count.min())} to {ports} elements at one place; expected as many "
            "polarisations at each place, so leave out the other elements"
        )
    order = np.argsort(place.reshape(-1), kind="stable").reshape(-1, ports).T  # elements of each polarisation
    order = order[:, np.argsort(order[0])]
    split = np.concatenate([csi.reshape(len(csi), -1, len(element))[..., elements] for elements in order], axis=1)
    arrays |= {"csi": split, "element_position": element[order[0]]}
    if carrier.ndim == 1 and csi.ndim == 3:
        arrays |= {"frequency_hz": np.tile(carrier, ports)}
    return arrays, (
        f"{ports} elements lie at each place, as of {ports} polarisations: each polarisation is a snapshot",
    )


def _channel(file: Path, csi: NDArray[np.generic], n: int, elements: int) -> Tensor:
    """Return channels, complex128 (n, S, K)."""
    if csi.dtype.kind != "c":
        raise InputError(
            f"{file}: csi must hold complex numbers, or pairs of real ones on a last axis of {2 * elements}, got "
            f"{csi.dtype} of shape {csi.shape}"
        )
    if csi.ndim == 3 and csi.shape[0] == n and csi.shape[2] != elements and csi.shape[1] == elements:
        raise InputError(
            f"{file}: csi has shape {csi.shape} with its {elements} elements in the middle; they must be the last axis, so "
            "give csi.transpose(0, 2, 1), in MATLAB permute(csi, [1 3 2])"
        )
    if (remedy := _as_one_axis(csi.shape, elements)) and csi.shape[0] == n:
        raise InputError(
            f"{file}: csi has shape {csi.shape}, but needs its {elements} elements on one axis, the last; {remedy}"
        )
    if csi.ndim not in (2, 3) or csi.shape[0] != n or csi.shape[-1] != elements or 0 in csi.shape:
        raise InputError(
            f"{file}: csi must have shape ({n}, [subcarriers or packets,] {elements}) for {n} positions and {elements} "
            f"elements, got {csi.shape}"
        )
    return torch.from_numpy(csi.reshape(n, -1, elements).astype(np.complex128))


def _as_one_axis(shape: tuple[int, ...], elements: int) -> str:
    """Return how to bring elements on two neighbouring axes to the last one, in words. Empty without such axes.

    Example:
        >>> _as_one_axis((140, 4, 4, 57), 16)
        'axes 1 and 2 hold 4 x 4 of them: give csi.reshape(140, 16, 57).transpose(0, 2, 1)'
    """
    for first in range(1, len(shape) - 1):
        if shape[first] * shape[first + 1] == elements and min(shape[first : first + 2]) > 1 and len(shape) <= 4:
            joined = (*shape[:first], elements, *shape[first + 2 :])
            moved = ".transpose(0, 2, 1)" if first == 1 and len(shape) == 4 else ""
            axes = f"axes {first} and {first + 1} hold {shape[first]} x {shape[first + 1]} of them"
            return f"{axes}: give csi.reshape{joined}{moved}"
    return ""


def measured(
    source: Path, channel: Tensor, drop_null: bool = False, drop: Sequence[int] = ()
) -> tuple[Tensor, Tensor, Tensor, tuple[str, ...]]:
    """Return a channel (n, S, K) without what is missing, its snapshots and elements among those given, and notes.

    Missing are values that are 0 or NaN. They become 0, which beamformers do not use.

    Elements to drop, counted from 0, and those without any value are left out. So are snapshots if other rows have fewer of
    them. Null, guard and DC subcarriers hold a constant or nothing: they are the same at every position and element.

    Raises:
        InputError: A position without any value, fewer than 2 elements, or one to leave out that does not exist.

    Example:
        >>> channel = torch.randn(5, 4, 3, dtype=torch.complex64)
        >>> channel[:, 2] = 12 + 3j
        >>> measured(Path("a"), channel, drop_null=True)[1:]
        (tensor([0, 1, 3]), tensor([0, 1, 2]), (...are left out (1 of 4, counted from 0): 2',))
    """
    count, elements = channel.shape[1:]
    missing, notes = (channel == 0) | channel.isnan(), []
    channel = channel.masked_fill(missing, 0)
    if lost := missing.all(dim=2).all(dim=1).nonzero()[:, 0].tolist():
        raise InputError(f"{source}: csi of row {lost[0]} has no power; leave it out")
    if beyond := [number for number in drop if not 0 <= number < elements]:
        raise InputError(f"{source} has elements 0 to {elements - 1}, so element {beyond[0]} cannot be left out")
    silent = missing.all(dim=1).all(dim=0)
    used = ~silent
    used[list(drop)] = False
    if int(used.sum()) < 2:
        raise InputError(
            f"{source}: csi has values at {int(used.sum())} elements; expected at least 2 to resolve directions"
        )
    left_out = {"silent (0 or NaN everywhere)": silent.nonzero()[:, 0].tolist(), "to be ignored": sorted(drop)}
    for reason, which in left_out.items():
        if which:
            named = f"element {which[0]} is" if len(which) == 1 else f"elements {ranges(which)} are"
            notes.append(f"{named} {reason} and left out (counted from 0)")
    channel, missing = channel[..., used], missing[..., used]
    empty = missing.all(dim=2)
    kept = torch.ones(count, dtype=torch.bool)
    if bool((empty.any(dim=0) & ~empty.all(dim=0)).any()):  # rows differ in their number of packets
        kept = ~empty.all(dim=0)
        notes.append(f"{int(empty.sum())} of {empty.numel()} snapshots are 0 or NaN at all elements and left out")
    elif len(channel) > 1:
        first = channel[:1, :, :1]
        null = ((channel - first).abs() <= 1e-3 * first.abs()).all(dim=2).all(dim=0)
        if bool(null.any()) and not bool(null.all()):
            kept = ~null if drop_null else kept
            used_how, remedy = (
                ("left out", "") if drop_null else ("used like the others", "; --drop-null leaves them out")
            )
            notes.append(
                f"null subcarriers, the same at every position and element, are {used_how} ({int(null.sum())} of {count}, "
                f"counted from 0): {ranges(null.nonzero()[:, 0].tolist())}{remedy}"
            )
    if n_single := int((missing & ~empty[..., None]).sum()):
        notes.append(f"{n_single} of {missing.numel()} values of single elements are 0 or NaN and not used")
    return channel[:, kept], kept.nonzero()[:, 0], used.nonzero()[:, 0], tuple(notes)


def _scaled(file: Path, channel: Tensor) -> Tensor:
    """Return channels, complex64 (n, S, K), each row scaled to unit mean power, because their unit is arbitrary."""
    total = torch.view_as_real(channel).square().sum(-1).sum(dim=(1, 2), keepdim=True)
    power = total / (channel != 0).sum(dim=(1, 2), keepdim=True)
    beyond = (~((power > 0) & power.isfinite())).flatten().nonzero()
    if len(beyond):
        raise InputError(f"{file}: csi of row {int(beyond[0])} has no power, or more than numbers hold; leave it out")
    return (channel / power.sqrt()).to(torch.complex64)
