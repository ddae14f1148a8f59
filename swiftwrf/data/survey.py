"""Tables of positions and RSSI: the columns of a walk test, recognised by their names.

A wide table has one column a receiver, a long one has one row a packet. Both ends of a link may move, and radios of one
access point may be pooled. Positions of receivers are in tables, too.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.cells import (
    CLOCK_ONLY,
    PIXELS,
    UNITS,
    column_of_numbers,
    parsed,
    plain_name,
    seconds,
    text_of,
    unit_of,
)
from swiftwrf.data.columns import (
    GEODETIC,
    Groups,
    candidates,
    check_receiver_known,
    column_of,
    find_roles,
    receiver_columns,
)
from swiftwrf.data.coordinates import (
    STOREY_M,
    Coordinates,
    GeodeticOrigin,
    PlanFrame,
    Up,
    degrees_in,
    floor_numbers,
    floors_of,
    height_of_floors,
    plain_degrees,
    stated_scale,
    without_fix,
)
from swiftwrf.data.files import read_table
from swiftwrf.data.powers import MIN_REPEATS, check_powers, end_of_scale, find_fillers, without_fillers
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import cells, check_positions

Floats = NDArray[np.float64]
MAX_VALUES = 2**27  # rows x receivers
MARKS = {"tx": "transmitter", "transmitter": "transmitter", "rx": "receiver", "receiver": "receiver"}  # words in names
MAC = "mac"  # pools radios by the first five bytes of their addresses
ADDRESS = re.compile(r"((?:[0-9a-f]{2}[:-]?){4}[0-9a-f]{2})[:-]?[0-9a-f]{2}", re.IGNORECASE)
MAX_FROM_ORIGIN_DEG = 2.0  # of receivers in degrees
MIN_EXTENT_OF_WALK_M = 3.0
MAX_SPEED_OF_MILLISECONDS, MAX_STEP_M = 2e-3, 1.0  # [m/s] if they were seconds, and between rows of a log of movement
N_PHASES = 20  # of windows that are compared
MIN_REPEATED_RECEIVERS, MIN_REPEATED = 3, 0.05  # with the same values, and fraction of rows, of scans that are repeated


def has_positions(table: pd.DataFrame, columns: Mapping[str, str]) -> bool:
    """Return True if a column of a table holds positions, by its name or by the names of columns given by role."""
    return any(column_of(table, role, columns) is not None for role in ("x", "y", *GEODETIC.values()))


def read_survey(
    label: object,
    table: pd.DataFrame,
    *,
    columns: Mapping[str, str] | None = None,
    filler: Sequence[float] | None = None,
    coordinates: Coordinates | None = None,
    offset_by: str | None = None,
    transmitter: Sequence[str] = (),
    pool_by: str | None = None,
    scale: float | None = None,
    y_down: bool = False,
    up: Up = "z",
    window: float | None = None,
    receivers: Path | None = None,
    keeps_rows: bool = False,
) -> dict[str, Any]:
    """Return the arguments of `Rssi` that a survey table determines: RSSI, positions, receivers and what rows are of.

    Columns get their roles, cells their units, and then rows are formed: one a place, time and packet of a receiver. The
    label names the table in messages. Options are those of `load_rssi`, receivers is a table of their positions. With
    keeps_rows, repeated scans stay.

    Raises:
        InputError: A column that is missing or ambiguous, or a value that is no position or received power.
    """
    notes = list(table.attrs.get("notes", ()))
    table = table.set_axis([str(name).strip() for name in table.columns], axis=1).reset_index(drop=True)
    if not len(table) or not table.columns.is_unique:
        raise InputError(f"{label} must have rows, and a name of its own for each column")
    if offset_by is not None and offset_by not in table.columns:
        raise InputError(f"{label} has no column {offset_by!r} for offsets; there are {listed(table.columns)}")
    kept_for = {offset_by, pool_by}
    table, roles, names, end, unused, found = _roles(label, table, dict(columns or {}), transmitter, kept_for)
    notes += found

    coordinate, frame, found = _coordinates(label, table, roles, PlanFrame(scale, y_down, up))
    notes += found
    if end:
        coordinate = np.hstack([coordinate, _coordinates(label, table, end, frame)[0]])
        coordinate[np.isnan(coordinate).any(axis=1)] = np.nan
    group = text_of(table[offset_by]) if offset_by else pd.Series([""] * len(table))
    session = text_of(table[roles["session"]]) if "session" in roles else None
    apart = group if session is None else group + "\n" + session
    if "receiver" in roles:
        names, rssi, source, coordinate, found = _long(label, table, roles, coordinate, apart)
    else:
        _check_size(label, len(table), len(names))
        rssi, found = _power_of(label, table, names)
        source = np.arange(len(table))[:, None]
    fillers = find_fillers(rssi) if filler is None else list(filler)
    rssi, filled = without_fillers(rssi, fillers)
    check_powers(label, rssi, names, source)
    notes += found + filled + end_of_scale(rssi)
    if pool_by is not None:
        n_radios, pools = len(names), _pools(label, table, roles, names, pool_by)
        names, rssi = pooled(rssi, pools)
        notes.append(f"{n_radios} radios are pooled into {len(names)} receivers by {pool_by}: mean of their powers")

    omitted, missing = without_fix(coordinate[:, :3])
    if omitted.all():
        raise InputError(f"{label} has no row with a position; {missing[0]}")
    row = np.flatnonzero(~omitted)
    repeated = _repeated_scans(coordinate[row], rssi[row])
    if repeated.any():
        missing.append(
            f"rows that repeat all values of the row before at another place, as cached scans do, "
            f"{'stay because of the given splits' if keeps_rows else 'are left out'}: {int(repeated.sum())} of {len(row)}"
        )
        row = row if keeps_rows else row[~repeated]
    notes += missing
    position, origin, found = _local_metres(label, table, roles, coordinate[row], coordinates)
    notes += found
    kept = (~np.isnan(rssi[row])).any(axis=0)
    if not kept.any():
        raise InputError(f"{label} holds no RSSI that a receiver detected")
    if not kept.all():
        notes.append(f"receivers that never detected the transmitter are left out: {int((~kept).sum())}")
    names, rssi, places = [names[i] for i in np.flatnonzero(kept)], rssi[row][:, kept], None
    origins = source.max(axis=1)[row]  # row of the table that each row is of
    time, found = _times(table.iloc[origins], roles, position)
    notes += found
    if window is not None:
        if time is None:
            raise InputError(f"{label} has no column of times, which a window of {window:g} s needs; leave it out")
        first, rssi, position, time = _windows(apart.to_numpy()[origins], time, rssi, position, window)
        notes.append(f"{len(row)} rows are joined to {len(first)} by their mean in windows of {window:g} s")
        row, origins = row[first], origins[first]
    elif time is not None:
        notes += _split_packets(rssi, time)
    floors = None
    if "floor" in roles:
        floors = floors_of(text_of(table[roles["floor"]]).iloc[origins].tolist(), position[:, 2])
    if end:
        names, rssi, position, places, found = as_receivers(label, rssi, position)
        notes += found
    groups = Groups.of(offset_by, group.to_numpy()[origins].tolist()) if offset_by else None
    sessions = None if session is None else session.to_numpy()[origins].tolist()
    # columns with few different values, each of them in several rows, that are no other names of the receivers
    times = {name: text_of(table[name]).value_counts() for name in (*unused, roles.get("session")) if name}
    if "receiver" in roles:
        several = table.groupby(roles["receiver"])[list(times)].nunique().max() > 1
        times = {name: count for name, count in times.items() if several[name]}
    labels = tuple(name for name, count in times.items() if 2 <= len(count) <= 30 and int(count.min()) >= 10)
    if labels and not offset_by:
        notes.append(f"rows differ in {listed(labels)}; tasks.inspect tests whether its values have constant offsets")
    moves = bool(end or transmitter)
    if moves and not end:
        notes.append(f"both ends move; {len(names)} positions of column {transmitter[0]} count as receivers")
    if receivers is not None and places is None:
        known, found = read_receivers(receivers, names, origin, frame)
        places = known.numpy()
        notes += found
    return {
        "rssi_dbm": rssi,
        "transmitter_position": position,
        "receiver_position": places,
        "receiver_names": names,
        "origin": origin,
        "groups": groups,
        "labels": labels,
        "floors": floors,
        "receiver_moves": moves,
        "plan_scale": frame.scale if frame.y_down else None,
        "session": sessions,
        "time": time,
        "index": row,
        "notes": tuple(notes),
    }


def _roles(
    label: object,
    table: pd.DataFrame,
    asked: dict[str, str],
    transmitter: Sequence[str],
    kept_for: Set[str | None],
) -> tuple[pd.DataFrame, dict[str, str], list[str], dict[str, str], list[str], list[str]]:
    """Return the table, its columns by role, those of receivers if it is wide, of the second end, of no use, and notes.

    Columns of groups and pools are kept for these.
    """
    end = dict[str, str]()
    if len(transmitter) == 1:
        asked["receiver"] = transmitter[0]
    elif transmitter or not {"x", "y"} & asked.keys():
        end = transmitter_columns(label, table, transmitter)
    roles = find_roles(label, table, asked, end.values())
    names, left_out, notes = list[str](), list[str](), list[str]()
    if "receiver" not in roles:
        power = roles.pop("rssi", None)
        others = [name for name in table.columns if name not in {*roles.values(), *end.values(), *kept_for}]
        numbers = {name: values for name in others for values, text in [parsed(table[name])] if not text.any()}
        table = table.assign(**numbers)  # each cell is parsed once
        if "rssi" in asked:
            names = [power] if power else fnmatch.filter(others, asked["rssi"])
        else:
            names, left_out, notes = receiver_columns(table, others)
        if not names:
            raise InputError(
                f"{label} has no column of RSSI in dBm (numbers below 0) besides positions; there are "
                f"{listed(table.columns)}; choose with columns rssi=NAME or rssi='PREFIX*'"
            )
        if len(names) == 1 and "rssi" not in asked and not end:
            place = [roles[role] for role in ("x", "y", "longitude", "latitude", "time") if role in roles]
            check_receiver_known(label, table, names[0], [name for name in others if name not in names], place)
    taken = [f"{role} = {name}" for role, name in roles.items()]
    taken += [f"transmitter {axis} = {name}" for axis, name in end.items()]
    if names:
        taken.append(f"RSSI of {len(names)} receivers = {listed(names)}" if len(names) > 1 else f"RSSI = {names[0]}")
    notes.insert(0, f"taken as: {', '.join(taken)}")
    used = {*roles.values(), *end.values(), *names, *left_out, *kept_for}
    unused = [name for name in table.columns if name not in used]
    if unused:
        notes.append(f"columns that are not used: {listed(unused)}")
    return table, roles, names, end, unused, notes


def _power_of(label: object, table: pd.DataFrame, names: Sequence[str]) -> tuple[Floats, list[str]]:
    """Return the RSSI in columns (n, len(names)), nan where it was not detected, and a note on a word that stands for it.

    Raises:
        InputError: Text that is no such word.
    """
    values, text = (np.stack(part, axis=1) for part in zip(*(parsed(table[name]) for name in names), strict=True))
    words = pd.Series(table[list(names)].to_numpy(dtype=object)[text], dtype=object).astype(str).str.strip()
    if len(words) >= MIN_REPEATS and words.nunique() == 1:
        return values, [f"{words[0]!r} counts as not detected: {len(words)} of {text.size} cells ({text.mean():.0%})"]
    for name in np.array(names)[text.any(axis=0)]:
        column_of_numbers(label, table, name)
    return values, []


def _local_metres(
    label: object, table: pd.DataFrame, roles: dict[str, str], coordinate: Floats, asked: Coordinates | None
) -> tuple[Floats, GeodeticOrigin | None, list[str]]:
    """Return positions (n, 3 or 6) [m] of coordinates that may be degrees, the origin of the metres, and notes."""
    position, origin, notes = coordinate.reshape(-1, 3), None, list[str]()
    both = roles.get("x") or roles["longitude"], roles.get("y") or roles["latitude"]
    named = "longitude" in roles and "latitude" in roles
    if named and asked != "metres":
        plain, notes = plain_degrees(label, both, position[:, :2])
        position = np.column_stack([plain, position[:, 2]])
    check_positions(position, f"positions of {label}")
    if (degrees := degrees_in(label, both, position[:, :2], named, asked)) is not None:
        origin = GeodeticOrigin.amid(degrees)
        x, y = both
        if np.abs(position[:, 1]).max() > 90:  # only a longitude does
            x, y = y, x
        notes.append(f"longitude {x} and latitude {y} are projected to local metres about {origin}")
        position = np.column_stack([origin.to_metres(degrees), position[:, 2]])
    elif "y" in roles and "z" in roles:
        width, depth, height = np.ptp(position, axis=0)
        if depth < height / 5 and min(width, height) > MIN_EXTENT_OF_WALK_M:
            notes.append(
                f"y spans {depth:.1f} m and z {height:.1f} m; if y is the height, give --up y, and else this stands as it is"
            )
    return position.reshape(len(coordinate), -1), origin, notes


def _times(table: pd.DataFrame, roles: dict[str, str], position: Floats) -> tuple[Floats | None, list[str]]:
    """Return the time of each row [s], None without one, and notes on its unit.

    Whole numbers at which the positions move slower than anybody walks, but not in milliseconds, are milliseconds.
    """
    if "time" not in roles:
        return None, []
    column = table[roles["time"]]
    days = [name for name in candidates(table, "time") if plain_name(name) == "date" and name != column.name]
    is_joined = bool(days) and column.dtype.kind not in "biufM" and text_of(column).str.fullmatch(CLOCK_ONLY).all()
    time, notes = seconds(column, table[days[0]] if is_joined else None)
    if is_joined:
        notes.append(f"columns {days[0]} and {column.name} together are the time")
    if not notes and np.isfinite(time).all() and len(time) > MIN_REPEATS and (parsed(column)[0] % 1 == 0).all():
        order = np.argsort(time, kind="stable")
        step, length = np.diff(time[order]), np.linalg.norm(np.diff(position[order, :3], axis=0), axis=1)
        speed = length[step > 0].sum() / max(step.sum(), 1e-9)
        if 1e-5 < speed < MAX_SPEED_OF_MILLISECONDS and np.median(length) < MAX_STEP_M:
            time = time / 1e3
            notes.append(
                f"column {column.name} counts milliseconds, which are converted to seconds: as seconds, the positions move "
                f"{1e3 * speed:.1g} mm/s"
            )
    return time, notes


def _repeated_scans(coordinate: Floats, rssi: Floats) -> NDArray[np.bool_]:
    """Return which rows repeat the RSSI of the row before at another place. None are, if few do."""
    before = np.isnan(rssi[:-1]) & np.isnan(rssi[1:]) | (rssi[:-1] == rssi[1:])
    top = np.nanmax(rssi) if end_of_scale(rssi) else np.inf  # which repeats by chance
    several = (rssi[1:] < top).sum(axis=1) >= MIN_REPEATED_RECEIVERS
    repeated = np.append(False, before.all(axis=1) & several & (coordinate[1:, :2] != coordinate[:-1, :2]).any(axis=1))
    enough = repeated.sum() >= max(MIN_REPEATS, MIN_REPEATED * len(rssi))
    return repeated if enough else np.zeros_like(repeated)


def _split_packets(rssi: Floats, time: Floats) -> list[str]:
    """Return a note on rows of one receiver each that follow each other within a second, or none."""
    if rssi.shape[1] < 2 or len(rssi) < MIN_REPEATS or not np.isfinite(time).all():
        return []
    alone = float(((~np.isnan(rssi)).sum(axis=1) == 1).mean())
    step = float(np.median(np.diff(np.sort(time))))
    if alone < 0.9 or not step < 1:
        return []
    return [
        f"rows hold the packet of one receiver each, {step:.2g} s after the row before; --window 1 joins the packets of a "
        "second"
    ]


def _windows(
    kind: NDArray[Any], time: Floats, rssi: Floats, position: Floats, window: float
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Return the first row, and mean RSSI [dBm], position and time of the rows in each window. Kinds are kept apart.

    Windows begin where the cycles of the receivers do: where they contain the fewest packets of one receiver twice.
    """
    alone = -1.0 - np.arange(len(time))  # rows without a time
    row, receiver = np.nonzero(~np.isnan(rssi))
    most = -1
    for phase in np.linspace(0, 1, N_PHASES, endpoint=False):
        place = np.where(np.isnan(time), alone, np.floor((time - np.nanmin(time)) / window + phase))
        keys = pd.DataFrame({"kind": kind, "window": place})
        tried = keys.groupby(["kind", "window"], sort=False).ngroup().to_numpy()
        if (n := len(np.unique(tried[row] * rssi.shape[1] + receiver))) > most:
            most, number = n, tried
    _, first = np.unique(number, return_index=True)
    n_rssi, n_position = rssi.shape[1], position.shape[1]
    means = pd.DataFrame(np.column_stack([rssi, position, time])).groupby(number).mean().to_numpy()
    return first, means[:, :n_rssi], means[:, n_rssi : n_rssi + n_position], means[:, -1]


def _pools(label: object, table: pd.DataFrame, roles: dict[str, str], names: list[str], by: str) -> list[str]:
    """Return the access point of each radio, by a column of a long table or by the radio's name."""
    if by not in table.columns:
        return pool_names(names, by)
    if "receiver" not in roles:
        raise InputError(f"{label} has a column for each receiver; pool by their names: mac or a regular expression")
    pairs = pd.DataFrame({"radio": text_of(table[roles["receiver"]]), "pool": text_of(table[by])}).drop_duplicates()
    if len(several := pairs["radio"][pairs["radio"].duplicated()]):
        raise InputError(
            f"{label}: receiver {several.iloc[0]!r} has several values in column {by!r}, so it is no access point"
        )
    pool = dict(zip(pairs["radio"], pairs["pool"], strict=True))
    return [pool[name] or name for name in names]


def _coordinates(
    label: object, table: pd.DataFrame, roles: dict[str, str], frame: PlanFrame
) -> tuple[Floats, PlanFrame, list[str]]:
    """Return the coordinates of the rows (n, 3) [m] or [deg], nan where empty, the frame that they were in, and notes."""
    both = [roles.get(role) or roles[GEODETIC[role]] for role in "xy"]
    x, y = (column_of_numbers(label, table, name) for name in both)
    if "x" not in roles and frame != PlanFrame():
        raise InputError(f"{label} has longitudes and latitudes, which --scale, --y-down and --up do not apply to")
    frame, notes = _frame_of(label, table, both, frame) if "x" in roles else (frame, [])
    if "z" in roles:
        z = column_of_numbers(label, table, roles["z"]) / UNITS.get(unit_of(table[roles["z"]]), 1.0)
    elif "floor" in roles:
        numbers, unknown = _floors(table[roles["floor"]])
        if unknown:
            raise InputError(
                f"{label} has no height, and the order of floor {unknown[0]!r} is unknown; number the floors or add column z"
            )
        z = STOREY_M * numbers
        notes.append(f"there is no height, so each floor of column {roles['floor']} counts as {STOREY_M:g} m")
    else:
        z = np.zeros(len(table))
        notes.append("there is no height, so z is 0 m everywhere")
    position = frame.to_world(np.stack([x, y, z], axis=1))
    if "z" in roles and "floor" in roles and not (floors := _floors(table[roles["floor"]]))[1]:
        own, position[:, 2] = position[:, 2].copy(), height_of_floors(position[:, 2], floors[0])
        if (position[:, 2] != own)[~np.isnan(own)].any():
            notes.append(f"heights count from the floor, so each floor of column {roles['floor']} adds {STOREY_M:g} m")
    return position, frame, notes


def _frame_of(
    label: object, table: pd.DataFrame, names: Sequence[str], frame: PlanFrame
) -> tuple[PlanFrame, list[str]]:
    """Return the frame of coordinates in two columns, with the scale and direction that they state, and notes on these."""
    unit, stated = unit_of(table[names[0]]), stated_scale(table.attrs.get("preamble", ""))
    scale = frame.scale or stated
    if unit in PIXELS and scale is None:
        raise InputError(f"{label}: columns {' and '.join(names)} are in pixels; give --scale PIXELS_PER_METRE")
    in_pixels = unit in PIXELS or (frame.scale is None and stated is not None and not unit)
    frame = PlanFrame(UNITS.get(unit) or scale or 1.0, frame.y_down or in_pixels, frame.up)
    notes = []
    if frame.scale != 1:
        notes.append(f"columns {' and '.join(names)} have {frame.scale:.4g} {unit or 'units'} in a metre")
    if frame.y_down:
        notes.append(f"{names[1]} points down, so y is its negative")
    if frame.up != "z":
        notes.append(f"{frame.up} points up in the table, so its axes x, y, z are x, z, -y of the data")
    return frame, notes


def _floors(column: pd.Series) -> tuple[Floats, list[str]]:
    """Return the number of the floor of each row, nan where it is empty, and the names whose number is unknown."""
    numbers, text = parsed(column)
    names = text_of(column)
    numbers = np.where(text, floor_numbers(names.tolist()), numbers)
    return numbers, sorted(set(names[text & np.isnan(numbers)]))


def _long(
    label: object, table: pd.DataFrame, roles: dict[str, str], coordinate: Floats, group: pd.Series
) -> tuple[list[str], Floats, NDArray[np.int64], Floats, list[str]]:
    """Return receivers, RSSI (n, R), its row in the table (n, R), coordinates, and notes. A row is a time and place.

    Repeated packets have a row each.
    """
    receiver = text_of(table[roles["receiver"]])
    nameless = (receiver == "").to_numpy().nonzero()[0]
    if len(nameless):
        raise InputError(f"{label} row {nameless[0] + 1} has no receiver in column {roles['receiver']}")
    receiver, notes = _one_spelling(receiver)
    power, found = _power_of(label, table, [roles["rssi"]])
    time = text_of(table[roles["time"]]) if "time" in roles else None
    row = _row_of_packet(pd.DataFrame(coordinate).assign(group=group.to_numpy()), receiver, time)
    column, names = pd.factorize(receiver)
    _, first = np.unique(row, return_index=True)
    _check_size(label, len(first), len(names))
    values, source = np.full((len(first), len(names)), np.nan), np.zeros((len(first), len(names)), dtype=np.int64)
    values[row, column], source[row, column] = power[:, 0], np.arange(len(table))
    return list(names), values, source, coordinate[first], notes + found


def _row_of_packet(coordinate: pd.DataFrame, receiver: pd.Series, time: pd.Series | None) -> NDArray[np.int64]:
    """Return the row of RSSI of each packet, counted from 0: one for each place, time and repetition at a receiver."""
    keys = coordinate.assign(time="" if time is None else time.to_numpy())
    grouping = {"sort": False, "dropna": False}
    packets = keys.assign(receiver=receiver.to_numpy())
    keys["repeat"] = packets.groupby(list(packets.columns), **grouping).cumcount()
    row: NDArray[np.int64] = keys.groupby(list(keys.columns), **grouping).ngroup().to_numpy()
    return row


def _one_spelling(names: pd.Series) -> tuple[pd.Series, list[str]]:
    """Return names with one spelling for each receiver, the first one, and a note if there were others."""
    plain = names.map(plain_receiver)
    first = dict(zip(plain[::-1], names[::-1], strict=True))
    one = plain.map(first)
    others = names[one != names].unique()
    return one, [
        f"names count as those of one receiver that differ in case, separators or zeros: {listed(others)}"
    ] * bool(len(others))


def plain_receiver(name: str) -> str:
    """Return the name of a receiver without what people write differently: case, separators, and zeros before a number.

    Example:
        >>> plain_receiver("CB-99-D5-23-7D-12"), plain_receiver("AP 01"), plain_receiver("007")
        ('cb99d5237d12', 'ap 1', '7')
    """
    words = re.split(r"[\s:._-]+", name.strip().lower())
    plain = "".join(words)
    return plain if re.fullmatch("[0-9a-f]{12}", plain) else re.sub(r"(?<!\d)0+(?=\d)", "", " ".join(words))


def spelled_as(names: Sequence[str], known: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return names in the spelling of those that are known, and a note on those that differ in it.

    Example:
        >>> spelled_as(["AA-BB-CC-DD-EE-01", "hall"], ["aa:bb:cc:dd:ee:01", "office"])[0]
        ['aa:bb:cc:dd:ee:01', 'hall']
    """
    plain = pd.Series(list(known), index=[plain_receiver(name) for name in known], dtype=object)
    plain = plain[~plain.index.duplicated(keep=False)]
    mine = pd.Series([plain_receiver(name) for name in names], dtype=object)
    once = ~mine.duplicated(keep=False)
    found = [
        plain[key] if name not in known and single and key in plain.index else name
        for name, key, single in zip(names, mine, once, strict=True)
    ]
    other = [f"{name} is {as_known}" for name, as_known in zip(names, found, strict=True) if name != as_known]
    return found, [f"receivers are matched whose names are spelled differently: {listed(other)}"] * bool(other)


def _check_size(label: object, rows: int, receivers: int) -> None:
    if rows * receivers > MAX_VALUES:
        raise InputError(f"{label} has {rows} rows and {receivers} receivers; at most {MAX_VALUES} values are read")


def transmitter_columns(label: object, table: pd.DataFrame, given: Sequence[str]) -> dict[str, str]:
    """Return the columns of the second end by x, y and z; none in a table with positions of one end.

    Args:
        label: Name of the table, for messages.
        table: Its columns.
        given: Columns that the user names, in this order. Otherwise those marked tx or transmitter beside others, or those
            marked rx or receiver beside unmarked ones.

    Raises:
        InputError: A missing column, or another number of columns.

    Example:
        >>> table = pd.DataFrame(columns=["x", "y", "tx_x", "tx_y", "rssi"])
        >>> transmitter_columns("walk.csv", table, ())
        {'x': 'tx_x', 'y': 'tx_y'}
    """
    if given:
        missing = [name for name in given if name not in table.columns]
        if missing or len(given) not in (2, 3) or len(set(given)) < len(given):
            raise InputError(
                f"{label}: transmitter takes the columns of x, y and, if it is known, z, or one column of names, got "
                f"{' '.join(given)}; there are {listed(table.columns)}"
            )
        return dict(zip("xyz", given, strict=False))
    marked = {axis: {_mark(name): name for name in reversed(candidates(table, axis))} for axis in "xyz"}
    for mark, beside in (("transmitter", {"receiver", ""}), ("receiver", {""})):
        if all(mark in marked[axis] and beside & marked[axis].keys() for axis in "xy"):
            return {axis: names[mark] for axis, names in marked.items() if mark in names}
    return {}


def _mark(name: str) -> str:
    return next((MARKS[word] for word in plain_name(name).split("_") if word in MARKS), "")


def as_receivers(label: object, rssi: Floats, ends: Floats) -> tuple[list[str], Floats, Floats, Floats, list[str]]:
    """Return links as RSSI of one moving end at the positions of the other.

    Args:
        label: Name of the table, for messages.
        rssi: RSSI of the links, (n, 1) [dBm].
        ends: Positions of both ends, (n, 6) [m]. The end with fewer positions becomes the receivers.

    Returns:
        Names of P receivers, RSSI (n, P) [dBm], positions of the other end (n, 3) [m], those of the receivers (P, 3) [m],
        and notes.

    Raises:
        InputError: RSSI of several receivers.
    """
    if rssi.shape[1] != 1:
        raise InputError(
            f"{label} has positions of both ends and RSSI of {rssi.shape[1]} receivers; name one: columns rssi=NAME, or "
            "pool them: pool_by"
        )
    own, other = ends[:, :3], ends[:, 3:]
    if len(np.unique(own, axis=0)) < len(np.unique(other, axis=0)):
        own, other = other, own
    place, edge = cells(torch.from_numpy(other), 500)  # each has a column of RSSI
    n = int(place.max()) + 1
    count = np.bincount(place.numpy(), minlength=n)
    position = np.stack([np.bincount(place.numpy(), axis, minlength=n) / count for axis in other.T], axis=1)
    notes = [f"both ends move; {n} positions of one of them count as receivers place1 to place{n}"]
    if edge:
        notes.append(f"its positions are averaged in cubes of {edge:.3g} m")
    values = np.full((len(rssi), n), np.nan)
    values[np.arange(len(rssi)), place.numpy()] = rssi[:, 0]
    return [f"place{number}" for number in range(1, n + 1)], values, own, position, notes


def pool_names(names: Sequence[str], by: str) -> list[str]:
    """Return the access point of each radio; a radio that does not match is one of its own.

    Args:
        names: Names of the radios.
        by: "mac" for the first five bytes of a MAC address, else a regular expression whose group is the access point.

    Raises:
        InputError: An expression that is broken, has no group, or matches no radio.

    Example:
        >>> pool_names(["a4:56:cc:00:10:b0", "a4:56:cc:00:10:b1", "lab"], "mac")
        ['a4:56:cc:00:10', 'a4:56:cc:00:10', 'lab']
        >>> pool_names(["hall-2G", "hall-5G"], "(.*)-.G")
        ['hall', 'hall']
    """
    try:
        pattern = ADDRESS if by == MAC else re.compile(by)
    except re.error as error:
        raise InputError(f"pool_by {by!r} is no column and no regular expression ({error})") from None
    if pattern.groups != 1:
        raise InputError(f"pool_by takes {MAC}, a column, or a regular expression with one group, got {by!r}")
    found = [pattern.fullmatch(name) for name in names]
    if not any(found):
        raise InputError(f"pool_by {by!r} matches no receiver; there are {listed(names)}")
    return [name if match is None else match.group(1) for name, match in zip(names, found, strict=True)]


def pooled(rssi: Floats, pools: Sequence[str]) -> tuple[list[str], Floats]:
    """Return the access points and their RSSI: the mean power of those radios that detected the transmitter.

    Args:
        rssi: RSSI of the radios (n, R) [dBm], nan where not detected.
        pools: Access point of each radio, R names.

    Returns:
        P names in order of their first radio, and RSSI (n, P) [dBm].

    Example:
        >>> pooled(np.array([[-50.0, -50.0], [-60.0, np.nan]]), ["hall", "hall"])
        (['hall'], array([[-50.],
               [-60.]]))
    """
    names = list(dict.fromkeys(pools))
    member = np.array([[pool == name for name in names] for pool in pools], dtype=np.float64)
    detected = ~np.isnan(rssi)
    power = np.where(detected, 10 ** (np.nan_to_num(rssi) / 10), 0.0) @ member
    with np.errstate(divide="ignore", invalid="ignore"):
        return names, 10 * np.log10(power / (detected @ member))


def read_receivers(
    file: Path, names: Sequence[str], origin: GeodeticOrigin | None = None, frame: PlanFrame | None = None
) -> tuple[Tensor, list[str]]:
    """Return the positions of receivers, float64 (R, 3) [m], nan where the table lacks one, and a note on these.

    Args:
        file: Table of positions with names of receivers, or without names in the order of the receivers.
        names: R names.
        origin: Origin of the measurements, if their positions were in degrees; then these are, too.
        frame: Axes of the measurements, which are those of the receivers unless their columns state another unit.

    Raises:
        InputError: A name twice, no position of any receiver, or a position that is not usable.
    """
    table = read_table(file)
    label = column_of(table, "receiver", {}) or ("name" if "name" in table.columns else None)
    if label is None and len(table) != len(names):
        raise InputError(f"{file} has {len(table)} rows and no column of names, but there are {len(names)} receivers")
    listed_names = list(names) if label is None else table[label].astype(str).str.strip().tolist()
    if len(set(listed_names)) < len(listed_names):
        raise InputError(f"{file} must have each receiver once, got {listed(listed_names)}")
    listed_names, notes = spelled_as(listed_names, names)
    position = _positions(file, table, origin, "receiver,x,y,z", frame)
    given = np.flatnonzero(~np.isnan(position[:, :2]).all(axis=1))
    position, listed_names = position[given], [listed_names[row] for row in given]
    place = dict(zip(listed_names, check_positions(position, f"positions of {file}").tolist(), strict=True))
    unknown = [name for name in names if name not in place]
    if len(unknown) == len(names):
        raise InputError(f"{file} has none of the receivers ({listed(names)}); there are {listed(listed_names)}")
    found = torch.tensor([place.get(name, [float("nan")] * 3) for name in names], dtype=torch.float64)
    return found, [*notes, *unknown_positions(unknown)]


def read_places(file: Path, origin: GeodeticOrigin | None = None, frame: PlanFrame | None = None) -> Tensor:
    """Return the positions in a table with columns x, y, z or longitude, latitude, altitude, float64 (n, 3) [m].

    Args:
        file: CSV or Parquet file. Without a column of heights, z is 0.
        origin: Origin of the metres, if positions are in degrees.
        frame: Axes of positions that are not in degrees.

    Raises:
        InputError: A column that is missing, or a position that is not usable.
    """
    return check_positions(
        _positions(file, read_table(file), origin, "x,y,z", frame or PlanFrame()), f"positions of {file}"
    )


def _positions(
    file: Path, table: pd.DataFrame, origin: GeodeticOrigin | None, header: str, frame: PlanFrame | None = None
) -> NDArray[np.float64]:
    """Return the positions (n, 3) [m] in a table, nan where a cell is empty."""
    columns = [column_of(table, axis, {}) or column_of(table, GEODETIC[axis], {}) for axis in "xy"]
    if None in columns:
        raise InputError(f"{file} must start with the header {header}, got {','.join(map(str, table.columns))}")
    height = column_of(table, "z", {})
    values = [column_of_numbers(file, table, str(name)) for name in columns]
    position = np.column_stack([*values, column_of_numbers(file, table, height) if height else np.zeros(len(table))])
    if frame is not None and origin is None:
        position = _frame_of(file, table, [str(name) for name in columns], frame)[0].to_world(position)
    known = ~np.isnan(position[:, :2]).all(axis=1)
    position[known, :2] = _near_origin(file, position[known, :2], column_of(table, "longitude", {}) in columns, origin)
    return position


def unknown_positions(names: list[str]) -> list[str]:
    """Return a note on receivers of unknown position, or none."""
    return [f"the position of these receivers is unknown, so they have no path-loss model: {listed(names)}"] * bool(
        names
    )


def _near_origin(
    file: Path, xy: NDArray[np.float64], named: bool, origin: GeodeticOrigin | None
) -> NDArray[np.float64]:
    """Return x and y (R, 2) [m] of receivers."""
    if origin is None:
        if named and (np.abs(xy) <= (180, 90)).all():
            raise InputError(
                f"{file} holds longitudes and latitudes, but the measurements are in metres; give one unit"
            )
        return xy
    if not (np.abs(xy - (origin.longitude, origin.latitude)) <= MAX_FROM_ORIGIN_DEG).all():
        raise InputError(
            f"{file}: receivers must be in degrees as the measurements are, within {MAX_FROM_ORIGIN_DEG:g} degrees of "
            f"{origin}"
        )
    return origin.to_metres(xy[:, ::-1])
