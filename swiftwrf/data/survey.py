"""Tables of positions and RSSI: the columns of a walk test, recognised by their names.

A wide table has one column a receiver, a long one has one row a packet. Both ends of a link may move, and radios of one
access point may be pooled.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.cells import parsed, plain_name, text_of
from swiftwrf.data.columns import (
    ACCURACY,
    GEODETIC,
    SNR,
    TRANSMITTED,
    candidates,
    check_receiver_known,
    column_of,
    column_of_quantity,
    columns_of_end,
    find_roles,
    labels_of,
    receiver_columns,
    relay_columns,
)
from swiftwrf.data.coordinates import PlanFrame, floors_of, without_fix
from swiftwrf.data.options import TableOptions
from swiftwrf.data.packets import rows_of_packets, without_relayed
from swiftwrf.data.places import floor_column, local_metres, read_coordinates, receivers_of_ends
from swiftwrf.data.powers import (
    RSSI_UNITS,
    check_powers,
    end_of_scale,
    find_fillers,
    in_dbm,
    of_one_power,
    powers_in,
    signal_power,
    without_fillers,
)
from swiftwrf.data.radios import bands_of_receivers, pooled, pools_by, propose_pools
from swiftwrf.data.ranked import from_ranked_lists
from swiftwrf.data.receivers import read_receivers
from swiftwrf.data.scans import bad_fixes, held_fixes, list_margin, repeated_scans, split_packets, times_of, windows
from swiftwrf.data.zones import zone_column
from swiftwrf.errors import InputError, listed


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
        n_listed: Rows of `table` for each row of the source: the length of its ranked lists, else 1.
        end: Columns of the second end by x, y and z.
        names: Names of the R receivers.
        bands: Their bands, None without a column of these.
        left_out: Columns of other quantities than the received power.
        accuracy: Column with the stated accuracy of fixes, None without one.
        relays: Columns that count the relays of a packet, none without these.
        corrected: Column of the transmit power that is subtracted, empty without one.
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
        asked = dict(options.columns or {})
        if options.quantity is not None and "rssi" not in asked:
            asked["rssi"] = column_of_quantity(source, table, options.quantity)
        table, self.n_listed, notes = from_ranked_lists(table, asked)
        self.notes += notes
        if options.unit in RSSI_UNITS and options.quantity is None:
            names = [asked["rssi"]] if asked.get("rssi") in table else fnmatch.filter(table, asked.get("rssi", ""))
            table, notes = in_dbm(source, table, names or candidates(table, "rssi")[:1], options.unit)
            self.notes += notes
        self.table, self.names, self.end, self.corrected = table, list[str](), dict[str, str](), ""
        self.bands: list[str] | None = None
        if len(options.transmitter) == 1:
            asked["receiver"] = options.transmitter[0]
        elif options.transmitter or not {"x", "y"} & asked.keys():
            self.end = columns_of_end(source, table, options.transmitter)
        self.roles = find_roles(source, table, asked, self.end.values())
        if "floor" not in self.roles:
            taken_columns = {name for role, name in self.roles.items() if role != "rssi"} | {*self.end.values()}
            other = floor_column(source, table, {*taken_columns, *asked.values(), options.offset_by or ""})
            self.roles |= {} if other is None else {"floor": other}
        if (floor := self.text("floor")) is not None and not floor.any():
            self.notes.append(f"column {self.roles.pop('floor')} is empty, so there are no floors")
        used = {options.offset_by, options.pool_by, *self.end.values()}
        used |= {zone_column(table, self.roles["x"])} if "x" in self.roles else set()
        self.left_out, notes = ([], []) if "receiver" in self.roles else self._find_receivers(asked, used)
        taken = [f"{role} = {name}" for role, name in self.roles.items()]
        taken += [f"transmitter {axis} = {name}" for axis, name in self.end.items()]
        if self.names:
            several = f"RSSI of {len(self.names)} receivers = {listed(self.names)}"
            taken.append(several if len(self.names) > 1 else f"RSSI = {self.names[0]}")
        self.accuracy = next((n for n in self._named(ACCURACY) if not parsed(table[n])[1].any()), None)
        taken += [f"accuracy of fixes = {self.accuracy}"] * (self.accuracy is not None)
        self.relays = [name for name in relay_columns(table) if name not in (*used, *self.roles.values())]
        used |= {*self.roles.values(), *self.names, *self.left_out, *self.relays, self.accuracy}
        self.notes += [f"taken as: {', '.join(taken)}", *notes]
        self.unused = [name for name in table.columns if name not in used]

    def form_rows(self) -> None:
        """Form rows of coordinates and RSSI: those of a wide table, or one a time, place and packet of a long one."""
        options, column = self.options, self.options.offset_by
        frame = PlanFrame(options.scale, options.y_down, options.up)
        self.coordinate, self.frame, notes = read_coordinates(self.source, self.table, self.roles, frame)
        self.notes += notes
        if self.end:
            other_end = read_coordinates(self.source, self.table, self.end, self.frame)[0]
            self.coordinate = np.hstack([self.coordinate, other_end])
            self.coordinate[np.isnan(self.coordinate).any(axis=1)] = np.nan
        self.group = text_of(self.table[column]) if column else pd.Series([""] * len(self.table))
        self.session = self.text("session")
        self.kind = self.group if self.session is None else self.group + "\n" + self.session  # rows that stay apart
        if "receiver" in self.roles:
            keys, time = pd.DataFrame(self.coordinate), self.text("time")
            keys = keys.assign(kind=self.kind.to_numpy(), time="" if time is None else time.to_numpy())
            power, words = powers_in(self.source, self.table, [self.roles["rssi"]])
            packets = rows_of_packets(self.source, self.table, self.roles["receiver"], power[:, 0], keys, self.n_listed)
            self.names, self.rssi, self.table_row, notes = packets
            self.coordinate, self.notes = self.coordinate[self.table_row.min(axis=1)], self.notes + words + notes
            at = np.nonzero(~np.isnan(self.rssi))
            if found := bands_of_receivers(self.table, self.table_row[at], at[1], len(self.names)):
                name, self.bands = found
                self.unused = [other for other in self.unused if other != name]
                self.notes.append(f"bands of receivers are those of column {name}: {listed(dict.fromkeys(self.bands))}")
        else:
            self.rssi, words = powers_in(self.source, self.table, self.names)
            self.table_row, self.notes = np.arange(len(self.table))[:, None], self.notes + words
        if self.unused:
            self.notes.append(f"columns that are not used: {listed(self.unused)}")

    def clean_powers(self) -> None:
        """Take fillers as not detected, refuse what is no received power, and pool radios."""
        by = self.options.pool_by
        self.rssi, self.relayed, notes = without_relayed(self.table, self.relays, self.rssi, self.table_row)
        self.notes += notes
        if self.options.quantity is not None:
            values = np.where(np.isfinite(self.rssi), self.rssi, np.nan)
            self.rssi, notes = without_fillers(values, list(self.options.filler or ()), self.options.quantity)
            self.notes += notes
            return
        fillers = find_fillers(self.rssi) if self.options.filler is None else list(self.options.filler)
        self.rssi, notes = without_fillers(self.rssi, fillers)
        check_powers(self.source, self.rssi, self.names, self.table_row // self.n_listed)
        self.notes += notes + end_of_scale(self.rssi)
        self._correct_powers()
        if by is not None:
            pools = pools_by(self.source, self.table, self.names, self.roles.get("receiver"), by)
            self.names, self.rssi, notes = pooled(self.rssi, pools, by)
            self.bands = None
            self.notes += notes
        else:
            self.notes += propose_pools(self.names, self.rssi)

    def _correct_powers(self) -> None:
        """Take the power of signals below the noise, and that of one transmit power, where columns determine these."""
        power_name = plain_name(self.roles.get("rssi", self.names[0]))
        is_of_each = (len(self.names) == 1 or "receiver" in self.roles) and "rsrp" not in power_name
        for name in self._named(SNR) if is_of_each else []:
            power = signal_power(self.rssi, parsed(self.table[name])[0][self.table_row])
            if power is not None:
                self.rssi = power
                self.notes.append(
                    "RSSI of packets below the noise is that of the noise; the power of the signal follows with SNR = "
                    f"{name}: RSSI + SNR - 10 log10(1 + 10^(SNR/10))"
                )
                break
        for name in self._named(TRANSMITTED):
            power_of_row = parsed(self.table[name])[0][self.table_row]
            if (of_one := of_one_power(self.rssi, power_of_row, self.coordinate[:, :3])) is not None:
                (self.rssi, reference), self.corrected = of_one, name
                self.notes.append(f"differences of {name} are subtracted: RSSI counts as with {name} = {reference:g}")
                break

    def _named(self, pattern: re.Pattern[str]) -> list[str]:
        """Return the columns without another use whose names match a pattern."""
        used = {*self.names, *self.roles.values(), self.options.offset_by}
        return [name for name in self.table.columns if name not in used and pattern.fullmatch(plain_name(name))]

    def leave_out_rows(self, keeps_rows: bool) -> None:
        """Leave out rows without a position, and cached scans unless `keeps_rows`."""
        omitted, notes = without_fix(self.coordinate[:, :3])
        if omitted.all():
            raise InputError(f"{self.source} has no row with a position; {notes[0]}")
        row = np.flatnonzero(~(omitted | self.relayed))
        if not len(row):
            raise InputError(f"{self.source} has only packets that a relay sent in rows with a position")
        repeated = repeated_scans(self.coordinate[row], self.rssi[row])
        if repeated.any():
            fate = "stay because of the given splits" if keeps_rows else "are left out"
            notes.append(
                "rows that repeat all values of the row before at another place, as cached scans do, "
                f"{fate}: {int(repeated.sum())} of {len(row)}"
            )
            row = row if keeps_rows else row[~repeated]
        if not keeps_rows and (held := held_fixes(self.coordinate[row])).any():
            notes.append(
                f"rows that repeat a held fix, before a jump to the next one, are left out: {held.sum()} of {len(row)}"
            )
            row = row[~held]
        if not keeps_rows:
            row, of_accuracy = self._accurate(row)
            notes += of_accuracy
        self.notes += notes
        self.index, self.table_row = row, self.table_row.max(axis=1)[row]
        self.rssi, self.coordinate = self.rssi[row], self.coordinate[row]

    def _accurate(self, row: NDArray[np.int64]) -> tuple[NDArray[np.int64], list[str]]:
        """Return the rows without fixes whose stated accuracy is bad, and a note on these."""
        if self.accuracy is None:
            return row, []
        bad, limit = bad_fixes(parsed(self.table[self.accuracy])[0][self.table_row.max(axis=1)[row]])
        note = f"fixes with {self.accuracy} above {limit:.3g} are left out: {bad.sum()} of {len(row)} rows"
        return row[~bad], [note] * bool(bad.any())

    def project(self) -> None:
        """Project degrees to local metres, and leave out receivers that never detected the transmitter."""
        asked = self.options.coordinates
        self.coordinate, self.origin, notes = local_metres(self.source, self.coordinate, self.roles, asked)
        self.notes += notes
        kept = (~np.isnan(self.rssi)).any(axis=0)
        if not kept.any():
            raise InputError(f"{self.source} holds no RSSI that a receiver detected")
        if not kept.all():
            self.notes.append(f"receivers that never detected the transmitter are left out: {int((~kept).sum())}")
        self.names, self.rssi = [self.names[i] for i in np.flatnonzero(kept)], self.rssi[:, kept]
        self.bands = self.bands and [self.bands[i] for i in np.flatnonzero(kept)]

    def find_times(self) -> None:
        """Find the times of rows, and join the rows of each window."""
        window, self.time = self.options.window, None
        if "time" in self.roles:
            self.time, notes = times_of(self.table.iloc[self.table_row], self.roles["time"], self.coordinate)
            self.notes += notes
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
        receiver_position = None
        if self.end:
            self.coordinate, receiver_position, self.rssi, notes = receivers_of_ends(
                self.source, self.coordinate, self.rssi
            )
            self.names = [f"place{number}" for number in range(1, len(receiver_position) + 1)]
            self.notes += notes
        candidate = [*self.unused, *self.left_out, *([self.roles["session"]] if "session" in self.roles else [])]
        candidate = [name for name in candidate if name != self.corrected]
        labels, moves = (
            labels_of(self.table, candidate, self.roles.get("receiver")),
            bool(self.end or options.transmitter),
        )
        if labels and not options.offset_by:
            self.notes.append(
                f"rows differ in {listed(labels)}; swiftwrf inspect tests whether its values have constant offsets"
            )
        if moves and not self.end:
            column = options.transmitter[0]
            self.notes.append(f"both ends move; {len(self.names)} positions of column {column} count as receivers")
        if options.quantity is not None:
            what = f"values are {options.quantity} in {options.unit}"
            self.notes.append(f"{what}: maps have no path loss and no limit of detection")
            if moves:
                raise InputError(f"{self.source} has positions of both ends, which only a model of RSSI takes; {what}")
        elif receivers is not None and receiver_position is None:
            stated = options.receiver_positions is not None
            known, bands, notes = read_receivers(receivers, self.names, self.origin, self.frame, stated)
            receiver_position, self.bands = known.numpy(), bands or self.bands
            self.notes += notes
        group = self.group.iloc[self.table_row].rename(options.offset_by) if options.offset_by else None
        return {
            "rssi_dbm": self.rssi,
            "transmitter_position": self.coordinate,
            "receiver_position": receiver_position,
            "receiver_names": self.names,
            "bands": None if self.end else self.bands,
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
            **({"quantity": options.quantity, "unit": options.unit} if options.quantity else {}),
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
                f"{listed(table.columns)}; choose with columns rssi=NAME or rssi='PREFIX*', map another quantity (quantity "
                "and unit), or give unit percent or positive"
            )
        if len(self.names) == 1 and "rssi" not in asked and not self.end:
            where = [self.roles[role] for role in ("x", "y", "longitude", "latitude", "time") if role in self.roles]
            check_receiver_known(
                self.source, table, self.names[0], [name for name in others if name not in self.names], where
            )
        return left_out, notes

    def _list_margin(self, moves: bool) -> float | None:
        """Return how far an empty cell may be above the weakest value of its row [dB], and note what empty cells are."""
        if self.options.quantity is not None:
            return None
        margin_db = None if moves else list_margin(self.rssi, self.coordinate)
        if 1 < self.n_listed < len(self.names):
            margin_db = 0.0
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
