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

from swiftwrf.data.cells import (
    CLOCK_ONLY,
    UNITS,
    Floats,
    column_of_numbers,
    parsed,
    plain_name,
    seconds,
    text_of,
    unit_of,
)
from swiftwrf.data.columns import (
    GEODETIC,
    candidates,
    check_receiver_known,
    column_of,
    columns_of_end,
    find_roles,
    receiver_columns,
)
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
from swiftwrf.data.powers import check_powers, end_of_scale, find_fillers, without_fillers
from swiftwrf.data.receivers import plain_receiver, pool_names, read_receivers
from swiftwrf.data.scans import list_margin, repeated_scans, split_packets, windows
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import cells, check_positions
from swiftwrf.runtime.validation import PositiveFloat, configuration


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
    source: object, table: pd.DataFrame, options: TableOptions, receivers: Path | None = None, keeps_rows: bool = False
) -> dict[str, Any]:
    """Return the arguments of `Rssi` that a survey table determines: RSSI, positions, receivers and what rows are of.

    Columns get their roles, cells their units, and then rows are formed: one a place, time and packet of a receiver.

    Args:
        source: Name of the table, for messages.
        table: Columns of positions and RSSI.
        options: What the user states.
        receivers: Table of the receivers' positions.
        keeps_rows: Keep repeated scans, whose rows given splits number.

    Raises:
        InputError: A column that is missing or ambiguous, or a value that is no position or received power.
    """
    survey = _Survey(source, table, options)
    survey.form_rows()
    survey.clean_powers()
    survey.leave_out_rows(keeps_rows)
    survey.project()
    survey.find_times()
    return survey.arguments(receivers)


class _Survey:
    """A table, the roles of its columns, the rows that are formed of it step by step, and notes on what was assumed.

    Attributes:
        table: Columns, those of receivers as numbers.
        roles: Names of columns by role.
        end: Columns of the second end by x, y and z.
        names: Names of the R receivers.
        unused: Columns without use.
        rssi: RSSI (n, R) [dBm], nan where nothing was detected.
        coordinate: Coordinates of one end or both, (n, 3 or 6) [m] or [deg], later positions [m].
        table_row: Row of the table that each row is of, (n,); before rows are left out, that of each value, (n, R or 1).
        index: Number of each row before rows are left out, (n,).
    """

    def __init__(self, source: object, table: pd.DataFrame, options: TableOptions) -> None:
        self.source, self.options, self.notes = source, options, list(table.attrs.get("notes", ()))
        table = table.set_axis([str(name).strip() for name in table.columns], axis=1).reset_index(drop=True)
        if not len(table) or not table.columns.is_unique:
            raise InputError(f"{source} must have rows, and a name of its own for each column")
        if options.offset_by not in (None, *table.columns):
            raise InputError(
                f"{source} has no column {options.offset_by!r} for offsets; there are {listed(table.columns)}"
            )
        with suppress(TypeError):  # cells that are lists
            if n := int(table.duplicated().sum()):
                self.notes.append(f"rows equal an earlier one in all columns and count once more: {n} of {len(table)}")
        self.table, self.names, self.end = table, list[str](), dict[str, str]()
        asked = dict(options.columns or {})
        if len(options.transmitter) == 1:
            asked["receiver"] = options.transmitter[0]
        elif options.transmitter or not {"x", "y"} & asked.keys():
            self.end = columns_of_end(source, table, options.transmitter)
        self.roles = find_roles(source, table, asked, self.end.values())
        if (floor := self.text("floor")) is not None and not floor.any():
            self.notes.append(f"column {self.roles.pop('floor')} is empty, so there are no floors")
        used = {options.offset_by, options.pool_by, *self.end.values()}
        left_out, notes = ([], []) if "receiver" in self.roles else self._find_receivers(asked, used)
        taken = [f"{role} = {name}" for role, name in self.roles.items()]
        taken += [f"transmitter {axis} = {name}" for axis, name in self.end.items()]
        if self.names:
            several = f"RSSI of {len(self.names)} receivers = {listed(self.names)}"
            taken.append(several if len(self.names) > 1 else f"RSSI = {self.names[0]}")
        self.notes += [f"taken as: {', '.join(taken)}", *notes]
        used |= {*self.roles.values(), *self.names, *left_out}
        self.unused = [name for name in table.columns if name not in used]
        if self.unused:
            self.notes.append(f"columns that are not used: {listed(self.unused)}")

    def form_rows(self) -> None:
        """Form rows of coordinates and RSSI: those of a wide table, or one a time, place and packet of a long one."""
        options, column = self.options, self.options.offset_by
        frame = PlanFrame(options.scale, options.y_down, options.up)
        self.coordinate, self.frame, notes = self._coordinates(self.roles, frame)
        self.notes += notes
        if self.end:
            self.coordinate = np.hstack([self.coordinate, self._coordinates(self.end, self.frame)[0]])
            self.coordinate[np.isnan(self.coordinate).any(axis=1)] = np.nan
        self.group = text_of(self.table[column]) if column else pd.Series([""] * len(self.table))
        self.session = self.text("session")
        self.kind = self.group if self.session is None else self.group + "\n" + self.session  # rows that stay apart
        if "receiver" in self.roles:
            self._form_packets()
        else:
            self.rssi, self.table_row = self._powers(self.names), np.arange(len(self.table))[:, None]

    def clean_powers(self) -> None:
        """Take fillers as not detected, refuse what is no received power, and pool radios."""
        by = self.options.pool_by
        fillers = find_fillers(self.rssi) if self.options.filler is None else list(self.options.filler)
        self.rssi, notes = without_fillers(self.rssi, fillers)
        check_powers(self.source, self.rssi, self.names, self.table_row)
        self.notes += notes + end_of_scale(self.rssi)
        if by is not None:
            n_radios = len(self.names)
            power = pd.DataFrame(10 ** (self.rssi.T / 10)).groupby(self._pools(by), sort=False).mean()
            self.names, self.rssi = list(power.index), 10 * np.log10(power.to_numpy().T)  # of the detected powers
            self.notes.append(
                f"{n_radios} radios are pooled into {len(self.names)} receivers by {by}: mean of their powers"
            )

    def leave_out_rows(self, keeps_rows: bool) -> None:
        """Leave out rows without a position, and cached scans unless `keeps_rows`."""
        omitted, notes = without_fix(self.coordinate[:, :3])
        if omitted.all():
            raise InputError(f"{self.source} has no row with a position; {notes[0]}")
        row = np.flatnonzero(~omitted)
        repeated = repeated_scans(self.coordinate[row], self.rssi[row])
        if repeated.any():
            fate = "stay because of the given splits" if keeps_rows else "are left out"
            notes.append(
                "rows that repeat all values of the row before at another place, as cached scans do, "
                f"{fate}: {int(repeated.sum())} of {len(row)}"
            )
            row = row if keeps_rows else row[~repeated]
        self.notes += notes
        self.index, self.table_row = row, self.table_row.max(axis=1)[row]
        self.rssi, self.coordinate = self.rssi[row], self.coordinate[row]

    def project(self) -> None:
        """Project degrees to local metres, and leave out receivers that never detected the transmitter."""
        self.coordinate, self.origin = self._local_metres()
        kept = (~np.isnan(self.rssi)).any(axis=0)
        if not kept.any():
            raise InputError(f"{self.source} holds no RSSI that a receiver detected")
        if not kept.all():
            self.notes.append(f"receivers that never detected the transmitter are left out: {int((~kept).sum())}")
        self.names, self.rssi = [self.names[i] for i in np.flatnonzero(kept)], self.rssi[:, kept]

    def find_times(self) -> None:
        """Find the times of rows, and join the rows of each window."""
        window, self.time = self.options.window, self._times()
        if window is not None:
            if self.time is None:
                raise InputError(
                    f"{self.source} has no column of times, which a window of {window:g} s needs; leave it out"
                )
            kind, n = self.kind.to_numpy()[self.table_row], len(self.rssi)
            first, self.rssi, self.coordinate, self.time = windows(kind, self.time, self.rssi, self.coordinate, window)
            self.notes.append(f"{n} rows are joined to {len(first)} by their mean in windows of {window:g} s")
            self.index, self.table_row = self.index[first], self.table_row[first]
        elif self.time is not None:
            self.notes += split_packets(self.rssi, self.time)

    def arguments(self, receivers: Path | None) -> dict[str, Any]:
        """Return the arguments of `Rssi`, with the positions of receivers in a table or those of a second end."""
        options, floor = self.options, self.text("floor")
        floors = None if floor is None else floors_of(self.source, floor.iloc[self.table_row].tolist(), self.coordinate)
        receiver_position = self._end_as_receivers() if self.end else None
        labels, moves = self._labels(), bool(self.end or options.transmitter)
        if labels and not options.offset_by:
            self.notes.append(
                f"rows differ in {listed(labels)}; swiftwrf inspect tests whether its values have constant offsets"
            )
        if moves and not self.end:
            column = options.transmitter[0]
            self.notes.append(f"both ends move; {len(self.names)} positions of column {column} count as receivers")
        if receivers is not None and receiver_position is None:
            known, notes = read_receivers(receivers, self.names, self.origin, self.frame)
            receiver_position = known.numpy()
            self.notes += notes
        group = self.group.iloc[self.table_row].rename(options.offset_by) if options.offset_by else None
        return {
            "rssi_dbm": self.rssi,
            "transmitter_position": self.coordinate,
            "receiver_position": receiver_position,
            "receiver_names": self.names,
            "origin": self.origin,
            "groups": group,
            "labels": labels,
            "floors": floors,
            "receiver_moves": moves,
            "plan_scale": self.frame.scale if self.frame.y_down else None,
            "margin_db": self._list_margin(moves),
            "session": None if self.session is None else self.session.to_numpy()[self.table_row].tolist(),
            "time": self.time,
            "index": self.index,
            "notes": tuple(self.notes),
        }

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
                f"{self.source} has no column of RSSI in dBm (numbers below 0) besides positions; there are "
                f"{listed(table.columns)}; choose with columns rssi=NAME or rssi='PREFIX*'"
            )
        if len(self.names) == 1 and "rssi" not in asked and not self.end:
            where = [self.roles[role] for role in ("x", "y", "longitude", "latitude", "time") if role in self.roles]
            check_receiver_known(
                self.source, table, self.names[0], [name for name in others if name not in self.names], where
            )
        return left_out, notes

    def _list_margin(self, moves: bool) -> float | None:
        """Return how far an empty cell may be above the weakest value of its row [dB], and note what empty cells are."""
        margin_db = None if moves else list_margin(self.rssi, self.coordinate)
        kinds = {
            0.0: "rows list the strongest receivers only: an empty cell was weaker than the listed ones",
            np.inf: "rows hold packets of one receiver each: an empty cell is ignored",
        }
        associated = f"each row has one receiver, the associated one: others were at most {margin_db} dB stronger"
        if margin_db is not None:
            self.notes.append(f"{kinds.get(margin_db, associated)}, which is no sign of a signal below the limit")
        return margin_db

    def text(self, role: str) -> pd.Series | None:
        """Return the cells of the column of a role, None without one."""
        return text_of(self.table[self.roles[role]]) if role in self.roles else None

    def _labels(self, max_values: int = 30, min_rows: int = 10) -> tuple[str, ...]:
        """Return columns with few different values, each in several rows, that are no names of receivers. Not studied."""
        candidate = [name for name in (*self.unused, self.roles.get("session")) if name]
        if "receiver" in self.roles:
            several = self.table.groupby(self.roles["receiver"])[candidate].nunique().max() > 1
            candidate = [name for name in candidate if several[name]]
        counts = {name: text_of(self.table[name]).value_counts() for name in candidate}
        return tuple(name for name, n in counts.items() if 2 <= len(n) <= max_values and int(n.min()) >= min_rows)

    def _powers(self, names: Sequence[str], min_repeats: int = 5) -> Floats:
        """Return the RSSI in columns (n, len(names)), nan where it was not detected, for which a repeated word may stand."""
        values, text = (
            np.stack(part, axis=1) for part in zip(*(parsed(self.table[name]) for name in names), strict=True)
        )
        words = pd.Series(self.table[list(names)].to_numpy(dtype=object)[text], dtype=object).astype(str).str.strip()
        if len(words) >= min_repeats and words.nunique() == 1:
            cells = f"{len(words)} of {text.size} cells ({text.mean():.0%})"
            self.notes.append(f"{words[0]!r} counts as not detected: {cells}")
            return values
        for name in np.array(names)[text.any(axis=0)]:
            column_of_numbers(self.source, self.table, name)
        return values

    def _coordinates(self, roles: Mapping[str, str], frame: PlanFrame) -> tuple[Floats, PlanFrame, list[str]]:
        """Return the coordinates of the rows (n, 3) [m] or [deg], nan where empty, the frame they were in, and notes."""
        source, table = self.source, self.table
        both = [roles.get(role) or roles[GEODETIC[role]] for role in "xy"]
        x, y = (column_of_numbers(source, table, name) for name in both)
        if "x" not in roles and frame != PlanFrame():
            raise InputError(f"{source} has longitudes and latitudes, which --scale, --y-down and --up do not apply to")
        frame, notes = frame_of(source, table, both, frame) if "x" in roles else (frame, [])
        if "floor" in roles:
            floor, text = parsed(table[roles["floor"]])
            floor_names = text_of(table[roles["floor"]])
            floor = np.where(text, floor_numbers(floor_names.tolist()), floor)
            unknown = sorted(set(floor_names[text & np.isnan(floor)]))
        if "z" in roles:
            z = column_of_numbers(source, table, roles["z"]) / UNITS.get(unit_of(table[roles["z"]]), 1.0)
        elif "floor" in roles:
            if unknown:
                raise InputError(
                    f"{source} has no height, and the order of floor {unknown[0]!r} is unknown; number the floors or add "
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

    def _local_metres(self, min_extent_m: float = 3.0) -> tuple[Floats, GeodeticOrigin | None]:
        """Return positions (n, 3 or 6) [m] of coordinates that may be degrees, and the origin of the metres.

        A walk that is wider and higher than `min_extent_m`, and five times as high as deep, may have another axis upwards
        (not studied).
        """
        source, roles, asked = self.source, self.roles, self.options.coordinates
        position, origin = self.coordinate.reshape(-1, 3), None
        both = roles.get("x") or roles["longitude"], roles.get("y") or roles["latitude"]
        named = "longitude" in roles and "latitude" in roles
        degrees, notes = degrees_in(source, both, position[:, :2], named, asked)
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
            if depth < height / 5 and min(width, height) > min_extent_m:
                self.notes.append(
                    f"y spans {depth:.1f} m and z {height:.1f} m; if y is the height, give --up y, and else this stands as "
                    "it is"
                )
        check_positions(position, f"positions of {source}")
        return position.reshape(len(self.coordinate), -1), origin

    def _times(self, max_speed_m_s: float = 2e-3, max_step_m: float = 1.0, min_rows: int = 6) -> Floats | None:
        """Return the times of the rows [s], None without a column of them.

        Whole numbers at which the positions move slower than anybody walks, but not in milliseconds, are milliseconds. They
        are those of a log of movement, with at least 6 rows and a median step below 1 m (not studied).
        """
        if "time" not in self.roles:
            return None
        table = self.table.iloc[self.table_row]
        column = table[self.roles["time"]]
        days = [name for name in candidates(table, "time") if plain_name(name) == "date" and name != column.name]
        is_joined = bool(days) and column.dtype.kind not in "biufM" and text_of(column).str.fullmatch(CLOCK_ONLY).all()
        time, notes = seconds(column, table[days[0]] if is_joined else None)
        if is_joined:
            notes.append(f"columns {days[0]} and {column.name} together are the time")
        if not notes and np.isfinite(time).all() and len(time) >= min_rows and (parsed(column)[0] % 1 == 0).all():
            order = np.argsort(time, kind="stable")
            step, length = np.diff(time[order]), np.linalg.norm(np.diff(self.coordinate[order, :3], axis=0), axis=1)
            speed = length[step > 0].sum() / max(step.sum(), 1e-9)
            if 1e-5 < speed < max_speed_m_s and np.median(length) < max_step_m:
                time = time / 1e3
                notes.append(
                    f"column {column.name} counts milliseconds, which are converted to seconds: as seconds, the positions "
                    f"move {1e3 * speed:.1g} mm/s"
                )
        self.notes += notes
        return time

    def _form_packets(self, max_values: int = 2**27) -> None:
        """Form the rows of a long table, with at most `max_values` values of RSSI, a limit of memory.

        A row is a time and place. Repeated packets have a row each. Without a receiver, nothing was detected there.
        """
        receiver = text_of(self.table[self.roles["receiver"]])
        power, time, named = self._powers([self.roles["rssi"]])[:, 0], self.text("time"), (receiver != "").to_numpy()
        if len(nameless := np.flatnonzero(~named & ~np.isnan(power))):
            raise InputError(f"{self.source} row {nameless[0] + 1} has no receiver in column {self.roles['receiver']}")
        plain = receiver.map(plain_receiver)
        one = plain.map(dict(zip(plain[::-1], receiver[::-1], strict=True)))  # in the first spelling
        if len(others := receiver[one != receiver].unique()):
            self.notes.append(
                f"names count as those of one receiver that differ in case, separators or zeros: {listed(others)}"
            )
        keys = pd.DataFrame(self.coordinate).assign(kind=self.kind.to_numpy())
        keys["time"] = "" if time is None else time.to_numpy()
        packets = keys.assign(receiver=one.to_numpy())
        keys["repeat"] = packets.groupby(list(packets.columns), sort=False, dropna=False).cumcount()
        row = keys.groupby(list(keys.columns), sort=False, dropna=False).ngroup().to_numpy()
        column, names = pd.factorize(one[named])
        _, first = np.unique(row, return_index=True)
        if len(first) * len(names) > max_values:
            raise InputError(
                f"{self.source} has {len(first)} rows and {len(names)} receivers; at most {max_values} values are read"
            )
        self.names, self.coordinate, at = list(names), self.coordinate[first], (row[named], column)
        self.rssi, self.table_row = np.full((len(first), len(names)), np.nan), np.tile(first[:, None], len(names))
        self.rssi[at], self.table_row[at] = power[named], np.flatnonzero(named)

    def _end_as_receivers(self, max_receivers: int = 500) -> Floats:
        """Take the end with fewer positions as receivers, and return their positions (R, 3) [m].

        If there are more than `max_receivers`, positions are averaged in cubes; each has a column of RSSI in memory.
        """
        if self.rssi.shape[1] != 1:
            raise InputError(
                f"{self.source} has positions of both ends and RSSI of {self.rssi.shape[1]} receivers; name one: columns "
                "rssi=NAME, or pool them: pool_by"
            )
        ends = self.coordinate[:, 3:], self.coordinate[:, :3]
        other, self.coordinate = sorted(ends, key=lambda end: len(np.unique(end, axis=0)))
        number, edge = cells(torch.from_numpy(other), max_receivers)
        position: Floats = pd.DataFrame(other).groupby(number.numpy()).mean().to_numpy()
        n = len(position)
        self.notes.append(f"both ends move; {n} positions of one of them count as receivers place1 to place{n}")
        if edge:
            self.notes.append(f"its positions are averaged in cubes of {edge:.3g} m")
        power, self.rssi = self.rssi[:, 0], np.full((len(other), n), np.nan)
        self.rssi[np.arange(len(other)), number.numpy()] = power
        self.names = [f"place{number}" for number in range(1, n + 1)]
        return position

    def _pools(self, by: str) -> list[str]:
        """Return the access point of each radio, by a column of a long table or by the radio's name."""
        if by not in self.table.columns:
            return pool_names(self.names, by)
        receiver = self.text("receiver")
        if receiver is None:
            raise InputError(
                f"{self.source} has a column for each receiver; pool by their names: mac or a regular expression"
            )
        pairs = pd.DataFrame({"radio": receiver, "pool": text_of(self.table[by])}).drop_duplicates()
        if len(several := pairs["radio"][pairs["radio"].duplicated()]):
            raise InputError(
                f"{self.source}: receiver {several.iloc[0]!r} has several values in column {by!r}, so it is no access point"
            )
        pool = dict(zip(pairs["radio"], pairs["pool"], strict=True))
        return [pool[name] or name for name in self.names]
