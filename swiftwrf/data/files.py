"""Text files of measurements: read without running code, refused in one sentence that names file and row."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from swiftwrf.choices import CARRIERS_HZ
from swiftwrf.data.archives import MAX_UNPACKED_BYTES, PACKED, refusing_broken
from swiftwrf.data.cells import NO_VALUE, column_of_numbers, with_decimal_points
from swiftwrf.errors import InputError, optional_module
from swiftwrf.runtime.plain import TextLoader
from swiftwrf.runtime.registry import Registry

SUFFIXES = (".csv", ".parquet")  # of tables in a folder
# functions that return the table in a document, from its name, its text and its suffix
DOCUMENTS: Registry[pd.DataFrame] = Registry(
    "document",
    declared=dict.fromkeys(
        (".json", ".geojson", ".gpx", ".kml"), "swiftwrf.contrib.formats.documents:table_in_document"
    ),
)
# functions that return the table in a file of another program, from its path
BINARIES: Registry[pd.DataFrame] = Registry(
    "binary file",
    declared=dict.fromkeys((".sqlite", ".sqlite3", ".db", ".kismet"), "swiftwrf.contrib.formats.databases:table_in_log")
    | dict.fromkeys((".xls", ".ods"), "swiftwrf.contrib.formats.databases:refuse_workbook"),
)
# functions that return the text in a file, in UTF-8, from its path and the most bytes
TEXTS: Registry[bytes] = Registry(
    "file with a text",
    declared={".xlsx": "swiftwrf.contrib.formats.databases:text_in_workbook"}
    | dict.fromkeys(PACKED, "swiftwrf.data.archives:unpacked"),
)
TABLES = (*SUFFIXES, *DOCUMENTS, *TEXTS, *BINARIES)  # of tables that are named
SEPARATORS = ",;\t"
# cells of a row of a log of the KrakenSDR, before four reserved ones and the values of its spectrum
# (github.com/krakenrf/krakensdr_docs/wiki, CSV format)
KRAKEN_LOG = (
    *("timestamp", "bearing", "confidence", "rssi", "frequency_hz", "array_type", "latency_ms", "station", "latitude"),
    *("longitude", "heading", "compass_heading", "heading_sensor"),
)
KRAKEN_RESERVED = ["R"] * 4
MAX_TEXT_BYTES = 2**28  # a million rows of positions take a tenth of it


def sha256(file: Path) -> str:
    """Return the hex digest of a file, which may be larger than the memory.

    Raises:
        InputError: The file is missing or may not be read.
    """
    with refusing_unreadable(file), file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digests(files: Iterable[Path], split_folder: Path | None = None) -> dict[str, str]:
    """Return sha256 by name of the given files, and of all split files in a folder."""
    splits = sorted(split_folder.glob("*_index*.txt")) if split_folder else []
    return {file.name: sha256(file) for file in [*files, *splits]}


@contextmanager
def refusing_unreadable(file: Path) -> Iterator[None]:
    """Raise InputError if a file is missing, is none, or may not be read."""
    try:
        if not file.is_file():
            raise InputError(f"{file} is {'no file' if file.exists() else 'missing'}")
        yield
    except OSError as error:
        reason = "no permission to read it" if isinstance(error, PermissionError) else error.strerror
        raise InputError(f"{file} cannot be read ({reason})") from None


def read_bytes(file: Path) -> bytes:
    """Return the content of a file.

    Raises:
        InputError: The file is missing or may not be read.
    """
    with refusing_unreadable(file):
        return file.read_bytes()


def read_text(file: Path) -> str:
    """Return a text in UTF-8, with or without a byte-order mark, which may be compressed as .gz or .zip, or in a workbook.

    Raises:
        InputError: The file is missing, larger than 256 MiB, broken, or in another encoding.
    """
    with refusing_unreadable(file):
        size = file.stat().st_size
    if size > MAX_TEXT_BYTES:
        raise InputError(f"{file} has {size} bytes; a table or list has at most {MAX_TEXT_BYTES}")
    kind = file.suffix.lower()
    content = TEXTS[kind](file, MAX_TEXT_BYTES) if kind in TEXTS else read_bytes(file)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no text in UTF-8 (byte {error.start + 1}); save it in that encoding") from None
    if "\0" in text:
        raise InputError(f"{file} is no text in UTF-8: it holds zero bytes; save it in that encoding")
    return text


def number(text: object) -> float:
    """Return the number in a text, nan if there is none. Unlike Python's float, it refuses 1_0."""
    try:
        return float(text) if isinstance(text, str) and "_" not in text else math.nan
    except ValueError:
        return math.nan


def read_yaml(file: Path) -> dict[str, Any]:
    """Return a YAML mapping. Scalars stay text, so a name such as `NA` or `2001-01-01` stays a name, and no objects arise.

    Raises:
        InputError: No such file, not YAML, not a mapping, or a name twice.
    """
    with refusing_broken(file, "valid YAML"):
        content = yaml.load(read_text(file), Loader=TextLoader)
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold names and values, got {type(content).__name__}")
    return content


def numbers(value: Any, count: int) -> tuple[float, ...] | None:
    """Return `count` finite numbers from a list of `read_yaml`, None if it is something else."""
    values = tuple(number(item) for item in value) if isinstance(value, list) and len(value) == count else (math.nan,)
    return values if all(map(math.isfinite, values)) else None


def _lines_before_header(text: str, max_lines: int = 20, max_missing_cells: int = 3) -> int:
    """Return the number of lines before the header of a table, e.g. 1 for a first line of metadata, at most 20.

    The header is the first line of names that has as many cells as the line below, or that is followed by numbers and up to
    3 cells longer or shorter.
    """
    lines = text.split("\n", max_lines + 2)[: max_lines + 2]
    for skipped, (line, below) in enumerate(itertools.pairwise(lines)):
        separator = _separator(line)
        try:
            header, row = (next(csv.reader([each], delimiter=separator), []) for each in (line, below))
        except csv.Error:  # table_of refuses it
            return 0
        names = [cell for cell in header if cell.strip()]
        is_header = len(names) > 1 and all(math.isnan(number(cell)) for cell in names)
        if len(header) == len(row) > 1 and (is_header or not skipped):
            return skipped
        has_numbers = sum(not math.isnan(number(cell)) for cell in row) > 1
        if is_header and has_numbers and abs(len(header) - len(row)) <= max_missing_cells:
            return skipped
    return 0


def read_table(file: Path, header: bool = True) -> pd.DataFrame:
    """Return the table in a CSV, Parquet, JSON, GPX or KML file. Cells are text, except those of Parquet and databases.

    Args:
        file: A log as in `swiftwrf.contrib.formats.databases`, a document as in `swiftwrf.contrib.formats.documents`,
            Parquet, or one row a line with commas, semicolons or tabs between values; the most frequent one in the header
            counts. Numbers may have a decimal comma, in quotes if the separator is a comma. Lines before the header are
            skipped. Texts may be compressed as .gz or .zip, or in a workbook (.xlsx).
        header: The first line contains the names of the columns. Otherwise, they are named 1, 2, ...

    Returns:
        A table. Its attrs may contain `notes` on lines, rows and columns that are left out, and the `preamble`.

    Raises:
        InputError: No such file, one that is broken, a column without name or a name twice, rows of unequal length, no rows.
    """
    kind = _kind(file)
    if kind in (*DOCUMENTS, *BINARIES):
        table: pd.DataFrame = BINARIES[kind](file) if kind in BINARIES else DOCUMENTS[kind](file, read_text(file), kind)
        return table
    if kind != ".parquet":
        text = read_text(file)
        skipped = _lines_before_header(text) if header else 0
        *before, rest = text.split("\n", skipped)
        table = table_of(file, rest, header)
        if skipped:
            table.attrs["preamble"] = "\n".join(before)
            table.attrs["notes"] = [f"lines before the header are skipped: {skipped}", *table.attrs["notes"]]
        return table
    parquet = optional_module("pyarrow.parquet", f"{file} is Parquet, which pyarrow reads", "formats")
    with refusing_broken(file, "a Parquet file"):
        content = parquet.ParquetFile(file)
        groups = range(content.metadata.num_row_groups)
        if (total := sum(content.metadata.row_group(i).total_byte_size for i in groups)) > MAX_UNPACKED_BYTES:
            raise InputError(f"it unpacks to {total} bytes; at most {MAX_UNPACKED_BYTES} are read, so split the data")
        return content.read().to_pandas()


def has_header(file: Path) -> bool:
    """Return False if the first line of a table holds values: numbers alone, with signs, fractions or twice the same."""
    if _kind(file) in (".parquet", *DOCUMENTS, *BINARIES):
        return True
    line = read_text(file).split("\n", 1)[0]
    return not _holds_values(next(csv.reader([line], delimiter=_separator(line)), []))


def _kind(file: Path) -> str:
    """Return the suffix of a file, of a compressed one that of its content."""
    kind = Path(file.stem if file.suffix.lower() == ".gz" else file).suffix.lower()
    return ".csv" if kind in (".parquet", *BINARIES) and kind != file.suffix.lower() else kind


def _separator(header: str) -> str:
    return max(SEPARATORS, key=header.count)


def _holds_values(cells: list[str]) -> bool:
    is_number = bool(cells) and not any(math.isnan(number(cell)) for cell in cells)
    return is_number and (len(set(cells)) < len(cells) or any(set("-.") & set(cell) for cell in cells))


def table_of(source: object, text: str, header: bool = True) -> pd.DataFrame:
    """Return the table in the text of a CSV file, as `read_table`; messages begin with the source."""
    separator = _separator(text.split("\n", 1)[0])
    shared = lru_cache(maxsize=2**16)(str)  # equal cells of neighbouring rows are one object in memory
    with refusing_broken(source, "a comma-separated table"):
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        lines = [list(map(shared, line)) for line in reader if line]
    if not lines:
        raise InputError(f"{source} is empty; expected a header and one row a measurement")
    first, end = [cell.strip() for cell in lines[0]], len(KRAKEN_LOG)
    is_kraken = first[end : end + len(KRAKEN_RESERVED)] == KRAKEN_RESERVED
    if is_kraken:
        lines = [[*KRAKEN_LOG], *(line[:end] for line in lines)]
    elif header and _holds_values(lines[0]):
        raise InputError(
            f"{source} has no header, its first line holds numbers; write the names of the columns above it"
        )
    elif not header:
        lines = [[str(column) for column in range(1, len(lines[0]) + 1)], *lines]
    if separator != "," or '"' in text:
        lines = [lines[0], *with_decimal_points(lines[1:], quoted=separator == ",")]
    names, rows, notes = _regular(source, lines)
    table = pd.DataFrame(rows, columns=names, dtype=object)
    bearings = (
        "a log of a KrakenSDR, whose first line holds values: its bearings and spectra are of an array that moves"
    )
    table.attrs["notes"] = [f"{bearings}, and are not used"] * is_kraken + notes
    return table


def _regular(
    source: object, lines: list[list[str]], max_missing_cells: int = 3
) -> tuple[list[str], list[list[str]], list[str]]:
    """Return names of columns, rows of equal length, and notes on lines, rows and columns without content.

    All rows may lack up to 3 cells at their end.
    """
    names = _names_in(lines[0])
    repeated = [line for line in lines[1:] if line[0].strip(" #") == names[0] and _names_in(line) == names]
    rows = [line for line in lines[1:] if line not in repeated and any(map(str.strip, line))]
    notes = []
    if repeated:
        notes.append(f"lines that repeat the header are left out: {len(repeated)}")
    if not rows:
        raise InputError(f"{source} has a header but no rows")
    widths = {len(line) for line in rows}
    width, missing = len(rows[0]), len(names) - len(rows[0])
    if len(widths) == 1 < len(rows):
        if 0 < missing <= max_missing_cells:
            notes.append(f"rows lack the last columns, which count as empty: {', '.join(names[width:])}")
            rows = [line + [""] * missing for line in rows]
        elif missing < 0 and not any(cell.strip() for line in rows for cell in line[len(names) :]):
            rows = [line[: len(names)] for line in rows]
    for row, line in enumerate(rows, start=1):
        if len(line) != len(names):
            raise InputError(f"{source} row {row} has {len(line)} values, but the header has {len(names)}")
    filled = [column for column, cell in enumerate(rows[0]) if cell.strip()]
    is_text = all(math.isnan(number(rows[0][c])) and not NO_VALUE.fullmatch(rows[0][c]) for c in filled)
    if len(rows) > 1 and is_text and sum(not math.isnan(number(rows[1][c])) for c in filled) > 1:  # e.g. of units
        notes.append(f"row 1 is a second header and left out: {', '.join(filter(None, rows[0]))}")
        rows = rows[1:]
    nameless = [column for column, name in enumerate(names) if not name]
    empty = [c for c in nameless if not any(line[c].strip() for line in rows)]
    if 0 in nameless and all(line[0].strip() == str(row) for row, line in enumerate(rows)):
        empty.append(0)  # the index of a data frame
    if set(nameless) - set(empty):
        raise InputError(
            f"{source} has no name for column {min(set(nameless) - set(empty)) + 1}; give it one in the header"
        )
    if empty:
        rows = [[cell for column, cell in enumerate(line) if column not in empty] for line in rows]
        names = list(filter(None, names))
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{source} names column {twice!r} twice; each needs a name of its own")
    return names, rows, notes


def _names_in(line: list[str]) -> list[str]:
    return [name.strip().removeprefix("#").strip() for name in line]


def read_xyz(file: Path) -> NDArray[np.float64]:
    """Return the positions in a file with the header x,y,z, (n, 3) [m], nan where a cell is empty.

    Raises:
        InputError: As `read_table`, another header, or text in place of a number.
    """
    table = read_table(file)
    if list(table.columns) != ["x", "y", "z"]:
        raise InputError(f"{file} must start with the header x,y,z, got {','.join(map(str, table.columns))}")
    return np.stack([column_of_numbers(file, table, axis) for axis in "xyz"], axis=1)


def check_carrier(file: Path, frequency_hz: float) -> None:
    """Refuse a value that is no carrier in Hz.

    Raises:
        InputError: Below 1 MHz, above 10 THz, or not finite.
    """
    low, high = CARRIERS_HZ
    if not low <= frequency_hz <= high:
        raise InputError(f"{file}: frequency_hz is {frequency_hz}; expected the carrier in Hz, {low:g} to {high:g}")
