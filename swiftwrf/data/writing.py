"""Measurements written in the toolkit's own layout, which `load_spectra` and `load_rssi` read back as they were."""

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
from swiftwrf.data.formats.nerf2_rssi import NOT_HEARD
from swiftwrf.data.raytraced import TracedPaths
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.data.store import write_npy
from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import replacing, write_bytes, write_text


def write_spectra(data: Spectra, folder: Path) -> None:
    """gateway_info.yml, tx_pos.csv or rx_pos.csv, spectrum.npz and the splits.

    Args:
        data: with known fixed end and orientation.
        folder: to write to, which exists.

    Raises:
        InputError: both ends move, the orientation is unknown, or the grid is not one of the layout.
    """
    if data.fixed_position is None or data.rotation is None:
        raise InputError(
            f"{data.name} has no end that stays at one place with one orientation, which the layout needs; it cannot be "
            "written"
        )
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
    """tx_pos.csv, gateway_rssi.csv, gateway_position.yml where the receivers' positions are known, and the splits.

    What was measured at -100 dBm sharp, which means not heard in the layout, is written a hundredth of a dB above.

    Args:
        data: RSSI, nan where not heard.
        folder: to write to, which exists.
    """
    rssi = data.rssi_dbm.where(data.rssi_dbm != NOT_HEARD, NOT_HEARD + 0.01)
    quoted = ",".join('"' + name.replace('"', '""') + '"' for name in data.receiver_names)
    write_text(folder / "gateway_rssi.csv", _csv(quoted, rssi.nan_to_num(NOT_HEARD)))
    write_text(folder / "tx_pos.csv", _csv("x,y,z", data.transmitter_position))
    if data.located:
        places = dict(zip(data.receiver_names, data.receiver_position.tolist(), strict=True))
        write_text(folder / "gateway_position.yml", yaml.safe_dump(places, sort_keys=False, allow_unicode=True))
    _write_splits(data.named_splits, folder, first=0)


def write_paths(
    folder: Path, paths: TracedPaths, fixed: Tensor, position: Tensor, moving: Moving, frequency_hz: float
) -> None:
    """paths.npz.

    Args:
        folder: to write to, which exists.
        paths: of all positions, at least one each.
        fixed: position of the end that stays, (3,) [m].
        position: of the end that moves, (n, 3) [m].
        moving: which end that is.
        frequency_hz: of the carrier.
    """
    ends = (position, fixed.expand_as(position))
    transmitter, receiver = ends if moving == "transmitter" else ends[::-1]
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        transmitter_position=transmitter.numpy(),
        receiver_position=receiver.numpy(),
        path_count=paths.count.numpy(),
        last_point=paths.last_point(transmitter).numpy(),
        gain=paths.gain.numpy(),
        line_of_sight=paths.line_of_sight.numpy(),
        frequency_hz=np.float64(frequency_hz),
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
