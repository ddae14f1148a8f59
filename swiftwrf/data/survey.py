"""Tables of positions and RSSI: the columns of a walk test, recognised by their names.

A wide table has one column a receiver, a long one has one row a packet.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.archives import MAX_UNPACKED_BYTES, refusing_broken
from swiftwrf.data.files import MAX_COORDINATE_M, read_cells
from swiftwrf.errors import InputError, listed

Floats = NDArray[np.float64]
SUFFIXES = (".csv", ".parquet")
SEPARATORS = ",;\t"
EMPTY_CELLS = {"", "nan", "na", "n/a", "null", "none", "-"}
NOT_DETECTED_DBM = -100.0  # a missing value, not a weak one
SENTINELS_DBM = (NOT_DETECTED_DBM, -200.0, 100.0)  # values that tables use for a receiver that detected nothing
MIN_RSSI_DBM, MAX_RSSI_DBM = -150.0, 30.0
STOREY_M = 4.0  # height of a floor, in a table with numbers of floors and no heights
MAX_VALUES = 2**27  # rows x receivers
AXIS = "(?:(?:pos|position|coord|tx)_)?{0}(?:_(?:pos|position|coord))?(?:_m)?"
ROLES = {  # names of columns, in lower case with underscores
    "x": re.compile(AXIS.format("x") + "|easting|longitude|lon"),
    "y": re.compile(AXIS.format("y") + "|northing|latitude|lat"),
    "z": re.compile(AXIS.format("z") + "|(?:height|altitude)(?:_m)?"),
    "floor": re.compile("floor"),
    "time": re.compile("time(?:_s)?|timestamp|t|date(?:_?time)?"),
    "receiver": re.compile("receiver(?:_(?:name|id))?|rx|gateway|ap|bssid|mac|sensor|anchor"),
    "rssi": re.compile("(?:rssi?|rsrp|signal|power)(?:_dbm)?|rss_dbm|dbm"),
}
NAMED_ROLES = tuple(role for role in ROLES if role != "floor")  # roles that a user can assign
DEGREES = {"longitude", "lon", "latitude", "lat"}


class Survey(NamedTuple):
    """Content of a survey table."""

    receiver_names: list[str]
    rssi_dbm: Floats  # (n, R), nan where a receiver detected nothing
    position: Floats  # (n, 3) [m]
    notes: tuple[str, ...]


def read_frame(file: Path) -> pd.DataFrame:
    """Return the table in a CSV or Parquet file. Cells of CSV are text.

    Raises:
        InputError: No such file, or one that is broken, has no rows, or a column without a name of its own.
    """
    if file.suffix.lower() != ".parquet":
        header, rows = read_cells(file, SEPARATORS)
        return pd.DataFrame(rows, columns=header, dtype=object)
    try:
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{file} is Parquet, which pyarrow reads; install it with pip install 'swiftwrf-tasks[formats]'"
        ) from None
    with refusing_broken(file, "a Parquet file"):
        content = parquet.ParquetFile(file)
        groups = range(content.metadata.num_row_groups)
        if (total := sum(content.metadata.row_group(i).total_byte_size for i in groups)) > MAX_UNPACKED_BYTES:
            raise InputError(f"it unpacks to {total} bytes; at most {MAX_UNPACKED_BYTES} are read, so split the data")
        return content.read().to_pandas()


def has_positions(table: pd.DataFrame, columns: Mapping[str, str]) -> bool:
    """Return True if a column of a table holds positions, by its name or by the names of columns given by role."""
    return any(column_of(table, role, columns) is not None for role in ("x", "y"))


def column_of(table: pd.DataFrame, role: str, columns: Mapping[str, str]) -> str | None:
    """Return the first column of a role, by the names of columns given by role or by its own name. None without one."""
    if role in columns:
        return columns[role]
    return next((name for name in map(str, table.columns) if ROLES[role].fullmatch(_plain(name))), None)


def read_survey(label: object, table: pd.DataFrame, columns: Mapping[str, str]) -> Survey:
    """Return receivers, RSSI and positions of a survey table.

    Args:
        label: Name of the table, for messages.
        table: One row a position (wide) or a packet (long).
        columns: Names of columns that are not recognised, by role: x, y, z, time, receiver, rssi.

    Raises:
        InputError: A column that is missing or ambiguous, or a value that is no position or received power.
    """
    table = table.set_axis([str(name).strip() for name in table.columns], axis=1)
    if not len(table) or not table.columns.is_unique:
        raise InputError(f"{label} must have rows, and a name of its own for each column")
    roles = _roles(label, table, columns)
    position, notes = _positions(label, table, roles)
    if "receiver" in roles:
        names, rssi, position = _long(label, table, roles, position)
    else:
        names, rssi = _wide(label, table, roles, columns, notes)
    rssi = _without_sentinels(rssi, notes)
    kept = (~np.isnan(rssi)).any(axis=0)
    if not kept.any():
        raise InputError(f"{label} holds no RSSI that a receiver detected")
    if not kept.all():
        notes.append(f"receivers that never detected the transmitter are left out: {int((~kept).sum())}")
    return Survey([names[i] for i in np.flatnonzero(kept)], rssi[:, kept], position, tuple(notes))


def column_of_numbers(label: object, table: pd.DataFrame, name: str) -> Floats:
    """Return a column as numbers, nan where a cell is empty.

    Raises:
        InputError: A cell holds text.
    """
    values, text = _parsed(table[name])
    if text.any():
        row = int(text.argmax())
        raise InputError(f"{label} row {row + 1}, column {name}: {table[name].iloc[row]!r} is not a number")
    return values


def check_powers(label: object, values: Floats, receiver: NDArray[np.object_], sentinels: tuple[float, ...]) -> None:
    """Refuse values (rows, columns) that are neither received powers nor sentinels; `receiver` names each of them.

    Raises:
        InputError: The first such value, with its row and receiver.
    """
    bad = np.argwhere(~((values >= MIN_RSSI_DBM) & (values <= MAX_RSSI_DBM)) & ~np.isin(values, sentinels))
    if len(bad):
        row, column = bad[0]
        name = np.broadcast_to(receiver, values.shape)[row, column]
        raise InputError(
            f"{label} row {row + 1}, receiver {name}: {values[row, column]:g} dBm is no received power; expected "
            f"{MIN_RSSI_DBM:g} to {MAX_RSSI_DBM:g}, or {', '.join(f'{v:g}' for v in sentinels)} for not detected"
        )


def _roles(label: object, table: pd.DataFrame, asked: Mapping[str, str]) -> dict[str, str]:
    """Return the column of each role: the one asked for, or else the one with a known name."""
    for role in asked:
        if role not in NAMED_ROLES:
            raise InputError(f"columns takes {', '.join(NAMED_ROLES)}, got {role!r}")
    roles = {role: name for role, name in asked.items() if name in table.columns}
    for role, name in asked.items():
        pattern = role == "rssi" and fnmatch.filter(table.columns, name)
        if role not in roles and not pattern:
            raise InputError(f"{label} has no column {name!r} for {role}; there are {listed(table.columns)}")
    for role, known in ROLES.items():
        found = [name for name in table.columns if known.fullmatch(_plain(name)) and name not in roles.values()]
        if role in asked or not found:
            continue
        if len(found) > 1:
            raise InputError(
                f"{label} has {len(found)} columns that may be {role} ({listed(found)}); say which: columns {role}=NAME"
            )
        roles[role] = found[0]
    for role in ("x", "y"):
        if role not in roles:
            raise InputError(
                f"{label} has no column for {role}; there are {listed(table.columns)}; say which: columns {role}=NAME"
            )
    if "receiver" in roles and "rssi" not in roles:
        raise InputError(
            f"{label} has receivers in column {roles['receiver']!r}, but no RSSI beside; say where: columns rssi=NAME"
        )
    return roles


def _plain(name: str) -> str:
    """Return the name in lower case with underscores: `Position X [m]` becomes position_x_m."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _positions(label: object, table: pd.DataFrame, roles: dict[str, str]) -> tuple[Floats, list[str]]:
    """Return the positions of the rows (n, 3) [m], and notes on heights that are missing."""
    x, y = (column_of_numbers(label, table, roles[role]) for role in ("x", "y"))
    degrees = {_plain(roles["x"]), _plain(roles["y"])} & DEGREES
    if degrees and np.nanmax(np.abs(x)) <= 180 and np.nanmax(np.abs(y)) <= 90:
        raise InputError(
            f"{label}: columns {roles['x']} and {roles['y']} hold degrees; give positions in metres, projected to the plane"
        )
    notes = []
    if "z" in roles:
        z = column_of_numbers(label, table, roles["z"])
    elif "floor" in roles:
        z = STOREY_M * column_of_numbers(label, table, roles["floor"])
        notes.append(f"there is no height, so each floor of column {roles['floor']} counts as {STOREY_M:g} m")
    else:
        z = np.zeros(len(table))
        notes.append("there is no height, so z is 0 m everywhere")
    position = np.stack([x, y, z], axis=1)
    bad = np.argwhere(~(np.abs(position) <= MAX_COORDINATE_M))  # nan compares false, so it is bad too
    if len(bad):
        row, axis = bad[0]
        raise InputError(
            f"{label} row {row + 1} has no usable {'xyz'[axis]} ({position[row, axis]:g}); positions must be finite numbers "
            f"[m], at most {MAX_COORDINATE_M:g}"
        )
    return position, notes


def _long(
    label: object, table: pd.DataFrame, roles: dict[str, str], position: Floats
) -> tuple[list[str], Floats, Floats]:
    """Return receivers, RSSI and positions with one row for each time and place; repeated packets have a row each."""
    receiver = _text(table[roles["receiver"]])
    nameless = (receiver == "").to_numpy().nonzero()[0]
    if len(nameless):
        raise InputError(f"{label} row {nameless[0] + 1} has no receiver in column {roles['receiver']}")
    power = column_of_numbers(label, table, roles["rssi"])
    check_powers(label, _filled(power[:, None]), receiver.to_numpy()[:, None], SENTINELS_DBM)
    keys = pd.DataFrame(position, columns=list("xyz"))
    if "time" in roles:
        keys["time"] = _text(table[roles["time"]]).to_numpy()
    keys["repeat"] = keys.assign(receiver=receiver.to_numpy()).groupby([*keys.columns, "receiver"]).cumcount()
    row = keys.groupby(list(keys.columns), sort=False).ngroup().to_numpy()
    column, names = pd.factorize(receiver)
    _, first = np.unique(row, return_index=True)
    _check_size(label, len(first), len(names))
    values = np.full((len(first), len(names)), np.nan)
    values[row, column] = power
    return list(names), values, position[first]


def _text(column: pd.Series) -> pd.Series:
    """Return the cells as text, empty for missing ones."""
    return column.astype(object).where(column.notna(), "").astype(str).str.strip()


def _wide(
    label: object, table: pd.DataFrame, roles: dict[str, str], asked: Mapping[str, str], notes: list[str]
) -> tuple[list[str], Floats]:
    """Return receivers and RSSI: the columns that match the name asked for, or all that hold RSSI only."""
    others = [name for name in table.columns if name not in roles.values() or name == roles.get("rssi")]
    if "rssi" in asked:
        names = [asked["rssi"]] if asked["rssi"] in others else fnmatch.filter(others, asked["rssi"])
    else:
        names = [name for name in others if _is_rssi(table[name])]
        if unused := [name for name in others if name not in names]:
            notes.append(f"columns that hold no RSSI in dBm are not used: {listed(unused)}")
    if not names:
        raise InputError(
            f"{label} has no column of RSSI in dBm (numbers below 0) besides positions; there are {listed(table.columns)}; "
            "say which: columns rssi=NAME or rssi='PREFIX*'"
        )
    _check_size(label, len(table), len(names))
    values = np.stack([column_of_numbers(label, table, name) for name in names], axis=1)
    check_powers(label, _filled(values), np.array(names, dtype=object), SENTINELS_DBM)
    return names, values


def _filled(values: Floats) -> Floats:
    return np.nan_to_num(values, nan=NOT_DETECTED_DBM, posinf=np.inf, neginf=-np.inf)


def _parsed(column: pd.Series) -> tuple[Floats, NDArray[np.bool_]]:
    """Return numbers, nan elsewhere, and a mask of cells that hold text."""
    if column.dtype.kind in "biuf":
        return column.to_numpy(np.float64), np.zeros(len(column), dtype=bool)
    cells = column.astype(str).str.strip()
    values = pd.to_numeric(cells, errors="coerce").to_numpy(np.float64)
    empty = column.isna().to_numpy() | cells.str.lower().isin(EMPTY_CELLS).to_numpy()
    return np.where(empty, np.nan, values), np.isnan(values) & ~empty


def _is_rssi(column: pd.Series) -> bool:
    """Return True if most cells are received powers, or all numbers are sentinels."""
    values, text = _parsed(column)
    known = values[~np.isnan(values)]
    if text.sum() > len(known) or not len(known):
        return False
    power = known[~np.isin(known, SENTINELS_DBM)]
    return not len(power) or MIN_RSSI_DBM <= float(np.median(power)) < 0


def _check_size(label: object, rows: int, receivers: int) -> None:
    if rows * receivers > MAX_VALUES:
        raise InputError(f"{label} has {rows} rows and {receivers} receivers; at most {MAX_VALUES} values are read")


def _without_sentinels(rssi: Floats, notes: list[str]) -> Floats:
    """Return RSSI with nan in place of sentinels. -100 dBm is a measured value if weaker ones occur."""
    always = np.isin(rssi, SENTINELS_DBM[1:])
    weaker = bool((rssi[~always] < NOT_DETECTED_DBM).any())
    if weaker and bool((rssi == NOT_DETECTED_DBM).any()):
        notes.append(f"values below {NOT_DETECTED_DBM:g} dBm occur, so {NOT_DETECTED_DBM:g} counts as measured")
    return np.where(always | ((rssi == NOT_DETECTED_DBM) & (not weaker)), np.nan, rssi)
