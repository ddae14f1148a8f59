"""Write measurements in the toolkit's own layout, which `load_spectra` and `load_rssi` read back unchanged."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.fillers import NOT_DETECTED_DBM
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.store import write_npy
from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import replacing, write_bytes, write_text


def write_spectra(data: Spectra, folder: Path) -> None:
    """Write gateway_info.yml, tx_pos.csv or rx_pos.csv, spectrum.npz and the splits.

    Args:
        data: Spectra with known fixed end and orientation.
        folder: Existing folder.

    Raises:
        InputError: Both ends move, the orientation is unknown, or the layout does not have the grid.
    """
    if data.fixed_position is None or data.rotation is None:
        raise InputError(f"{data.name} has no fixed end and orientation, which the layout needs; it cannot be written")
    if data.grid != AngularGrid.hemisphere(*data.grid.shape):
        raise InputError(f"{data.name} has another grid than elevations up to 90 degrees and azimuths from 0 on")
    gateway: dict[str, Any] = {
        "position": data.fixed_position.tolist(),
        "orientation": Rotation.from_matrix(data.rotation.numpy()).as_quat().tolist(),
    }
    if data.array is not None:
        gateway |= {"frequency_hz": data.array.frequency_hz, "element_position": data.array.element.tolist()}
    write_text(folder / "gateway_info.yml", yaml.safe_dump({"gateway1": gateway}, sort_keys=False))
    write_text(folder / f"{'tx' if data.moving == 'transmitter' else 'rx'}_pos.csv", _csv("x,y,z", data.position))
    with replacing(folder / "spectrum.npz") as temporary, zipfile.ZipFile(temporary, "w") as archive:
        with archive.open("spectrum.npy", "w", force_zip64=True) as stream:
            dtype, batches = data.store.exact()
            write_npy(stream, data.store.shape, dtype, batches)
        with archive.open("line_of_sight.npy", "w") as stream:
            np.save(stream, data.line_of_sight.numpy())
    _write_splits(data.named_splits, folder, first=1)


def write_rssi(data: Rssi, folder: Path) -> None:
    """Write tx_pos.csv, gateway_rssi.csv, the splits, and gateway_position.yml with the known positions of receivers.

    Measurements of exactly -100 dBm, which the layout uses for not detected, are written as -99.99.

    Args:
        data: RSSI, nan where not detected.
        folder: Existing folder.
    """
    rssi = data.rssi_dbm.where(data.rssi_dbm != NOT_DETECTED_DBM, NOT_DETECTED_DBM + 0.01)
    quoted = ",".join('"' + name.replace('"', '""') + '"' for name in data.receiver_names)
    write_text(folder / "gateway_rssi.csv", _csv(quoted, rssi.nan_to_num(NOT_DETECTED_DBM)))
    write_text(folder / "tx_pos.csv", _csv("x,y,z", data.transmitter_position))
    if data.located:
        known = zip(data.receiver_names, data.receiver_position.tolist(), data.receiver_located.tolist(), strict=True)
        places = {name: position for name, position, is_located in known if is_located}
        write_text(folder / "gateway_position.yml", yaml.safe_dump(places, sort_keys=False, allow_unicode=True))
    _write_splits(data.named_splits, folder, first=0)


def write_paths(paths: PropagationPaths, folder: Path) -> None:
    """Write paths.npz.

    Args:
        paths: At least one path a link, with known corners.
        folder: Existing folder.
    """
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        transmitter_position=paths.transmitter.numpy(),
        receiver_position=paths.receiver.numpy(),
        path_count=paths.count.numpy(),
        last_point=paths.last_point().numpy(),
        gain=paths.gain.numpy(),
        line_of_sight=paths.line_of_sight.numpy(),
        frequency_hz=np.float64(paths.frequency_hz),
    )
    write_bytes(folder / "paths.npz", stream.getvalue())


def _csv(header: str, values: Tensor) -> str:
    rows = (",".join(f"{value!r}" for value in row) for row in values.tolist())
    return "\n".join([header, *rows]) + "\n"


def _write_splits(splits: dict[str, tuple[Tensor, Tensor]], folder: Path, first: int) -> None:
    for name, parts in splits.items():
        suffix = "" if name == "random" else f"_{name}"
        for part, rows in zip(("train", "test"), parts, strict=True):
            write_text(folder / f"{part}_index{suffix}.txt", "".join(f"{row + first}\n" for row in rows.tolist()))
