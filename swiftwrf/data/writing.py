"""Write measurements in the toolkit's own layout, which `load_spectra` and `load_rssi` read back unchanged."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.dataset import Labelled
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.powers import NOT_DETECTED_DBM
from swiftwrf.data.rssi import META, SURVEY, Rssi
from swiftwrf.data.spectra import OF_SPECTRA, Spectra
from swiftwrf.data.store import write_npy
from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import replacing, write_npz, write_text


def write_spectra(data: Spectra, folder: Path) -> None:
    """Write gateway_info.yml, tx_pos.csv or rx_pos.csv, spectrum.npz and the splits into a folder.

    Raises:
        InputError: Both ends move, the orientation is unknown, or the layout does not have the grid.
    """
    if data.fixed_position is None or data.rotation is None:
        raise InputError(f"{data.name} has no fixed end and orientation, which the layout needs; it cannot be written")
    if data.grid != AngularGrid.of(data.grid.shape):
        raise InputError(f"{data.name} has another grid than elevations up to 90 degrees and azimuths from 0 on")
    gateway: dict[str, Any] = {
        "position": data.fixed_position.tolist(),
        "orientation": Rotation.from_matrix(data.rotation.numpy()).as_quat().tolist(),
    }
    if data.array is not None:
        gateway |= {"frequency_hz": data.array.frequency_hz, "element_position": data.array.element.tolist()}
    write_text(folder / "gateway_info.yml", yaml.safe_dump({"gateway1": gateway}, sort_keys=False))
    write_text(
        folder / f"{'tx' if data.moving == 'transmitter' else 'rx'}_pos.csv", _csv(["x", "y", "z"], data.position)
    )
    with replacing(folder / "spectrum.npz") as temporary, zipfile.ZipFile(temporary, "w") as archive:
        with archive.open("spectrum.npy", "w", force_zip64=True) as stream:
            dtype, batches = data.store.exact()
            write_npy(stream, data.store.shape, dtype, batches)
        others = {name: getattr(data, name) for name in OF_SPECTRA}
        if torch.equal(data.label, data.direction_at(data.position)):
            del others["label"]  # follows from the positions
        for name, values in others.items():
            if values is not None:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                    np.save(stream, values.numpy())
    write_splits(data.named_splits, folder, first=1)


def write_rssi(data: Rssi, folder: Path) -> None:
    """Write tx_pos.csv, gateway_rssi.csv, the splits, and what else is known of the measurements, into a folder.

    That is meta.csv with sessions, times and groups, gateway_position.yml with positions of receivers, and survey.yml with
    the origin of the coordinates, the floors, offsets that were removed, and further properties of all measurements.

    Measurements of exactly -100 dBm, which the layout uses for not detected, are written as -99.99.

    Raises:
        InputError: Another quantity than RSSI.
    """
    data.check_power("the layout")
    rssi = data.rssi_dbm.where(data.rssi_dbm != NOT_DETECTED_DBM, NOT_DETECTED_DBM + 0.01)
    write_text(folder / "gateway_rssi.csv", _csv(list(data.receiver_names), rssi.nan_to_num(NOT_DETECTED_DBM)))
    write_text(folder / "tx_pos.csv", _csv(["x", "y", "z"], data.transmitter_position))
    if data.located:
        known = zip(data.receiver_names, data.receiver_position.tolist(), data.receiver_located.tolist(), strict=True)
        places = {name: position for name, position, is_located in known if is_located}
        write_text(folder / "gateway_position.yml", yaml.safe_dump(places, sort_keys=False, allow_unicode=True))
    of_rows = {"session": data.session, "time": data.time, "group": data.groups}
    if columns := {name: np.asarray(values) for name, values in of_rows.items() if values is not None}:
        write_text(folder / META, pd.DataFrame(columns).to_csv(index_label="row"))  # whose lines are never empty
    survey = {
        "origin": data.origin and list(data.origin),
        "floors": data.floors and dict(zip(data.floors.names, data.floors.height_m, strict=True)),
        "receiver_moves": data.receiver_moves,
        "groups": None if data.groups is None else str(data.groups.name),
        "offsets": data.offsets and asdict(data.offsets),
        "labels": list(data.labels),
        "bands": data.bands and list(data.bands),
        "plan_scale": data.plan_scale,
        "margin_db": None if data.margin_db is None else str(data.margin_db),
    }
    if survey := {name: value for name, value in survey.items() if value}:
        write_text(folder / SURVEY, yaml.safe_dump(survey, sort_keys=False, allow_unicode=True))
    write_splits(data.named_splits, folder, first=0)


def write_paths(paths: PropagationPaths, folder: Path) -> None:
    """Write paths with known corners, at least one a link, as paths.npz."""
    arrays = {
        "transmitter_position": paths.transmitter,
        "receiver_position": paths.receiver,
        "path_count": paths.count,
        "last_point": paths.last_point(),
        "gain": paths.gain,
        "line_of_sight": paths.line_of_sight,
        "length": paths.length,
    }
    known = {name: values.numpy() for name, values in arrays.items() if values is not None}
    write_npz(folder / "paths.npz", known | {"frequency_hz": np.float64(paths.frequency_hz)})


def write_mat(data: Labelled, file: Path) -> None:
    """Write coordinates and variables as a MATLAB file of version 5: arrays of one dimension as (n, 1), names as cells."""
    arrays = {name: values for name, (_, values, *_) in (data.coordinates() | data.variables()).items()}
    arrays |= {name: values.astype(object) for name, values in arrays.items() if values.dtype.kind == "U"}  # to cells
    with replacing(file) as temporary, temporary.open("wb") as stream:
        savemat(stream, arrays, do_compression=True, oned_as="column")


def _csv(columns: list[str], values: Tensor) -> str:
    return str(pd.DataFrame(values.numpy(), columns=columns).to_csv(index=False))


def write_splits(splits: Mapping[str, tuple[Tensor, Tensor]], folder: Path, first: int) -> None:
    """Write the rows of splits, of which row 0 gets the number `first`: 1 for spectra, 0 for RSSI."""
    for name, parts in splits.items():
        suffix = "" if name == "random" else f"_{name}"
        for part, rows in zip(("train", "test"), parts, strict=True):
            write_text(folder / f"{part}_index{suffix}.txt", "".join(f"{row + first}\n" for row in rows.tolist()))
