"""Reading of measurements as the options of a command line state it."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf import AngularGrid, InputError, Rssi, RssiModel, Spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.datasets import DATA_SETS, fetch
from swiftwrf.data.archives import array_header, read_rows
from swiftwrf.data.files import TABLES, read_table
from swiftwrf.data.formats import RSSI_FORMATS, ReadOptions, read, read_spectra
from swiftwrf.data.receivers import spelled_as
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.store import Store
from swiftwrf.errors import listed
from tasks.options import OffsetSource, SpectraSource, TableSource, by_name, pairs
from tasks.terminal import console

ROWS_A_READ = 1024  # of an array that is read


def reading(spectra: SpectraSource, table: TableSource) -> ReadOptions:
    """Return the options of a command line for reading."""
    options = by_name(spectra) | by_name(table)
    return ReadOptions(
        **options
        | {
            "array": _array(spectra),
            "arrays": pairs("arrays", spectra.arrays, "csi"),
            "columns": pairs("columns", table.columns, "x"),
            "filler": () if table.filler == "none" else table.filler or None,
            "offset_by": (options.get("offset_by") or "").partition("=")[0] or None,
        }
    )


def _array(spectra: SpectraSource) -> PlanarArray | None:
    if spectra.array is None:
        return None
    *sides, spacing, frequency = spectra.array
    rows, columns = (int(side) for side in (sides[0], sides[-1]))
    if rows == columns:
        return PlanarArray.square(rows, frequency, spacing)
    return PlanarArray.grid(rows, columns, spacing, frequency)


def is_table(source: str) -> bool:
    """Return True for a file of a table."""
    return os.path.isfile(source) and Path(source).suffix.lower() in TABLES


def with_groups(options: ReadOptions, source: str, offsets: Offsets | None) -> ReadOptions:
    """Return options that read the groups whose offsets a model knows, if the source is a table with their column."""
    if offsets is None or not is_table(source) or offsets.column not in read_table(Path(source)).columns:
        return options
    return replace(options, offset_by=offsets.column)


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


def measured_rssi(data: str | None, table: TableSource) -> Rssi | None:
    """Return the RSSI of an experiment in a folder or file, None without one.

    Raises:
        InputError: RSSI that cannot be read.
    """
    if data is None:
        return None
    found: Rssi = read(located(data), reading(SpectraSource(), table), RSSI_FORMATS)
    return found


def offset_notes(data: Rssi, table: OffsetSource) -> list[str]:
    """Return a note on columns that may distinguish devices or channels and are not used, or none."""
    if table.offset_by is not None or not data.labels:
        return []
    return [
        f"rows differ in {listed(data.labels)}; if swiftwrf inspect finds offsets between them, give --offset-by COLUMN"
    ]


def observed_spectra(source: str, options: ReadOptions, grid: AngularGrid, model: str) -> tuple[Store, Spectra | None]:
    """Read the spectra that a fitted model is applied to: measurements of any format, or a .npy file.

    Returns:
        Spectra, and the measurements that they belong to if positions are known.

    Raises:
        InputError: Spectra that cannot be read, or on another grid.
    """
    known = None
    if not source.endswith(".npy"):
        known = read_spectra(located(source), options)
    elif options.given:
        raise InputError(f"{source} holds spectra as they are; --{next(iter(options.given))} does not apply")
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
    return replace(data, rssi_dbm=rssi, receiver_names=names, receiver_position=position)


def _read_array(file: Path) -> Tensor:
    """Return the spectra of unknown positions in a .npy file."""
    shape, dtype = array_header(file, "array")
    if len(shape) != 3 or dtype.kind != "f" or not math.prod(shape):
        raise InputError(f"{file} must hold floating-point spectra (n, elevations, azimuths), got {dtype} of {shape}")
    spectrum = torch.cat([torch.from_numpy(some.astype(np.float32)) for some in read_rows(file, "array", ROWS_A_READ)])
    if not bool(((spectrum >= 0) & (spectrum <= 1)).all()):
        raise InputError(f"{file} must hold magnitudes in [0, 1]")
    return spectrum
