"""Reader of the NeRF2 layout for RSSI: gateway_position.yml, tx_pos.csv, gateway_rssi.csv (-100: not detected)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from swiftwrf.data.files import MAX_COORDINATE_M, digests, numbers, read_positions, read_table, read_yaml
from swiftwrf.data.formats.base import RSSI_FORMATS, Format, ReadOptions
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import read_splits
from swiftwrf.data.survey import NOT_DETECTED_DBM, check_powers
from swiftwrf.errors import InputError


@RSSI_FORMATS.register("nerf2")
class Nerf2Rssi(Format[Rssi]):
    """One row a position of the transmitter, one column a receiver."""

    def recognises(self, path: Path) -> bool:
        return (path / "gateway_rssi.csv").is_file() or (path / "gateway_position.yml").is_file()

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        table, positions, receivers = (
            path / name for name in ("gateway_rssi.csv", "tx_pos.csv", "gateway_position.yml")
        )
        names, rssi = read_table(table)
        position = read_positions(positions)
        if len(rssi) != len(position):
            raise InputError(
                f"{path}: gateway_rssi.csv has {len(rssi)} rows, tx_pos.csv {len(position)}; they must match"
            )
        check_powers(table, rssi.numpy(), np.array(names, dtype=object), (NOT_DETECTED_DBM,))
        return Rssi(
            torch.where(rssi == NOT_DETECTED_DBM, torch.nan, rssi),
            position,
            name=path.resolve().name,
            receiver_names=names,
            receiver_position=_read_receivers(receivers, names) if receivers.is_file() else None,
            named_splits=read_splits(path, len(position), first=0),
            source=digests([f for f in (positions, table, receivers) if f.is_file()], path),
        )


def _read_receivers(file: Path, names: list[str]) -> Tensor:
    """Return the positions of the receivers, float64 (R, 3) [m]."""
    content = read_yaml(file)
    missing = [name for name in names if name not in content]
    if missing:
        raise InputError(f"{file} has no position of receiver {missing[0]!r}, which gateway_rssi.csv names")
    positions = [numbers(content[name], 3) for name in names]
    for name, position in zip(names, positions, strict=True):
        if position is None or max(map(abs, position)) > MAX_COORDINATE_M:
            raise InputError(
                f"{file}: receiver {name!r} needs a position of 3 finite numbers [m], at most {MAX_COORDINATE_M:g}, got "
                f"{content[name]}"
            )
    return torch.tensor(positions, dtype=torch.float64)
