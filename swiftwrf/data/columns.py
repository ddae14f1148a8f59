"""Columns of tables: what they hold, recognised by their names, and their cells as numbers, text and groups of rows.

A filler is a constant where a receiver detected nothing: 0, 100, 127 (Bluetooth: not available), -100, or a value just below
the weakest measurement. It is recognised by its place at the edge of all values and by its frequency.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.errors import InputError, listed

Floats = NDArray[np.float64]
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
    "receiver": re.compile("receiver(?:_(?:name|id))?|rx|gateway|ap(?:_(?:name|id))?|bssid|mac|sensor|anchor"),
    "rssi": re.compile("(?:rssi?|rsrp|signal|power)(?:_dbm)?|rss_dbm|dbm"),
}
EPOCH_UNITS = (  # of times since 1970 by their size, from the year 1973 on
    ("milliseconds", 1e3, 1e11, 1e14),
    ("microseconds", 1e6, 1e14, 1e17),
    ("nanoseconds", 1e9, 1e17, 1e20),
)
GEODETIC = {"x": "longitude", "y": "latitude"}  # that take the place of x and y
NOT_DETECTED_DBM = -100.0  # the usual filler
KNOWN_FILLERS = (NOT_DETECTED_DBM, -200.0, 0.0, 100.0, 127.0)
MIN_RSSI_DBM, MAX_RSSI_DBM = -150.0, 30.0
# a frequent value from -1 dBm on is a filler, unless values within 10 dB are as frequent
N_NEIGHBOURS_DB = 5  # of the next stronger values that a filler at the lower edge is compared with
MIN_REPEATS = 5  # cells with a filler that is not known
MIN_VALUES = 5  # different values that are left


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
    empty = column.isna().to_numpy() | cells.str.lower().isin({"", "nan", "na", "n/a", "null", "none", "-"}).to_numpy()
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


def find_fillers(rssi: Floats) -> list[float]:
    """Return the values in a table of RSSI (n, R) [dBm] that stand for "not detected", apart from nan and -inf.

    Example:
        >>> find_fillers(np.array([[-60.0, 127.0], [-70.0, -65.0], [0.0, -80.0]]))
        [127.0, 0.0]
    """
    value, count = np.unique(rssi[rssi > -np.inf], return_counts=True)
    impossible = (value < MIN_RSSI_DBM) | (value > MAX_RSSI_DBM)
    is_filler = impossible & np.isin(value, KNOWN_FILLERS)
    if (others := impossible & ~is_filler).sum() == 1:
        is_filler |= others & (count >= MIN_REPEATS)
    found: list[float] = value[is_filler].tolist()
    value, count = value[~impossible], count[~impossible]
    while len(value) and value[-1] >= -1.0 and _is_frequent(value, count, len(value) - 1, 10.0):
        found.append(float(value[-1]))
        value, count = value[:-1], count[:-1]
    usual = np.flatnonzero(value == NOT_DETECTED_DBM)
    if len(usual) and (usual[0] == 0 or _is_frequent(value, count, int(usual[0]), N_NEIGHBOURS_DB)):
        found.append(NOT_DETECTED_DBM)
    elif _fills_the_lower_edge(rssi, value, count):
        found.append(float(value[0]))
    return found


def has_frequent_edge(rssi: Floats) -> bool:
    """Return True if the least of the values of a receiver (n,) [dBm] is far more frequent than those above it.

    Example:
        >>> has_frequent_edge(np.array([-90.0] * 9 + [-89, -88, -87, -80, -75, -70, -60]))
        True
    """
    value, count = np.unique(rssi, return_counts=True)
    if len(value) <= MIN_VALUES or int(count[0]) < 0.2 * len(rssi):
        return False
    return _is_frequent(value, count, 0, N_NEIGHBOURS_DB)


def _is_frequent(value: Floats, count: NDArray[np.int64], index: int, within_db: float) -> bool:
    """Return True if a value is much more frequent than every other one within a distance, in bins of 1 dB."""
    near = np.abs(value - value[index]) <= within_db
    near[index] = False
    bins = np.bincount((value[near] - value[index] + within_db).round().astype(int), count[near], minlength=1)
    return bool(count[index] > 3.0 * bins.max())


def _fills_the_lower_edge(rssi: Floats, value: Floats, count: NDArray[np.int64]) -> bool:
    """Return True if the least value is frequent, and the least of most receivers."""
    if len(value) <= MIN_VALUES or count[0] < MIN_REPEATS or not _is_frequent(value, count, 0, N_NEIGHBOURS_DB):
        return False
    weakest = np.where((rssi >= MIN_RSSI_DBM) & (rssi <= MAX_RSSI_DBM), rssi, np.inf).min(axis=0)
    return bool((weakest[np.isfinite(weakest)] == value[0]).mean() > 0.5)  # near receivers detect every row


def without_fillers(rssi: Floats, fillers: list[float]) -> tuple[Floats, list[str]]:
    """Return RSSI (n, R) with nan in place of fillers and of -inf, and a note on each of them.

    Example:
        >>> without_fillers(np.array([[-60.0, 127.0]]), [127.0])
        (array([[-60.,  nan]]), ['127 counts as not detected: 1 of 2 cells (50%)'])
    """
    notes = []
    filled = np.zeros(rssi.shape, dtype=bool)
    for filler in [-np.inf, *fillers]:
        cells = rssi == filler
        if n := int(cells.sum()):
            notes.append(f"{filler:g} counts as not detected: {n} of {rssi.size} cells ({n / rssi.size:.0%})")
        filled |= cells
    if NOT_DETECTED_DBM not in fillers and (n := int((rssi == NOT_DETECTED_DBM).sum())):
        notes.append(f"{NOT_DETECTED_DBM:g} dBm counts as measured: {n} cells")
    return np.where(filled, np.nan, rssi), notes


def check_powers(label: object, rssi: Floats, receivers: Sequence[str], source: NDArray[np.int64]) -> None:
    """Refuse RSSI (n, R) that is no received power.

    Args:
        label: Name of the table, for messages.
        rssi: Values, (n, R) [dBm], nan where not detected.
        receivers: R names.
        source: Row of each value in the table, counted from 0, (n, R) or (n, 1).

    Raises:
        InputError: The first such value, with its row and receiver.
    """
    bad = (rssi < MIN_RSSI_DBM) | (rssi > MAX_RSSI_DBM)
    if not bad.any():
        return
    rows = np.broadcast_to(source, rssi.shape)
    row, column = min(np.argwhere(bad), key=lambda cell: rows[tuple(cell)])
    value = rssi[row, column]
    raise InputError(
        f"{label} row {rows[row, column] + 1}, receiver {receivers[column]}: {value:g} dBm is no received power; expected "
        f"{MIN_RSSI_DBM:g} to {MAX_RSSI_DBM:g}; if it stands for not detected, give nan or --filler {value:g}"
    )


def numbered(names: Tensor | Sequence[str | int]) -> Tensor:
    """Return the number of each name in the order of first occurrence, int64 (n,); numbers of a tensor stay.

    Example:
        >>> numbered(["out", "back", "out"])
        tensor([0, 1, 0])
    """
    if isinstance(names, Tensor):
        return names.long()
    return torch.from_numpy(pd.factorize(np.asarray(names, dtype=object))[0].astype(np.int64))


@dataclass(frozen=True, eq=False)
class Groups:
    """Groups of rows between which RSSI has constant offsets, e.g. devices or channels.

    Args:
        column: Name of the column with the groups' names.
        names: Names of the groups.
        code: Group of each row, int64 (n,).
    """

    column: str
    names: tuple[str, ...]
    code: Tensor

    @classmethod
    def of(cls, column: str, values: Sequence[str]) -> Groups:
        """Return the groups of n rows by their values in a column."""
        code, names = pd.factorize(np.asarray(values, dtype=object), sort=True)
        return cls(column, tuple(map(str, names)), torch.from_numpy(code.astype(np.int64)))

    def __len__(self) -> int:
        return len(self.code)

    def subset(self, rows: Tensor) -> Groups:
        """Return the groups of the given rows."""
        return replace(self, code=self.code[rows])

    def labels(self) -> list[str]:
        """Return the name of each row's group."""
        return [self.names[code] for code in self.code.tolist()]
