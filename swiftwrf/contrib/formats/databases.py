"""Tables in files of other programs: logs of WiGLE and Kismet in SQLite databases, and workbooks of spreadsheets.

Sources: the database of https://github.com/wiglenet/wigle-wifi-wardriving, and
https://www.kismetwireless.net/docs/dev/kismetdb/
"""

from __future__ import annotations

import csv
import io
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import pandas as pd

from swiftwrf.data.archives import MAX_UNPACKED_BYTES, refusing_broken
from swiftwrf.data.files import refusing_unreadable
from swiftwrf.errors import InputError, listed, optional_module

QUERIES = {  # by the table of observations
    "location": "SELECT time, bssid, level AS rssi, lat, lon, altitude, accuracy FROM location",
    # 0 stands for an unknown power, and for an address that is none
    "packets": "SELECT ts_sec + ts_usec / 1e6 AS time, transmac AS bssid, signal AS rssi, lat, lon, alt AS altitude, "
    "frequency FROM packets WHERE signal < 0 AND transmac NOT IN ('', '00:00:00:00:00:00')",
}
OLD_KISMET_UNITS = 1e5  # of a degree, in which versions below 5 count


def table_in_log(file: Path) -> pd.DataFrame:
    """Return the observations in a database of WiGLE or Kismet: time, bssid, rssi [dBm], lat, lon [deg], altitude [m].

    Raises:
        InputError: Another database, a broken one, or one without observations.
    """
    with refusing_unreadable(file), refusing_broken(file, "a SQLite database"):
        if file.stat().st_size > MAX_UNPACKED_BYTES:
            raise InputError(f"it has more than {MAX_UNPACKED_BYTES} bytes; split the data")
        # immutable: nothing is written beside the file, not even a lock
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            known = next((name for name in QUERIES if name in names), None)
            if known is None:
                raise InputError(
                    f"it is no database of WiGLE or Kismet; export one of its tables as CSV ({listed(names) or 'none'})"
                )
            table = pd.read_sql_query(QUERIES[known], database)
        if table.empty:
            raise InputError(f"its table {known} has no row with a received power")
        if known == "packets" and (table[["lat", "lon"]].abs() > (90, 180)).any(axis=None):
            table[["lat", "lon"]] /= OLD_KISMET_UNITS
    table.attrs["notes"] = [f"rows are those of table {known}"]
    return table


def text_in_workbook(file: Path, most: int) -> bytes:
    """Return the only sheet with values of a workbook (.xlsx) as comma-separated text in UTF-8.

    Raises:
        InputError: openpyxl is not installed, a broken file, none or several such sheets, or more than `most` bytes.
    """
    openpyxl = optional_module(
        "openpyxl", f"{file} is a workbook, which openpyxl reads (or save the sheet as CSV)", "xlsx"
    )
    with refusing_unreadable(file), refusing_broken(file, "a workbook"):
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_UNPACKED_BYTES:
                raise InputError(f"it unpacks to more than {MAX_UNPACKED_BYTES} bytes; split the table")
        texts = {}
        with closing(openpyxl.load_workbook(file, read_only=True, data_only=True)) as book:
            for sheet in book.worksheets:
                lines = io.StringIO()
                rows = (row for row in sheet.iter_rows(values_only=True) if any(cell is not None for cell in row))
                csv.writer(lines, lineterminator="\n").writerows(rows)
                texts[sheet.title] = lines.getvalue().encode()
        filled = [title for title, text in texts.items() if text]
        if len(filled) != 1:
            raise InputError(f"{len(filled)} of its sheets have values ({listed(texts)}); save one of them as CSV")
        if len(texts[filled[0]]) > most:
            raise InputError(f"its table has more than {most} bytes; split it")
        return texts[filled[0]]


def refuse_workbook(file: Path) -> pd.DataFrame:
    """Refuse a workbook in another form than .xlsx.

    Raises:
        InputError: Always.
    """
    raise InputError(
        f"{file} is a workbook; save it as .xlsx, or the sheet as CSV in UTF-8 with the names of columns in the first line"
    )
