"""Reading of measurements as the options of a command line state it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf import AngularGrid, InputError, Rssi, RssiModel, Spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.datasets import DATA_SETS, fetch
from swiftwrf.data.archives import array_header, read_rows
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame
from swiftwrf.data.files import TABLES, read_table, sha256
from swiftwrf.data.formats import SNAPSHOT_FORMATS, SPECTRA_FORMATS, ReadOptions, read
from swiftwrf.data.formats.base import Format
from swiftwrf.data.receivers import spelled_as
from swiftwrf.data.rooms import FILES, Rooms, read_rooms
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.store import Store
from swiftwrf.errors import listed
from swiftwrf.runtime.registry import Registry
from tasks.command_line import reading_options
from tasks.options import (
    READING,
    FindingConfig,
    ReadingConfig,
    ReadingOptions,
    beside,
    by_name,
    pairs,
)
from tasks.terminal import console

ROWS_A_READ = 1024  # of an array that is read


@dataclass(frozen=True)
class Reading:
    """Source of measurements, and the options that its files are read with."""

    source: str  # folder or file
    options: ReadOptions = field(default_factory=ReadOptions)
    reference: str | None = None  # group of RSSI whose offset is 0, None for the most frequent one
    file: Path | None = None  # that states it
    note: str = ""  # on this file

    def read(self, *registries: Registry[Format[Any]]) -> Any:
        """Return the measurements, with a note on the file that states how they are read, and its digest.

        Raises:
            InputError: As `swiftwrf.data.formats.read`.
        """
        data = read(self.source, self.options, *registries)
        if self.file is None:
            return data
        return replace(data, notes=(*data.notes, self.note), source={**data.source, READING: sha256(self.file)})

    def spectra(self) -> Spectra:
        """Return the spectra, or those of array snapshots; see `read`."""
        found: Spectra = self.options.spectra_of(self.read(SPECTRA_FORMATS, SNAPSHOT_FORMATS))
        return found

    def using(self, **options: Any) -> Reading:
        """Return a reading with other options."""
        return replace(self, options=replace(self.options, **options))


def reading(config: ReadingConfig, source: str) -> Reading:
    """Return how a source is read: as options of the command line state, or --read, or the file beside it.

    A name of a public data set becomes its folder, if there is no such file.

    Raises:
        InputError: A data set that cannot be downloaded, or a file of options that cannot be read.
    """
    source = located(source)
    given = config.reading if isinstance(config, FindingConfig) else ReadingOptions()
    if config.read is not None and given.given:
        raise InputError("--read and options of reading exclude each other; leave out one")
    file, note = Path(config.read) if config.read else None, ""
    if file is None and not given.given and isfile(beside(Path(source))):
        file = beside(Path(source))
    if file is not None:
        given = reading_options(file)
        note = f"read as {file} states: {', '.join(f'{name} {value}' for name, value in given.given.items())}"
    column, _, reference = (given.offset_by or "").partition("=")
    options = by_name(given) | {
        "array": _array(given.array),
        "arrays": pairs("arrays", given.arrays, "csi"),
        "columns": pairs("columns", given.columns, "x"),
        "filler": () if given.filler == "none" else given.filler or None,
        "offset_by": column or None,
    }
    return Reading(source, ReadOptions(**options), reference or None, file, note)


def _array(stated: tuple[float, ...] | None) -> PlanarArray | None:
    if stated is None:
        return None
    *sides, spacing, frequency = stated
    rows, columns = (int(side) for side in (sides[0], sides[-1]))
    if rows == columns:
        return PlanarArray.square(rows, frequency, spacing)
    return PlanarArray.grid(rows, columns, spacing, frequency)


def is_table(source: str) -> bool:
    """Return True for a file of a table."""
    return os.path.isfile(source) and Path(source).suffix.lower() in TABLES


def with_groups(how: Reading, offsets: Offsets | None) -> Reading:
    """Return a reading of the groups whose offsets a model knows, if the source is a table with their column."""
    known = offsets is not None and is_table(how.source) and offsets.column in read_table(Path(how.source)).columns
    return how.using(offset_by=offsets.column if known else None)  # type: ignore[union-attr]


def located(source: str) -> str:
    """Return the folder or file of measurements; a name of a public data set becomes its folder, if there is no such file.

    Raises:
        InputError: A data set that cannot be downloaded.
    """
    if os.path.exists(source) or source not in DATA_SETS:
        return source
    found = DATA_SETS[source]
    console.print(f"{source}: licence {found.licence}; {found.citation}")
    return str(fetch(source))


def rooms_beside(
    how: Reading | None, given: str | None, origin: GeodeticOrigin | None, floors: Floors | None
) -> Rooms | None:
    """Return the rooms in a file that the user gives, or in one beside the measurements. None without a file.

    Raises:
        InputError: Rooms that cannot be read.
    """
    found = None if given is None else Path(given)
    if found is None and how is not None:
        folder = Path(how.source) if os.path.isdir(how.source) else Path(how.source).parent
        found = next((folder / name for name in FILES if isfile(folder / name)), None)
    if found is None:
        return None
    frame = PlanFrame() if how is None else PlanFrame(*(getattr(how.options, name) for name in PlanFrame._fields))
    return read_rooms(found, origin, frame, floors)


def offset_notes(data: Rssi) -> list[str]:
    """Return a note on columns that may distinguish devices or channels and are not used, or none."""
    if data.groups is not None or not data.labels:
        return []
    return [
        f"rows differ in {listed(data.labels)}; if swiftwrf inspect finds offsets between them, give it --offset-by COLUMN"
    ]


def observed_spectra(how: Reading, grid: AngularGrid, model: str) -> tuple[Store, Spectra | None]:
    """Read the spectra that a fitted model is applied to: measurements of any format, or a .npy file.

    Returns:
        Spectra, and the measurements that they belong to if positions are known.

    Raises:
        InputError: Spectra that cannot be read, or on another grid.
    """
    known, source = None, how.source
    if not source.endswith(".npy"):
        known = how.spectra()
    elif how.options.given:
        raise InputError(f"{source} holds spectra as they are; {next(iter(how.options.given))} does not apply")
    store = Store(_read_array(Path(source))) if known is None else known.store
    if store.shape[1:] != grid.shape:
        shape, its = (" x ".join(map(str, s)) for s in (store.shape[1:], grid.shape))
        raise InputError(
            f"{source} has spectra of {shape} directions, the {model} was trained on others ({its}); where spectra are "
            f"computed, --grid {' '.join(map(str, grid.shape))} makes them alike"
        )
    if known is not None and known.grid != grid:
        raise InputError(
            f"{source} has as many directions as the {model} was trained on, but others; expected those of {grid}"
        )
    return store, known


def aligned(data: Rssi, model: RssiModel, ignore_others: bool) -> Rssi:
    """Return the data at the receivers of a model, in its order; those that the data lack count as not detecting.

    Names may differ in case, separators or zeros.

    Raises:
        InputError: The data have none of the receivers, or others that are not ignored.
    """
    names, offsets = model.receiver_names, model.offsets
    own, notes = spelled_as(data.receiver_names, names)
    if offsets is not None and data.groups is None:
        notes.append(f"rows count as those of {offsets.column} {offsets.reference}")
    missing, others = [name for name in names if name not in own], [name for name in own if name not in names]
    if len(missing) == len(names):
        raise InputError(
            f"{data.name} has other receivers ({listed(data.receiver_names)}) than the model ({listed(names)}); their names "
            "must be the same"
        )
    if missing:
        notes.append(f"receivers of the model that are missing count as not detecting: {listed(missing)}")
    if others and not ignore_others:
        raise InputError(
            f"{data.name} has receivers that the model does not have ({listed(others)}); leave them out by "
            "--ignore-receivers"
        )
    if others:
        notes.append(f"receivers that the model does not have are not used: {listed(others)}")
    for note in notes:
        console.print(f"{data.name}: {note}")
    columns = [own.index(name) if name in own else len(own) for name in names]  # the last one is of nothing
    rssi = functional.pad(data.rssi_dbm, (0, 1), value=torch.nan)[:, columns]
    position = functional.pad(data.receiver_position, (0, 0, 0, 1), value=torch.nan)[columns]
    return replace(data, rssi_dbm=rssi, receiver_names=names, receiver_position=position, bands=None)


def _read_array(file: Path) -> Tensor:
    """Return the spectra of unknown positions in a .npy file."""
    shape, dtype = array_header(file, "array")
    if len(shape) != 3 or dtype.kind != "f" or not math.prod(shape):
        raise InputError(f"{file} must hold floating-point spectra (n, elevations, azimuths), got {dtype} of {shape}")
    spectrum = torch.cat([torch.from_numpy(some.astype(np.float32)) for some in read_rows(file, "array", ROWS_A_READ)])
    if not bool(((spectrum >= 0) & (spectrum <= 1)).all()):
        raise InputError(f"{file} must hold magnitudes in [0, 1]")
    return spectrum
