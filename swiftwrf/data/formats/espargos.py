"""Reader of ESPARGOS data sets (https://espargos.net/datasets): TFRecord files and a JSON file that describes the arrays."""

from __future__ import annotations

from pathlib import Path

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

SHAPE = (2, 4)  # rows and columns of an array


@SNAPSHOT_FORMATS.register("espargos")
class Espargos(Format[Snapshots]):
    """`csi` complex (arrays, 2, 4, subcarriers), `pos` (3,) [m]."""

    takes = frozenset({"beamformer", "grid", "every", "station"})

    def recognises(self, path: Path) -> bool:
        if not record_files(path):
            return False
        described = description(path)
        return described is None or not has_assignments(described)

    def read(self, path: Path, how: Reading) -> Snapshots:
        described = description(path)
        if described is None:
            raise InputError(
                f"{path} holds records, but no JSON with antennas, which describes their arrays, lies beside them"
            )
        index, station, frequency = read_station(described, how.station)
        places = [station.element(row, column, SHAPE) for row in range(SHAPE[0]) for column in range(SHAPE[1])]
        return read_snapshots(
            path,
            how.every or 1,
            _parse,
            lambda csi: csi[index].reshape(len(places), -1),
            (station, element_array(described, places, frequency)),
            [described],
            (),
        )


def _parse(features: dict[str, bytes], file: Path) -> Record:
    csi, position = tensor(features["csi"]), tensor(features["pos"])
    if csi.ndim != 4 or csi.shape[1:3] != SHAPE or csi.dtype.kind != "c" or 0 in csi.shape or position.shape != (3,):
        raise ValueError(f"csi of shape {csi.shape} and pos of shape {position.shape}")
    return Record(csi, position)
