"""Reader of survey tables: positions and RSSI in CSV or Parquet, one column a receiver (wide) or one row a packet (long)."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.files import FARTHEST, sha256
from swiftwrf.data.formats.base import RSSI_FORMATS, Format
from swiftwrf.data.formats.nerf2_rssi import HIGHEST, LOWEST, NOT_HEARD
from swiftwrf.data.reading import Reading
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import read_split, split_names
from swiftwrf.data.tables import SUFFIXES, column_of_numbers, parsed, read_frame
from swiftwrf.errors import InputError, listed

RECEIVERS = "receivers.csv"  # beside the table: receiver,x,y,z
SENTINELS = (NOT_HEARD, -200.0, 100.0)  # that tables write for a receiver that heard nothing
STOREY = 4.0  # [m] that a number of a floor stands for, where there is no height
MOST_VALUES = 2**27  # of all receivers
AXIS = "(?:(?:pos|position|coord|tx)_)?{0}(?:_(?:pos|position|coord))?(?:_m)?"
ROLES = {  # names of columns, in small letters and underscores
    "x": re.compile(AXIS.format("x") + "|easting|longitude|lon"),
    "y": re.compile(AXIS.format("y") + "|northing|latitude|lat"),
    "z": re.compile(AXIS.format("z") + "|(?:height|altitude)(?:_m)?"),
    "floor": re.compile("floor"),
    "time": re.compile("time(?:_s)?|timestamp|t|date(?:_?time)?"),
    "receiver": re.compile("receiver(?:_(?:name|id))?|rx|gateway|ap|bssid|mac|sensor|anchor"),
    "rssi": re.compile("(?:rssi?|rsrp|signal|power)(?:_dbm)?|rss_dbm|dbm"),
}
ASKED = tuple(role for role in ROLES if role != "floor")  # that --columns takes
DEGREES = {"longitude", "lon", "latitude", "lat"}


@RSSI_FORMATS.register("survey")
class Survey(Format[Rssi]):
    """A table of a walk test, with the receivers' positions beside it or unknown."""

    takes = frozenset({"columns"})

    def recognises(self, path: Path) -> bool:
        return bool(_tables(path))

    def read(self, path: Path, how: Reading) -> Rssi:
        tables = _tables(path)
        if len(tables) > 1:
            raise InputError(
                f"{path} holds {len(tables)} tables ({', '.join(file.name for file in tables)}); name the one to read"
            )
        return _read(tables[0], how.columns or {})


def _tables(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix.lower() in SUFFIXES else []
    nerf2 = ("tx_pos.csv", "rx_pos.csv", "gateway_rssi.csv")
    if any((path / name).is_file() for name in nerf2):
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.name != RECEIVERS)


def _read(file: Path, asked: Mapping[str, str]) -> Rssi:
    table = read_frame(file)
    roles = _roles(file, table, asked)
    notes: list[str] = []
    position = _positions(file, table, roles, notes)
    if "receiver" in roles:
        names, rssi, position = _long(file, table, roles, position)
    else:
        names, rssi = _wide(file, table, roles, asked, notes)
    names, rssi = _heard(file, names, rssi, notes)
    receivers = file.with_name(RECEIVERS)
    described = [file, *([receivers] if receivers.is_file() else []), *sorted(file.parent.glob("*_index*.txt"))]
    return Rssi(
        name=file.stem,
        receiver_names=tuple(names),
        receiver_position=_receivers(receivers, names),
        transmitter_position=position,
        rssi_dbm=rssi,
        index=torch.arange(len(position)),
        named_splits={name: read_split(file.parent, name, len(position), first=0) for name in split_names(file.parent)},
        source={f.name: sha256(f) for f in described},
        notes=tuple(notes),
    )


def _roles(file: Path, table: pd.DataFrame, asked: Mapping[str, str]) -> dict[str, str]:
    """The column of each role: as asked for, else by its name."""
    for role in asked:
        if role not in ASKED:
            raise InputError(f"columns takes {', '.join(ASKED)}, got {role!r}")
    roles = {role: name for role, name in asked.items() if name in table.columns}
    for role, name in asked.items():
        pattern = role == "rssi" and fnmatch.filter(table.columns, name)
        if role not in roles and not pattern:
            raise InputError(f"{file} has no column {name!r} for {role}; there are {listed(table.columns)}")
    for role, known in ROLES.items():
        if role in asked:
            continue
        found = [name for name in table.columns if known.fullmatch(_plain(name)) and name not in roles.values()]
        if len(found) > 1:
            raise InputError(
                f"{file} has {len(found)} columns that may be {role} ({listed(found)}); say which: columns {role}=NAME"
            )
        if found:
            roles[role] = found[0]
    for role in ("x", "y"):
        if role not in roles:
            raise InputError(
                f"{file} has no column for {role}; there are {listed(table.columns)}; say which: columns {role}=NAME"
            )
    if "receiver" in roles and "rssi" not in roles:
        raise InputError(
            f"{file} has receivers in column {roles['receiver']!r}, but no RSSI beside; say where: columns rssi=NAME"
        )
    return roles


def _plain(name: str) -> str:
    """The name in small letters and underscores: `Position X [m]` is position_x_m."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _positions(file: Path, table: pd.DataFrame, roles: dict[str, str], notes: list[str]) -> Tensor:
    """Positions of the rows, float64 (n, 3) [m]."""
    x, y = (column_of_numbers(file, table, roles[role]) for role in ("x", "y"))
    if (
        {_plain(roles["x"]), _plain(roles["y"])} & DEGREES
        and np.nanmax(np.abs(x)) <= 180
        and np.nanmax(np.abs(y)) <= 90
    ):
        raise InputError(
            f"{file}: columns {roles['x']} and {roles['y']} hold degrees; give positions in metres, projected to the plane"
        )
    if "z" in roles:
        z = column_of_numbers(file, table, roles["z"])
    elif "floor" in roles:
        z = STOREY * column_of_numbers(file, table, roles["floor"])
        notes.append(f"there is no height, so each floor of column {roles['floor']} counts as {STOREY:g} m")
    else:
        z = np.zeros(len(table))
        notes.append("there is no height, so z is 0 m everywhere")
    position = np.stack([x, y, z], axis=1)
    bad = np.argwhere(~(np.abs(position) <= FARTHEST))  # nan compares false, so it is bad too
    if len(bad):
        row, axis = bad[0]
        raise InputError(
            f"{file} row {row + 1} has no usable {'xyz'[axis]} ({position[row, axis]:g}); positions must be finite numbers "
            f"[m], at most {FARTHEST:g}"
        )
    return torch.from_numpy(position)


def _long(file: Path, table: pd.DataFrame, roles: dict[str, str], position: Tensor) -> tuple[list[str], Tensor, Tensor]:
    """Receivers, RSSI and positions, one row for each time and place; of several packets of a receiver there, each has a
    row."""
    receiver = _text(table[roles["receiver"]])
    nameless = (receiver == "").to_numpy().nonzero()[0]
    if len(nameless):
        raise InputError(f"{file} row {nameless[0] + 1} has no receiver in column {roles['receiver']}")
    heard = column_of_numbers(file, table, roles["rssi"])
    _check_powers(file, heard[:, None], receiver.to_numpy()[:, None])
    keys = pd.DataFrame(position.numpy(), columns=list("xyz"))
    if "time" in roles:
        keys["time"] = _text(table[roles["time"]]).to_numpy()
    keys["repeat"] = keys.assign(receiver=receiver.to_numpy()).groupby([*keys.columns, "receiver"]).cumcount()
    row = keys.groupby(list(keys.columns), sort=False).ngroup().to_numpy()
    column, names = pd.factorize(receiver)
    n = int(row.max()) + 1
    _check_size(file, n, len(names))
    values = np.full((n, len(names)), np.nan)
    values[row, column] = heard
    where = np.empty(n, dtype=np.int64)
    where[row] = np.arange(len(row))
    return list(names), torch.from_numpy(values), position[torch.from_numpy(where)]


def _text(column: pd.Series) -> pd.Series:
    """Its cells as text, empty where there is nothing."""
    return column.astype(object).where(column.notna(), "").astype(str).str.strip()


def _wide(
    file: Path, table: pd.DataFrame, roles: dict[str, str], asked: Mapping[str, str], notes: list[str]
) -> tuple[list[str], Tensor]:
    """Receivers and RSSI: the columns that match what was asked for, or all that hold nothing but RSSI."""
    others = [name for name in table.columns if name not in roles.values() or name == roles.get("rssi")]
    if "rssi" in asked:
        names = [asked["rssi"]] if asked["rssi"] in others else fnmatch.filter(others, asked["rssi"])
    else:
        names = [name for name in others if _is_rssi(table[name])]
        unused = [name for name in others if name not in names]
        if unused:
            notes.append(f"columns that hold no RSSI in dBm are not used: {listed(unused)}")
    if not names:
        raise InputError(
            f"{file} has no column of RSSI in dBm (numbers below 0) besides positions; there are {listed(table.columns)}; "
            "say which: columns rssi=NAME or rssi='PREFIX*'"
        )
    _check_size(file, len(table), len(names))
    values = np.stack([column_of_numbers(file, table, name) for name in names], axis=1)
    _check_powers(file, values, np.broadcast_to(np.array(names, dtype=object), values.shape))
    return names, torch.from_numpy(values)


def _is_rssi(column: pd.Series) -> bool:
    """Whether most of its cells are received powers, or all say that nothing was heard."""
    values, text = parsed(column)
    known = values[~np.isnan(values)]
    if text.sum() > len(known) or not len(known):
        return False
    heard = known[~np.isin(known, SENTINELS)]
    return not len(heard) or LOWEST <= float(np.median(heard)) < 0


def _check_powers(file: Path, values: NDArray[np.float64], receiver: NDArray[np.object_]) -> None:
    """Refuses what is neither a received power nor says that nothing was heard; all (rows of the file, columns)."""
    bad = np.argwhere(((values < LOWEST) | (values > HIGHEST)) & ~np.isin(values, SENTINELS))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{file} row {row + 1}, receiver {receiver[row, column]}: {values[row, column]:g} dBm is no received power; "
            f"expected {LOWEST:g} to {HIGHEST:g}, or {', '.join(f'{v:g}' for v in SENTINELS)} or nothing for not heard"
        )


def _check_size(file: Path, rows: int, receivers: int) -> None:
    if rows * receivers > MOST_VALUES:
        raise InputError(f"{file} has {rows} rows and {receivers} receivers; at most {MOST_VALUES} values are read")


def _heard(file: Path, names: list[str], rssi: Tensor, notes: list[str]) -> tuple[list[str], Tensor]:
    """RSSI with nan for not heard, of the receivers that were heard at all.

    -100 is a measured value where others lie below it, as received powers of wide channels do.
    """
    sentinel = torch.zeros_like(rssi, dtype=torch.bool)
    measured = rssi[~torch.isnan(rssi) & (rssi != SENTINELS[1]) & (rssi != SENTINELS[2])]
    weaker = bool((measured < NOT_HEARD).any())
    for value in SENTINELS:
        if value != NOT_HEARD or not weaker:
            sentinel |= rssi == value
    if weaker and bool((rssi == NOT_HEARD).any()):
        notes.append(f"values below {NOT_HEARD:g} dBm occur, so {NOT_HEARD:g} counts as measured, not as not heard")
    rssi = rssi.masked_fill(sentinel, torch.nan)
    kept = (~rssi.isnan()).any(dim=0).nonzero()[:, 0].tolist()
    if not kept:
        raise InputError(f"{file} holds no heard value of any receiver")
    if len(kept) < len(names):
        notes.append(f"receivers that were never heard are left out: {len(names) - len(kept)}")
    return [names[i] for i in kept], rssi[:, kept]


def _receivers(file: Path, names: list[str]) -> Tensor:
    """Positions of the receivers, float64 (R, 3) [m]; nan where no file tells them."""
    if not file.is_file():
        return torch.full((len(names), 3), torch.nan, dtype=torch.float64)
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
    if not (np.abs(position) <= FARTHEST).all():
        raise InputError(f"{file} needs 3 finite numbers [m], at most {FARTHEST:g}, for each receiver")
    return torch.from_numpy(position)
