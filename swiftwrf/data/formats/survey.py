"""Reader of survey tables: positions and RSSI, one column a receiver (wide) or one row a packet (long).

Tables are CSV, maybe compressed or in a workbook, or Parquet, the records in JSON, GPX and KML documents, or logs in
databases.
"""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import torch

from swiftwrf.data.columns import is_coordinate, is_rssi
from swiftwrf.data.files import BINARIES, SUFFIXES, TABLES, TEXTS, digests, has_header, read_table
from swiftwrf.data.formats.base import SNAPSHOT_FORMATS, Format, ReadOptions
from swiftwrf.data.formats.nerf2 import FILES as NERF2_FILES
from swiftwrf.data.logs import is_log_of_scans, is_track, joined_by_time
from swiftwrf.data.options import TableOptions
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import kept_splits, read_splits
from swiftwrf.data.survey import has_positions, read_survey
from swiftwrf.errors import InputError, listed

RECEIVERS = "receivers.csv"  # beside the table: receiver,x,y,z
TRACKS = (".gpx", ".kml")  # beside a log of scans without positions
COORDINATES = re.compile(r"(?:crd|coord(?:inate)?s?|pos(?:ition)?s?|loc(?:ation)?s?|places?)(?![a-z])")
HALF = re.compile(rf"[ _-]*(?:rssi?(?![a-z])|{COORDINATES.pattern})[ _-]*")


class SurveyTable(Format[Rssi]):
    """Table of a walk test; positions of receivers are unknown unless receivers.csv beside it contains them."""

    takes = frozenset(TableOptions.__dataclass_fields__)

    def recognises(self, path: Path) -> bool:
        return bool(_tables(path))

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        file, others, table = _table(path)
        beside = file.with_name(RECEIVERS)
        receivers = beside if beside.is_file() else None
        receivers = receivers if options.receiver_positions is None else Path(options.receiver_positions)
        splits = read_splits(file.parent, len(table), first=0)
        arguments = read_survey(file, table, options, receivers, keeps_rows=bool(splits))
        data = Rssi(
            **arguments,
            name=file.stem.removesuffix(".csv"),
            named_splits=kept_splits(splits, torch.from_numpy(arguments["index"]), len(table)),
            source=digests([file, *others, *([receivers] if receivers else [])], file.parent),
        )
        if data.receiver_moves and bool(data.receiver_position.isnan().any()):
            raise InputError(
                f"{file}: column {options.transmitter[0]} has names of positions, so {RECEIVERS} beside it must contain "
                "each of them"
            )
        return data


def _tables(path: Path) -> list[Path]:
    if SNAPSHOT_FORMATS["captures"]().recognises(path):
        return []
    if path.is_file():
        return [path] if path.suffix.lower() in TABLES else []
    if any((path / name).is_file() for name in NERF2_FILES):
        return []
    files = sorted(file for file in path.iterdir() if file.is_file() and file.name != RECEIVERS)
    plain = [file for file in files if file.suffix.lower() in SUFFIXES]
    return plain or [file for file in files if file.suffix.lower() in (*TEXTS, *BINARIES)]


def _table(path: Path) -> tuple[Path, list[Path], pd.DataFrame]:
    """Return the file of RSSI, other files that its table is of, and the table, which may be in two halves."""
    files = _tables(path)
    if path.is_file() and not has_header(path):
        name_of_both = HALF.sub("", path.stem.lower())
        related = [file for file in _tables(path.parent) if HALF.sub("", file.stem.lower()) == name_of_both]
        files = related if len(related) == 2 else files
    if len(files) == 1:
        table = read_table(files[0])
        tracks = sorted(file for file in path.iterdir() if file.suffix.lower() in TRACKS) if path.is_dir() else []
        if len(tracks) != 1 or not is_log_of_scans(table):
            return files[0], [], table
        files = [files[0], *tracks]
    tables = {file: read_table(file, header=has_header(file)) for file in files} if len(files) == 2 else {}
    for scans, track in (files, files[::-1]) if tables else ():
        if is_log_of_scans(tables[scans]) and is_track(tables[track]):
            table, notes = joined_by_time(path, tables[track], tables[scans])
            joined = f"scans of {scans.name} have the positions of {track.name}, interpolated at their times"
            table.attrs["notes"] = [joined, *notes]
            return scans, [track], table
    halves = {_holds_places(file, table): file for file, table in tables.items()}
    if halves.keys() != {False, True} or len({len(table) for table in tables.values()}) > 1:
        raise InputError(
            f"{path} holds {len(files)} tables ({listed(file.name for file in files)}); name the one to read"
        )
    file, other = halves[False], halves[True]
    rssi, place = tables[file], tables[other]
    if not has_header(other):
        place = place.iloc[:, :3].set_axis(["x", "y", "z"][: place.shape[1]], axis=1)
    if not has_header(file):
        rssi = rssi.add_prefix("receiver")
    table = pd.concat([place, rssi], axis=1)
    table.attrs["notes"] = [f"{file.name} holds the RSSI and {other.name} the positions of the same {len(table)} rows"]
    return file, [other], table


def _holds_places(file: Path, table: pd.DataFrame, max_columns: int = 6) -> bool | None:
    """Return True for a table of positions alone, False for one of RSSI alone, None for another one.

    Positions have up to 6 columns: x, y, z, floor, building, ...
    """
    powers = [is_rssi(table[name]) and not is_coordinate(name) for name in table]
    if has_positions(table, {}):
        return None if any(powers) or len(powers) > max_columns else True
    may_be_places = 2 <= len(powers) <= max_columns and "1" in table  # without header
    if may_be_places and (not all(powers) or COORDINATES.search(file.stem.lower())):
        return True
    return False if all(powers) else None
