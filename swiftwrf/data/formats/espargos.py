"""Reader of ESPARGOS data sets (https://espargos.net/datasets): TFRecord files and a JSON file that describes the arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from swiftwrf.data.formats.base import SNAPSHOT_FORMATS
from swiftwrf.data.stations import Cell, Record, RecordFormat, Station
from swiftwrf.data.tfrecords import tensor

ROWS, COLUMNS = 2, 4  # of an array


@SNAPSHOT_FORMATS.register("espargos")
class Espargos(RecordFormat):
    """`csi` complex (arrays, 2, 4, subcarriers), `pos` (3,) [m]."""

    assigned = False

    def cells(self, station: Station, file: Path) -> tuple[list[Cell], tuple[int, int]]:
        cells = [(row, column, row * COLUMNS + column) for row in range(ROWS) for column in range(COLUMNS)]
        return cells, (ROWS, COLUMNS)

    def parse(self, features: dict[str, bytes], file: Path) -> Record:
        csi, position = tensor(features["csi"]), tensor(features["pos"])
        fits = csi.ndim == 4 and csi.shape[1:3] == (ROWS, COLUMNS) and csi.dtype.kind == "c" and 0 not in csi.shape
        if not fits or position.shape != (3,):
            raise ValueError(f"csi of shape {csi.shape} and pos of shape {position.shape}")
        return Record(csi, position)

    def select(self, csi: NDArray[Any], station: Station, antennas: list[int]) -> NDArray[Any]:
        channel: NDArray[Any] = csi[station.number].reshape(len(antennas), -1)
        return channel
