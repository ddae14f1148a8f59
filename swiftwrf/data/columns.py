"""Columns of tables: what they hold, recognised by their names, and their cells as numbers and text."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.fillers import KNOWN_FILLERS, MIN_RSSI_DBM
from swiftwrf.errors import InputError, listed

Floats = NDArray[np.float64]
EMPTY_CELLS = {"", "nan", "na", "n/a", "null", "none", "-"}
END = "pos|position|coord|tx|rx|transmitter|receiver"
AXIS = f"(?:(?:{END})_)?{{0}}(?:_(?:{END}))?(?:_m)?"
ROLES = {  # names of columns, in lower case with underscores
    "x": re.compile(AXIS.format("x") + "|east(?:ing)?|e_?coord"),
    "y": re.compile(AXIS.format("y") + "|north(?:ing)?|n_?coord"),
    "z": re.compile(AXIS.format("z") + "|(?:height|alt|altitude|elevation)_?(?:m|meters|metres)?"),
    "longitude": re.compile("(?:gps_?|current_?)?(?:lon|lng|long|longitude)(?:_deg(?:rees)?)?"),
    "latitude": re.compile("(?:gps_?|current_?)?(?:lat|latitude)(?:_deg(?:rees)?)?"),
    "floor": re.compile("floor(?:_?id)?"),
    "time": re.compile("time(?:_s)?|timestamp|t|date(?:_?time)?|first_?seen"),
    "session": re.compile("(?:session|run|walk)(?:_?id)?"),
    "receiver": re.compile("receiver(?:_(?:name|id))?|rx|gateway|ap|bssid|mac|sensor|anchor"),
    "rssi": re.compile("(?:rssi?|rsrp|signal|power)(?:_dbm)?|rss_dbm|dbm"),
}
EPOCH_UNITS = (  # of times since 1970 by their size, from the year 1973 on
    ("milliseconds", 1e3, 1e11, 1e14),
    ("microseconds", 1e6, 1e14, 1e17),
    ("nanoseconds", 1e9, 1e17, 1e20),
)
GEODETIC = {"x": "longitude", "y": "latitude"}  # that take the place of x and y


def column_of(table: pd.DataFrame, role: str, columns: Mapping[str, str]) -> str | None:
    """Return the first column of a role, by the names of columns given by role or by its own name. None without one."""
    return columns[role] if role in columns else next(iter(candidates(table, role)), None)


def candidates(table: pd.DataFrame, role: str) -> list[str]:
    """Return the columns whose names are of a role. A column of powers does not hold names of receivers."""
    found = [name for name in map(str, table.columns) if ROLES[role].fullmatch(plain_name(name))]
    return [name for name in found if role != "receiver" or not is_rssi(table[name])]


def column_of_numbers(label: object, table: pd.DataFrame, name: str) -> Floats:
    """Return a column as numbers, nan where a cell is empty.

    Raises:
        InputError: A cell holds text.
    """
    values, text = parsed(table[name])
    if text.any():
        row = int(text.argmax())
        raise InputError(f"{label} row {row + 1}, column {name}: {table[name].iloc[row]!r} is not a number")
    return values


def find_roles(
    label: object, table: pd.DataFrame, asked: Mapping[str, str], taken: Collection[str] = ()
) -> dict[str, str]:
    """Return the column of each role: the one asked for, or else the one with a known name that is not taken."""
    for role in asked:
        if role not in ROLES:
            raise InputError(f"columns takes {', '.join(ROLES)}, got {role!r}")
    roles = {role: name for role, name in asked.items() if name in table.columns}
    for role, name in asked.items():
        pattern = role == "rssi" and fnmatch.filter(table.columns, name)
        if role not in roles and not pattern:
            raise InputError(f"{label} has no column {name!r} for {role}; there are {listed(table.columns)}")
    for role in ROLES:
        found = [name for name in candidates(table, role) if name not in (*roles.values(), *taken)]
        if role in asked or not found:
            continue
        if len(found) > 1:
            raise InputError(
                f"{label} has {len(found)} columns that may be {role} ({listed(found)}); choose one with columns {role}=NAME"
            )
        roles[role] = found[0]
    for role, other in GEODETIC.items():
        if other in roles and role in roles:
            del roles[other]
        if role not in roles and other not in roles:
            raise InputError(
                f"{label} has no column for {role}; there are {listed(table.columns)}; choose one with columns {role}=NAME"
            )
    if "receiver" in roles and "rssi" not in roles:
        raise InputError(
            f"{label} has receivers in column {roles['receiver']!r}, but no RSSI beside; name it with columns rssi=NAME"
        )
    return roles


def plain_name(name: str) -> str:
    """Return the name in lower case with underscores: `Position X [m]` becomes position_x_m."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def text_of(column: pd.Series) -> pd.Series:
    """Return the cells as text, empty for missing ones."""
    return column.astype(object).where(column.notna(), "").astype(str).str.strip()


def parsed(column: pd.Series) -> tuple[Floats, NDArray[np.bool_]]:
    """Return numbers, nan elsewhere, and a mask of cells that hold text."""
    if column.dtype.kind in "biuf":
        return column.to_numpy(np.float64), np.zeros(len(column), dtype=bool)
    cells = column.astype(str).str.strip()
    values = pd.to_numeric(cells, errors="coerce").to_numpy(np.float64)
    empty = column.isna().to_numpy() | cells.str.lower().isin(EMPTY_CELLS).to_numpy()
    return np.where(empty, np.nan, values), np.isnan(values) & ~empty


def seconds(column: pd.Series) -> tuple[Floats, list[str]]:
    """Return times [s] since the first cell, nan where a cell is no time, and a note on their unit.

    Cells are dates or numbers [s]. Numbers as large as milliseconds, microseconds or nanoseconds since 1970 are these.

    Example:
        >>> seconds(pd.Series(["2024-01-01 10:00:00", "2024-01-01 10:01:00", "noon"]))
        (array([ 0., 60., nan]), [])
        >>> seconds(pd.Series([1_700_000_000_000, 1_700_000_000_500], name="time"))
        (array([0. , 0.5]), ['column time counts milliseconds since 1970, which are converted to seconds'])
    """
    notes = []
    values = np.full(len(column), np.nan) if column.dtype.kind == "M" else parsed(column)[0]
    if np.isnan(values).all():
        date = pd.to_datetime(column, errors="coerce", utc=True, format="mixed")
        values = (date - date.min()).dt.total_seconds().to_numpy(np.float64)
    size = np.nanmedian(values) if np.isfinite(values).any() else 0.0
    for unit, factor, low, high in EPOCH_UNITS:
        if low <= size < high:
            values = values / factor
            notes.append(f"column {column.name} counts {unit} since 1970, which are converted to seconds")
    return values - values[0] if len(values) and np.isfinite(values[0]) else values, notes


def is_rssi(column: pd.Series) -> bool:
    """Return True if most cells are received powers or fillers, whatever the number of these."""
    values, text = parsed(column)
    known = np.unique(values[~np.isnan(values)])
    if not len(known) or text.sum() > np.isfinite(values).sum():
        return False
    power = known[~np.isin(known, KNOWN_FILLERS) & np.isfinite(known)]
    if not len(power):
        return bool((known != 0).any())
    below = power[power < 0]
    mostly_below = len(power) - len(below) <= 1 or np.median(power) < 0
    return bool(mostly_below and len(below) and np.median(below) >= MIN_RSSI_DBM)


def is_coordinate(name: str) -> bool:
    """Return True for the name of a column with a coordinate."""
    return any(ROLES[role].fullmatch(plain_name(name)) for role in ("x", "y", "z", "longitude", "latitude"))
