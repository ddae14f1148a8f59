"""Reader of DICHASUS data sets (https://dichasus.inue.uni-stuttgart.de): TFRecord files and a JSON file of the arrays.

The phase and time offsets of the antennas are those of reftx-offsets-NAME.json if it lies beside NAME.tfrecords.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swiftwrf.data.files import read_text
from swiftwrf.data.formats.base import SNAPSHOT_FORMATS
from swiftwrf.data.stations import Cell, Record, RecordFormat, Station
from swiftwrf.data.tfrecords import tensor
from swiftwrf.errors import InputError

NO_OFFSETS = (
    "no reftx-offsets-NAME.json lies beside the records, so the elements' phases are as measured: calibrate them"
)


@SNAPSHOT_FORMATS.register("dichasus")
class Dichasus(RecordFormat):
    """`csi` float32 (antennas, subcarriers, 2) of real and imaginary parts, `pos-tachy` (3,) [m]."""

    assigned = True

    def cells(self, station: Station, file: Path) -> tuple[list[Cell], tuple[int, int]]:
        rows = station.assignments
        if not rows:
            raise InputError(f"{file}: array {station.name} lacks assignments, the antenna of each row and column")
        cells = [(r, c, antenna) for r, row in enumerate(rows) for c, antenna in enumerate(row) if antenna is not None]
        return cells, (len(rows), len(rows[0]))

    def prepare(self, files: list[Path]) -> tuple[list[Path], tuple[str, ...]]:
        found = {file: file.with_name(f"reftx-offsets-{file.stem}.json") for file in files}
        self._offsets = {file: _offsets(source) for file, source in found.items() if source.is_file()}
        return [found[file] for file in self._offsets], () if len(self._offsets) == len(files) else (NO_OFFSETS,)

    def parse(self, features: dict[str, bytes], file: Path) -> Record:
        parts, position = tensor(features["csi"]), tensor(features["pos-tachy"])
        fits = parts.ndim == 3 and parts.shape[2] == 2 and parts.dtype.kind == "f" and 0 not in parts.shape
        if not fits or position.shape != (3,):
            raise ValueError(f"csi of shape {parts.shape} and pos-tachy of shape {position.shape}")
        joined = parts.view(np.result_type(parts.dtype, np.complex64))[..., 0]
        csi = np.fft.fftshift(joined, axes=1)  # from the order of the FFT to that of frequency
        if (offsets := self._offsets.get(file)) is not None:
            if len(offsets) != len(csi):
                raise ValueError(f"{len(csi)} antennas, but offsets of {len(offsets)}")
            cycles = np.arange(csi.shape[1]) / csi.shape[1]
            with np.errstate(invalid="ignore", over="ignore"):  # the reader omits channels that are not finite
                csi = csi * np.exp(1j * (offsets[:, :1] + offsets[:, 1:] * 2 * np.pi * cycles))
        return Record(csi, position)

    def select(self, csi: NDArray[Any], station: Station, antennas: list[int]) -> NDArray[Any]:
        return csi[antennas]


def _offsets(file: Path) -> NDArray[Any]:
    """Return carrier phase [rad] and sampling time [samples] to add to each antenna, (antennas, 2)."""
    try:
        content = json.loads(read_text(file))
        values = np.array([content["cpo"], content["sto"]], dtype=np.float64).T
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise InputError(f"{file} must hold lists cpo and sto with a number for each antenna ({error})") from None
    if values.ndim != 2 or not np.isfinite(values).all():
        raise InputError(f"{file} must hold lists cpo and sto with a finite number for each antenna")
    return values
