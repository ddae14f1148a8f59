"""Tables of positions and RSSI: the columns of a walk test, recognised by their names.

A wide table has one column a receiver, a long one has one row a packet. Both ends of a link may move, and radios of one
access point may be pooled.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from swiftwrf.data.cells import CLOCK_ONLY, UNITS, column_of_numbers, parsed, plain_name, seconds, text_of, unit_of
from swiftwrf.data.columns import GEODETIC, candidates, check_receiver_known, column_of, find_roles, receiver_columns
from swiftwrf.data.coordinates import (
    MIN_STOREY_M,
    STOREY_M,
    Coordinates,
    GeodeticOrigin,
    PlanFrame,
    Up,
    degrees_in,
    floor_numbers,
    floors_of,
    frame_of,
    without_fix,
)
from swiftwrf.data.powers import MIN_REPEATS, check_powers, end_of_scale, find_fillers, without_fillers
from swiftwrf.data.receivers import plain_receiver, pool_names, read_receivers
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import cells, check_positions
from swiftwrf.runtime.validation import PositiveFloat, configuration

Floats = NDArray[np.float64]
MAX_VALUES = 2**27  # rows x receivers
MARKS = {"tx": "transmitter", "transmitter": "transmitter", "rx": "receiver", "receiver": "receiver"}  # words in names
MIN_EXTENT_OF_WALK_M = 3.0
MAX_SPEED_OF_MILLISECONDS, MAX_STEP_M = 2e-3, 1.0  # [m/s] if they were seconds, and between rows of a log of movement
N_PHASES = 20  # of windows that are compared
MIN_REPEATED_RECEIVERS, MIN_REPEATED = 3, 0.05  # with the same values, and fraction of rows, of scans that are repeated


@configuration
class TableOptions:
    """Options of reading tables, with the meaning that `load_rssi` describes.

    Example:
        >>> TableOptions(filler=[0, 100]).filler
        (0.0, 100.0)
    """

    columns: Mapping[str, str] | None = None
    filler: Sequence[float] | None = None
    coordinates: Coordinates | None = None
    offset_by: str | None = None
    transmitter: Sequence[str] = ()
    pool_by: str | None = None
    scale: PositiveFloat | None = None
    y_down: bool = False
    up: Up = "z"
    window: PositiveFloat | None = None

    def check(self) -> None:
        """Keep lists as tuples, which compare as a whole."""
        object.__setattr__(self, "filler", None if self.filler is None else tuple(map(float, self.filler)))
        object.__setattr__(self, "transmitter", tuple(self.transmitter))


def has_positions(table: pd.DataFrame, columns: Mapping[str, str]) -> bool:
    """Return True if a column of a table holds positions, by its name or by the names of columns given by role."""
    return any(column_of(table, role, columns) is not None for role in ("x", "y", *GEODETIC.values()))


def read_survey(
    label: object, table: pd.DataFrame, options: TableOptions, receivers: Path | None = None, keeps_rows: bool = False
) -> dict[str, Any]:
    """Return the arguments of `Rssi` that a survey table determines: RSSI, positions, receivers and what rows are of.

    Columns get their roles, cells their units, and then rows are formed: one a place, time and packet of a receiver. The
    label names the table in messages, `receivers` is a table of their positions. With keeps_rows, repeated scans stay.

    Raises:
        InputError: A column that is missing or ambiguous, or a value that is no position or received power.
    """
    survey = _Survey(label, table, options)
    table, roles, names, notes = survey.table, survey.roles, survey.names, survey.notes
    offset_by, window = options.offset_by, options.window
    coordinate, frame, found = survey.coordinates(roles, PlanFrame(options.scale, options.y_down, options.up))
    notes += found
    if survey.end:
        coordinate = np.hstack([coordinate, survey.coordinates(survey.end, frame)[0]])
        coordinate[np.isnan(coordinate).any(axis=1)] = np.nan
    group = text_of(table[offset_by]) if offset_by else pd.Series([""] * len(table))
    session = survey.text("session")
    apart = group if session is None else group + "\n" + session
    if "receiver" in roles:
        names, rssi, source, coordinate = survey.packets(coordinate, apart)
    else:
        rssi, source = survey.powers(names), np.arange(len(table))[:, None]
    fillers = find_fillers(rssi) if options.filler is None else list(options.filler)
    rssi, filled = without_fillers(rssi, fillers)
    check_powers(label, rssi, names, source)
    notes += filled + end_of_scale(rssi)
    if options.pool_by is not None:
        n_radios = len(names)
        power = pd.DataFrame(10 ** (rssi.T / 10)).groupby(survey.pools(names, options.pool_by), sort=False).mean()
        names, rssi = list(power.index), 10 * np.log10(power.to_numpy().T)  # mean of the powers that were detected
        notes.append(
            f"{n_radios} radios are pooled into {len(names)} receivers by {options.pool_by}: mean of their powers"
        )

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
    position, origin = survey.local_metres(coordinate[row])
    kept = (~np.isnan(rssi[row])).any(axis=0)
    if not kept.any():
        raise InputError(f"{label} holds no RSSI that a receiver detected")
    if not kept.all():
        notes.append(f"receivers that never detected the transmitter are left out: {int((~kept).sum())}")
    names, rssi, places = [names[i] for i in np.flatnonzero(kept)], rssi[row][:, kept], None
    origins = source.max(axis=1)[row]  # row of the table that each row is of
    time = survey.times(origins, position)
    if window is not None:
        if time is None:
            raise InputError(f"{label} has no column of times, which a window of {window:g} s needs; leave it out")
        first, rssi, position, time = _windows(apart.to_numpy()[origins], time, rssi, position, window)
        notes.append(f"{len(row)} rows are joined to {len(first)} by their mean in windows of {window:g} s")
        row, origins = row[first], origins[first]
    elif time is not None:
        notes += _split_packets(rssi, time)
    floor = survey.text("floor")
    floors = None if floor is None else floors_of(label, floor.iloc[origins].tolist(), position)
    if survey.end:
        names, rssi, position, places, found = _as_receivers(label, rssi, position)
        notes += found
    labels = survey.labels()
    if labels and not offset_by:
        notes.append(
            f"rows differ in {listed(labels)}; swiftwrf inspect tests whether its values have constant offsets"
        )
    moves = bool(survey.end or options.transmitter)
    if moves and not survey.end:
        notes.append(f"both ends move; {len(names)} positions of column {options.transmitter[0]} count as receivers")
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
        "groups": group.iloc[origins].rename(offset_by) if offset_by else None,
        "labels": labels,
        "floors": floors,
        "receiver_moves": moves,
        "plan_scale": frame.scale if frame.y_down else None,
        "session": None if session is None else session.to_numpy()[origins].tolist(),
        "time": time,
        "index": row,
        "notes": tuple(notes),
    }


class _Survey:
    """A table, the roles of its columns, and notes on what they hold.

    Attributes:
        table: Columns, those of receivers as numbers.
        roles: Names of columns by role.
        end: Columns of the second end by x, y and z.
        names: Receivers of a wide table.
        unused: Columns without use.
    """

    def __init__(self, label: object, table: pd.DataFrame, options: TableOptions) -> None:
        self.label, self.options, self.notes = label, options, list(table.attrs.get("notes", ()))
        table = table.set_axis([str(name).strip() for name in table.columns], axis=1).reset_index(drop=True)
        if not len(table) or not table.columns.is_unique:
            raise InputError(f"{label} must have rows, and a name of its own for each column")
        if options.offset_by not in (None, *table.columns):
            raise InputError(
                f"{label} has no column {options.offset_by!r} for offsets; there are {listed(table.columns)}"
            )
        with suppress(TypeError):  # cells that are lists
            if n := int(table.duplicated().sum()):
                self.notes.append(f"rows equal an earlier one in all columns and count once more: {n} of {len(table)}")
        self.table, self.names, self.end = table, list[str](), dict[str, str]()
        asked = dict(options.columns or {})
        if len(options.transmitter) == 1:
            asked["receiver"] = options.transmitter[0]
        elif options.transmitter or not {"x", "y"} & asked.keys():
            self.end = _columns_of_end(label, table, options.transmitter)
        self.roles = find_roles(label, table, asked, self.end.values())
        if (floor := self.text("floor")) is not None and not floor.any():
            self.notes.append(f"column {self.roles.pop('floor')} is empty, so there are no floors")
        used = {options.offset_by, options.pool_by, *self.end.values()}
        left_out, found = ([], []) if "receiver" in self.roles else self._find_receivers(asked, used)
        taken = [f"{role} = {name}" for role, name in self.roles.items()]
        taken += [f"transmitter {axis} = {name}" for axis, name in self.end.items()]
        if self.names:
            several = f"RSSI of {len(self.names)} receivers = {listed(self.names)}"
            taken.append(several if len(self.names) > 1 else f"RSSI = {self.names[0]}")
        self.notes += [f"taken as: {', '.join(taken)}", *found]
        used |= {*self.roles.values(), *self.names, *left_out}
        self.unused = [name for name in table.columns if name not in used]
        if self.unused:
            self.notes.append(f"columns that are not used: {listed(self.unused)}")

    def _find_receivers(self, asked: Mapping[str, str], used: Set[str | None]) -> tuple[list[str], list[str]]:
        """Find the receivers of a wide table; return columns that look like these, and notes on them."""
        power = self.roles.pop("rssi", None)
        others = [name for name in self.table.columns if name not in {*self.roles.values(), *used}]
        numbers = {name: values for name in others for values, text in [parsed(self.table[name])] if not text.any()}
        self.table = table = self.table.assign(**numbers)  # each cell is parsed once
        left_out, notes = list[str](), list[str]()
        if "rssi" in asked:
            self.names = [power] if power else fnmatch.filter(others, asked["rssi"])
        else:
            self.names, left_out, notes = receiver_columns(table, others)
        if not self.names:
            raise InputError(
                f"{self.label} has no column of RSSI in dBm (numbers below 0) besides positions; there are "
                f"{listed(table.columns)}; choose with columns rssi=NAME or rssi='PREFIX*'"
            )
        if len(self.names) == 1 and "rssi" not in asked and not self.end:
            place = [self.roles[role] for role in ("x", "y", "longitude", "latitude", "time") if role in self.roles]
            check_receiver_known(
                self.label, table, self.names[0], [name for name in others if name not in self.names], place
            )
        return left_out, notes

    def text(self, role: str) -> pd.Series | None:
        """Return the cells of the column of a role, None without one."""
        return text_of(self.table[self.roles[role]]) if role in self.roles else None

    def labels(self) -> tuple[str, ...]:
        """Return columns with few different values, each of them in several rows, that are no names of receivers."""
        candidate = [name for name in (*self.unused, self.roles.get("session")) if name]
        if "receiver" in self.roles:
            several = self.table.groupby(self.roles["receiver"])[candidate].nunique().max() > 1
            candidate = [name for name in candidate if several[name]]
        counts = {name: text_of(self.table[name]).value_counts() for name in candidate}
        return tuple(name for name, count in counts.items() if 2 <= len(count) <= 30 and int(count.min()) >= 10)

    def powers(self, names: Sequence[str]) -> Floats:
        """Return the RSSI in columns (n, len(names)), nan where it was not detected, for which one word may stand."""
        values, text = (
            np.stack(part, axis=1) for part in zip(*(parsed(self.table[name]) for name in names), strict=True)
        )
        words = pd.Series(self.table[list(names)].to_numpy(dtype=object)[text], dtype=object).astype(str).str.strip()
        if len(words) >= MIN_REPEATS and words.nunique() == 1:
            cells = f"{len(words)} of {text.size} cells ({text.mean():.0%})"
            self.notes.append(f"{words[0]!r} counts as not detected: {cells}")
            return values
        for name in np.array(names)[text.any(axis=0)]:
            column_of_numbers(self.label, self.table, name)
        return values

    def coordinates(self, roles: Mapping[str, str], frame: PlanFrame) -> tuple[Floats, PlanFrame, list[str]]:
        """Return the coordinates of the rows (n, 3) [m] or [deg], nan where empty, the frame they were in, and notes."""
        label, table = self.label, self.table
        both = [roles.get(role) or roles[GEODETIC[role]] for role in "xy"]
        x, y = (column_of_numbers(label, table, name) for name in both)
        if "x" not in roles and frame != PlanFrame():
            raise InputError(f"{label} has longitudes and latitudes, which --scale, --y-down and --up do not apply to")
        frame, notes = frame_of(label, table, both, frame) if "x" in roles else (frame, [])
        if "floor" in roles:
            floor, text = parsed(table[roles["floor"]])
            floor_names = text_of(table[roles["floor"]])
            floor = np.where(text, floor_numbers(floor_names.tolist()), floor)
            unknown = sorted(set(floor_names[text & np.isnan(floor)]))
        if "z" in roles:
            z = column_of_numbers(label, table, roles["z"]) / UNITS.get(unit_of(table[roles["z"]]), 1.0)
        elif "floor" in roles:
            if unknown:
                raise InputError(
                    f"{label} has no height, and the order of floor {unknown[0]!r} is unknown; number the floors or add "
                    "column z"
                )
            z = STOREY_M * floor
            notes.append(f"there is no height, so each floor of column {roles['floor']} counts as {STOREY_M:g} m")
        else:
            z = np.zeros(len(table))
            notes.append("there is no height, so z is 0 m everywhere")
        position = frame.to_world(np.stack([x, y, z], axis=1))
        if "z" in roles and "floor" in roles and not unknown:
            heights = pd.Series(position[:, 2]).groupby(floor).median().dropna()  # in the order of floors
            if len(heights) > 1 and heights.diff().abs().max() < MIN_STOREY_M:
                position[:, 2] += STOREY_M * floor
                notes.append(
                    f"heights count from the floor, so each floor of column {roles['floor']} adds {STOREY_M:g} m"
                )
        return position, frame, notes

    def local_metres(self, coordinate: Floats) -> tuple[Floats, GeodeticOrigin | None]:
        """Return positions (n, 3 or 6) [m] of coordinates that may be degrees, and the origin of the metres."""
        label, roles, asked = self.label, self.roles, self.options.coordinates
        position, origin = coordinate.reshape(-1, 3), None
        both = roles.get("x") or roles["longitude"], roles.get("y") or roles["latitude"]
        named = "longitude" in roles and "latitude" in roles
        degrees, notes = degrees_in(label, both, position[:, :2], named, asked)
        self.notes += notes
        if degrees is not None:
            origin = GeodeticOrigin.amid(degrees)
            x, y = both
            if not named and np.abs(position[:, 1]).max() > 90:  # only a longitude does
                x, y = y, x
            self.notes.append(f"longitude {x} and latitude {y} are projected to local metres about {origin}")
            position = np.column_stack([origin.to_metres(degrees), position[:, 2]])
        elif "y" in roles and "z" in roles:
            width, depth, height = np.ptp(position, axis=0)
            if depth < height / 5 and min(width, height) > MIN_EXTENT_OF_WALK_M:
                self.notes.append(
                    f"y spans {depth:.1f} m and z {height:.1f} m; if y is the height, give --up y, and else this stands as "
                    "it is"
                )
        check_positions(position, f"positions of {label}")
        return position.reshape(len(coordinate), -1), origin

    def times(self, rows: NDArray[np.int64], position: Floats) -> Floats | None:
        """Return the times of rows of the table [s], None without a column of them.

        Whole numbers at which the positions move slower than anybody walks, but not in milliseconds, are milliseconds.
        """
        if "time" not in self.roles:
            return None
        table = self.table.iloc[rows]
        column = table[self.roles["time"]]
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
                    f"column {column.name} counts milliseconds, which are converted to seconds: as seconds, the positions "
                    f"move {1e3 * speed:.1g} mm/s"
                )
        self.notes += notes
        return time

    def packets(self, coordinate: Floats, group: pd.Series) -> tuple[list[str], Floats, NDArray[np.int64], Floats]:
        """Return the receivers of a long table, RSSI (n, R), its row in the table (n, R), and coordinates.

        A row is a time and place. Repeated packets have a row each. Without a receiver, nothing was detected there.
        """
        receiver = text_of(self.table[self.roles["receiver"]])
        power, time, named = self.powers([self.roles["rssi"]])[:, 0], self.text("time"), (receiver != "").to_numpy()
        if len(nameless := np.flatnonzero(~named & ~np.isnan(power))):
            raise InputError(f"{self.label} row {nameless[0] + 1} has no receiver in column {self.roles['receiver']}")
        plain = receiver.map(plain_receiver)
        one = plain.map(dict(zip(plain[::-1], receiver[::-1], strict=True)))  # in the first spelling
        if len(others := receiver[one != receiver].unique()):
            self.notes.append(
                f"names count as those of one receiver that differ in case, separators or zeros: {listed(others)}"
            )
        keys = pd.DataFrame(coordinate).assign(group=group.to_numpy(), time="" if time is None else time.to_numpy())
        packets = keys.assign(receiver=one.to_numpy())
        keys["repeat"] = packets.groupby(list(packets.columns), sort=False, dropna=False).cumcount()
        row = keys.groupby(list(keys.columns), sort=False, dropna=False).ngroup().to_numpy()
        column, names = pd.factorize(one[named])
        _, first = np.unique(row, return_index=True)
        if len(first) * len(names) > MAX_VALUES:
            raise InputError(
                f"{self.label} has {len(first)} rows and {len(names)} receivers; at most {MAX_VALUES} values are read"
            )
        values, source = np.full((len(first), len(names)), np.nan), np.repeat(first[:, None], len(names), axis=1)
        values[row[named], column], source[row[named], column] = power[named], np.flatnonzero(named)
        return list(names), values, source, coordinate[first]

    def pools(self, names: list[str], by: str) -> list[str]:
        """Return the access point of each radio, by a column of a long table or by the radio's name."""
        if by not in self.table.columns:
            return pool_names(names, by)
        receiver = self.text("receiver")
        if receiver is None:
            raise InputError(
                f"{self.label} has a column for each receiver; pool by their names: mac or a regular expression"
            )
        pairs = pd.DataFrame({"radio": receiver, "pool": text_of(self.table[by])}).drop_duplicates()
        if len(several := pairs["radio"][pairs["radio"].duplicated()]):
            raise InputError(
                f"{self.label}: receiver {several.iloc[0]!r} has several values in column {by!r}, so it is no access point"
            )
        pool = dict(zip(pairs["radio"], pairs["pool"], strict=True))
        return [pool[name] or name for name in names]


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
    alone = float(((~np.isnan(rssi)).sum(axis=1) == 1).mean())
    step = float(np.median(np.diff(np.sort(time)))) if len(time) >= MIN_REPEATS else np.inf  # nan without some times
    if rssi.shape[1] < 2 or alone < 0.9 or not step < 1:
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


def _columns_of_end(label: object, table: pd.DataFrame, given: Sequence[str]) -> dict[str, str]:
    """Return the columns of the second end by x, y and z; none in a table with positions of one end.

    They are the given ones. Otherwise they are those marked tx or transmitter beside others, or those marked rx or receiver
    beside unmarked ones.
    """
    if given:
        missing = [name for name in given if name not in table.columns]
        if missing or len(given) not in (2, 3) or len(set(given)) < len(given):
            raise InputError(
                f"{label}: transmitter takes the columns of x, y and, if it is known, z, or one column of names, got "
                f"{' '.join(given)}; there are {listed(table.columns)}"
            )
        return dict(zip("xyz", given, strict=False))

    def end_of(name: str) -> str:
        return next((MARKS[word] for word in plain_name(name).split("_") if word in MARKS), "")

    marked = {axis: {end_of(name): name for name in reversed(candidates(table, axis))} for axis in "xyz"}
    for mark, beside in (("transmitter", {"receiver", ""}), ("receiver", {""})):
        if all(mark in marked[axis] and beside & marked[axis].keys() for axis in "xy"):
            return {axis: names[mark] for axis, names in marked.items() if mark in names}
    return {}


def _as_receivers(label: object, rssi: Floats, ends: Floats) -> tuple[list[str], Floats, Floats, Floats, list[str]]:
    """Return links of two ends (n, 6) [m] as RSSI of one at the positions of the other, which has fewer of them.

    Returns:
        Names of P receivers, RSSI (n, P) [dBm], positions of the moving end (n, 3) [m] and of the receivers (P, 3) [m], and
        notes.
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
    position = pd.DataFrame(other).groupby(place.numpy()).mean().to_numpy()
    n = len(position)
    notes = [f"both ends move; {n} positions of one of them count as receivers place1 to place{n}"]
    if edge:
        notes.append(f"its positions are averaged in cubes of {edge:.3g} m")
    values = np.full((len(rssi), n), np.nan)
    values[np.arange(len(rssi)), place.numpy()] = rssi[:, 0]
    return [f"place{number}" for number in range(1, n + 1)], values, own, position, notes
