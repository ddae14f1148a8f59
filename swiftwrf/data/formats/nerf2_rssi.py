"""Reader of the NeRF2 layout for RSSI: gateway_position.yml, tx_pos.csv, gateway_rssi.csv (-100 = not heard)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.data.files import FARTHEST, numbers, read_positions, read_table, read_yaml, sha256
from swiftwrf.data.formats.base import RSSI_FORMATS, Format
from swiftwrf.data.reading import Reading
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import read_split, split_names
from swiftwrf.errors import InputError

NOT_HEARD = -100.0  # what the files write for a receiver that did not hear the transmitter; it is missing, not weak
LOWEST, HIGHEST = -150.0, 30.0  # [dBm] beyond which a value cannot be a received power


@RSSI_FORMATS.register("nerf2")
class Nerf2Rssi(Format[Rssi]):
    """One row a position of the transmitter, one column a receiver."""

    def recognises(self, path: Path) -> bool:
        return (path / "gateway_rssi.csv").is_file() or (path / "gateway_position.yml").is_file()

    def read(self, path: Path, how: Reading) -> Rssi:
        return _read(path)


def _read(folder: Path) -> Rssi:
    names, rssi = read_table(folder / "gateway_rssi.csv")
    position = read_positions(folder / "tx_pos.csv")
    if len(rssi) != len(position):
        raise InputError(
            f"{folder}: gateway_rssi.csv has {len(rssi)} rows, tx_pos.csv {len(position)}; they must match"
        )
    _check_values(folder / "gateway_rssi.csv", names, rssi)
    heard = torch.where(rssi == NOT_HEARD, torch.nan, rssi)
    described = ["tx_pos.csv", "gateway_rssi.csv", "gateway_position.yml"]
    files = [*(folder / name for name in described if (folder / name).is_file()), *sorted(folder.glob("*_index*.txt"))]
    return Rssi(
        name=folder.resolve().name,
        receiver_names=tuple(names),
        receiver_position=_read_receivers(folder / "gateway_position.yml", names),
        transmitter_position=position,
        rssi_dbm=heard,
        index=torch.arange(len(position)),
        named_splits={name: read_split(folder, name, len(position), first=0) for name in split_names(folder)},
        source={file.name: sha256(file) for file in files},
    )


def _check_values(file: Path, names: list[str], rssi: Tensor) -> None:
    bad = (~((rssi >= LOWEST) & (rssi <= HIGHEST))).nonzero()  # nan compares false, so it is bad too
    if len(bad):
        row, column = bad[0].tolist()
        raise InputError(
            f"{file} row {row + 1}, receiver {names[column]}: {float(rssi[row, column]):g} dBm is no received power; "
            f"expected {LOWEST:g} to {HIGHEST:g}, or {NOT_HEARD:g} for not heard"
        )


def _read_receivers(file: Path, names: list[str]) -> Tensor:
    """Positions of the receivers, float64 (R, 3) [m]; nan where no file tells them."""
    if not file.is_file():
        return torch.full((len(names), 3), torch.nan, dtype=torch.float64)
    content = read_yaml(file)
    missing = [name for name in names if name not in content]
    if missing:
        raise InputError(f"{file} has no position of receiver {missing[0]!r}, which gateway_rssi.csv names")
    positions = [numbers(content[name], 3) for name in names]
    for name, position in zip(names, positions, strict=True):
        if position is None or max(map(abs, position)) > FARTHEST:
            raise InputError(
                f"{file}: receiver {name!r} needs a position of 3 finite numbers [m], at most {FARTHEST:g}, got "
                f"{content[name]}"
            )
    return torch.tensor(positions, dtype=torch.float64)
