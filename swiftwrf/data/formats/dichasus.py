"""Reader of DICHASUS data sets (https://dichasus.inue.uni-stuttgart.de): TFRecord files and a JSON file that describes the
arrays, with the phase and time offsets of the antennas where reftx-offsets-NAME.json lies beside NAME.tfrecords."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swiftwrf.data.files import read_text
from swiftwrf.data.formats.base import SNAPSHOT_FORMATS, Format
from swiftwrf.data.reading import Reading
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.stations import (
    Record,
    description,
    element_array,
    has_assignments,
    read_snapshots,
    read_station,
    record_files,
)
from swiftwrf.data.tfrecords import tensor
from swiftwrf.errors import InputError


@SNAPSHOT_FORMATS.register("dichasus")
class Dichasus(Format[Snapshots]):
    """`csi` float32 (antennas, subcarriers, 2) of real and imaginary parts, `pos-tachy` (3,) [m]."""

    takes = frozenset({"beamformer", "grid", "every", "station"})

    def recognises(self, path: Path) -> bool:
        described = description(path) if record_files(path) else None
        return described is not None and has_assignments(described)

    def read(self, path: Path, how: Reading) -> Snapshots:
        described = description(path)
        assert described is not None
        _, station, frequency = read_station(described, how.station)
        rows = station.assignments or []
        if not rows:
            raise InputError(f"{described}: array {station.name} lacks assignments, the antenna of each row and column")
        shape = (len(rows), len(rows[0]))
        cells = [(r, c, antenna) for r, row in enumerate(rows) for c, antenna in enumerate(row) if antenna is not None]
        antennas = [antenna for _, _, antenna in cells]
        offsets = {file: _offsets(file) for file in record_files(path)}
        known = [_offset_file(file) for file, values in offsets.items() if values is not None]
        notes = () if len(known) == len(offsets) else (
            "no reftx-offsets-NAME.json lies beside the records, so the elements' phases are as measured: calibrate them",
        )  # fmt: skip
        return read_snapshots(
            path,
            how.every or 1,
            functools.partial(_parse, offsets=offsets),
            lambda csi: csi[antennas],
            (station, element_array(described, [station.element(r, c, shape) for r, c, _ in cells], frequency)),
            [described, *known],
            notes,
        )


def _parse(features: dict[str, bytes], file: Path, offsets: dict[Path, NDArray[Any] | None]) -> Record:
    parts, position = tensor(features["csi"]), tensor(features["pos-tachy"])
    if parts.ndim != 3 or parts.shape[2] != 2 or parts.dtype.kind != "f" or 0 in parts.shape or position.shape != (3,):
        raise ValueError(f"csi of shape {parts.shape} and pos-tachy of shape {position.shape}")
    joined = parts.view(np.result_type(parts.dtype, np.complex64))[..., 0]
    csi = np.fft.fftshift(joined, axes=1)  # from the order of the FFT to that of frequency
    if (known := offsets[file]) is not None:
        if len(known) != len(csi):
            raise ValueError(f"{len(csi)} antennas, but offsets of {len(known)}")
        turns = np.arange(csi.shape[1]) / csi.shape[1]
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is left out later
            csi = csi * np.exp(1j * (known[:, :1] + known[:, 1:] * 2 * np.pi * turns))
    return Record(csi, position)


def _offset_file(file: Path) -> Path:
    return file.with_name(f"reftx-offsets-{file.stem}.json")


def _offsets(file: Path) -> NDArray[Any] | None:
    """Carrier phase [rad] and sampling time [samples] of each antenna that are to be added, (antennas, 2)."""
    source = _offset_file(file)
    if not source.is_file():
        return None
    try:
        content = json.loads(read_text(source))
        values = np.array([content["cpo"], content["sto"]], dtype=np.float64).T
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise InputError(f"{source} must hold lists cpo and sto with a number for each antenna ({error})") from None
    if values.ndim != 2 or not np.isfinite(values).all():
        raise InputError(f"{source} must hold lists cpo and sto with a finite number for each antenna")
    return values
