"""Reader of survey tables: positions and RSSI in CSV or Parquet, one column a receiver (wide) or one row a packet (long)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from swiftwrf.data.files import MAX_COORDINATE_M, digests
from swiftwrf.data.formats.base import RSSI_FORMATS, Format, ReadOptions
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import read_splits
from swiftwrf.data.survey import SUFFIXES, column_of_numbers, read_frame, read_survey
from swiftwrf.errors import InputError

RECEIVERS = "receivers.csv"  # beside the table: receiver,x,y,z
NERF2_FILES = ("tx_pos.csv", "rx_pos.csv", "gateway_rssi.csv")


@RSSI_FORMATS.register("survey")
class SurveyTable(Format[Rssi]):
    """Table of a walk test; positions of the receivers are unknown unless receivers.csv lies beside it."""

    takes = frozenset({"columns"})

    def recognises(self, path: Path) -> bool:
        return bool(_tables(path))

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        tables = _tables(path)
        if len(tables) > 1:
            raise InputError(
                f"{path} holds {len(tables)} tables ({', '.join(file.name for file in tables)}); name the one to read"
            )
        file, receivers = tables[0], tables[0].with_name(RECEIVERS)
        names, rssi, position, notes = read_survey(file, read_frame(file), options.columns or {})
        return Rssi(
            rssi,
            position,
            name=file.stem,
            receiver_names=names,
            receiver_position=_receiver_positions(receivers, names) if receivers.is_file() else None,
            named_splits=read_splits(file.parent, len(position), first=0),
            source=digests([file, *([receivers] if receivers.is_file() else [])], file.parent),
            notes=notes,
        )


def _tables(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix.lower() in SUFFIXES else []
    if any((path / name).is_file() for name in NERF2_FILES):
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.name != RECEIVERS)


def _receiver_positions(file: Path, names: list[str]) -> Tensor:
    """Return the positions of the receivers, float64 (R, 3) [m]."""
    table = read_frame(file)
    if list(table.columns) != ["receiver", "x", "y", "z"]:
        raise InputError(f"{file} must start with the header receiver,x,y,z, got {','.join(table.columns)}")
    table.index = pd.Index(table["receiver"].str.strip())
    missing = [name for name in names if name not in table.index]
    if missing or not table.index.is_unique:
        raise InputError(
            f"{file} must have each receiver once; {', '.join(missing[:5]) or 'one name'} is missing or comes twice"
        )
    position = np.stack([column_of_numbers(file, table.loc[names], axis) for axis in "xyz"], axis=1)
    if not (np.abs(position) <= MAX_COORDINATE_M).all():
        raise InputError(f"{file} needs 3 finite numbers [m], at most {MAX_COORDINATE_M:g}, for each receiver")
    return torch.from_numpy(position)
