"""Files of a run: written whole or not at all, refused if damaged. NumPy and pandas are imported at first use.

Spreadsheet programs run a cell that begins with = + - @ as a formula. Receiver names come from files of others, so a text
of that kind is written behind an apostrophe, which those programs take for a mark of text, and read without it.
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import strict, write_npz, write_text

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from swiftwrf.contrib.comparison.base import Recorded

Row = dict[str, Any]
CONFIG, ENVIRONMENT, METRICS = "config.json", "environment.json", "metrics.json"  # files of a run
RECEIVERS = "receivers"  # name of the files of a run with estimated positions of receivers
SUGGESTED = "suggested"  # name of the files of a run with positions to measure next
PARTIAL = ".partial"  # suffix of a run that is not finished
NAMES = (  # columns of text, even if a cell reads NA, 1 or 12:34
    "method",
    "estimator",
    "training",
    "receiver",
    "floor",
    "band",
    "room",
    "truth_room",
    "synthesizer",
    "stage",
    "origin",
    "measured_fraction",  # a key, whose last digit counts
    "mix",
)
IN_DBM = ("measured", "predicted", "threshold")  # columns of runs of RSSI in dBm, and in dB
IN_DB = ("abs_error", "missing", "width", "median_abs_error", "mean_abs_error")
DECIMALS = {"m": 3, "db": 2, "dbm": 2, "deg": 4}  # of numbers, by the unit at the end of a column's name
DEGREE_DECIMALS = 8  # of latitude and longitude: 1 mm
SIGNIFICANT_DIGITS = 4  # of magnitudes
FORMULA = re.compile(r"^'*[=+\-@\t\r]")


def read_json(file: Path) -> Row:
    """Read the JSON object in a file.

    Raises:
        InputError: There is no such file, or its content is no JSON object.
    """
    from swiftwrf.data.files import read_text
    from swiftwrf.runtime.checkpoint import refusing

    text = read_text(file)
    with refusing(f"{file} is not the JSON that a run writes"):
        content = json.loads(text)
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold a JSON object, got a {type(content).__name__}; restore it")
    return content


def write_table(file: Path, rows: Iterable[Row] | pd.DataFrame) -> None:
    """Write a comma-separated table with the keys of the rows as columns."""
    write_text(file, as_table(rows))


def as_table(rows: Iterable[Row] | pd.DataFrame) -> str:
    r"""Return the text of a comma-separated table with the keys of the rows as columns; numbers of a frame stay as they are.

    Example:
        >>> as_table([{"receiver": "=1+1", "@home": -60.5}])
        "receiver,'@home\r\n'=1+1,-60.5\r\n"
    """
    import pandas as pd

    if isinstance(rows, pd.DataFrame):
        is_number = pd.api.types.is_numeric_dtype
        texts = {name: _escaped_column(rows[name]) for name in rows if not is_number(rows[name])}
        text: str = rows.assign(**texts).rename(columns=_escaped).to_csv(index=False, lineterminator="\r\n")
        return text
    rows = list(rows)
    columns = dict.fromkeys(key for row in rows for key in row)
    cells = {_escaped(name): pd.Series([_escaped(row.get(name)) for row in rows], dtype=object) for name in columns}
    table: str = pd.DataFrame(cells).to_csv(index=False, lineterminator="\r\n")
    return table


def _escaped(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and FORMULA.match(value) else value


def _escaped_column(cells: pd.Series[Any]) -> NDArray[Any]:
    """Return the escaped cells of a column of names, most of which occur often."""
    import numpy as np

    number, different = cells.factorize(use_na_sentinel=False)
    escaped: NDArray[Any] = np.array([*map(_escaped, different), None], dtype=object)[number]
    return escaped


def rounded(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of a table for people, with numbers rounded by the units at the end of the columns' names.

    Metres have 3 decimals, dB and dBm 2, degrees 4, latitudes and longitudes 8. Magnitudes have 4 significant digits.

    Example:
        >>> rounded([{"rssi_dbm": -200 / 3, "x_m": 1 / 3, "magnitude": 2 / 3000, "latitude_deg": 1 / 3}])
        [{'rssi_dbm': -66.67, 'x_m': 0.333, 'magnitude': 0.0006667, 'latitude_deg': 0.33333333}]
    """
    return [{name: _rounded(name, value) for name, value in row.items()} for row in rows]


def _rounded(name: str, value: Any) -> Any:
    if not isinstance(value, float):
        return value
    if name in ("latitude_deg", "longitude_deg"):
        return round(value, DEGREE_DECIMALS)
    if name == "magnitude":
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}")
    decimals = DECIMALS.get(name.rpartition("_")[2])
    return value if decimals is None else round(value, decimals)


def read_table(file: Path) -> pd.DataFrame:
    """Read a table of `write_table`; columns of names are text.

    Raises:
        InputError: There is no such file, or its content is no table.
    """
    from swiftwrf.data.files import read_text
    from swiftwrf.runtime.checkpoint import refusing

    text = read_text(file)
    with refusing(f"{file} is not the table that a run writes"):
        return from_text(text, NAMES)


def from_text(text: str, names: Sequence[str]) -> pd.DataFrame:
    r"""Return the table in a text of `as_table`, whose columns of these names are text.

    Raises:
        ValueError: The text is no table.

    Example:
        >>> from_text("receiver,n\r\n'=1+1,2\r\n", ["receiver"]).to_dict("records")
        [{'receiver': '=1+1', 'n': 2}]
    """
    import pandas as pd

    if not text.strip():  # a table without rows has no columns either
        return pd.DataFrame()
    columns = list(pd.read_csv(io.StringIO(text), nrows=0))
    names = [name for name in names if name in columns]
    missing = {name: [""] if name in names else ["", "nan"] for name in columns}
    options = {"dtype": dict.fromkeys(names, str), "keep_default_na": False, "na_values": missing}
    table = pd.read_csv(io.StringIO(text), **options)
    for name in names:
        table[name] = table[name].map(
            lambda text: text[1:] if text.startswith("'") and FORMULA.match(text) else text, na_action="ignore"
        )
    return table


def read_npz(file: Path) -> dict[str, NDArray[Any]]:
    """Read arrays of `write_npz` by name, numbers or texts.

    Raises:
        InputError: There is no such file, or it is damaged.
    """
    from swiftwrf.data.archives import NUMBERS, array_names, read_arrays

    return read_arrays(file, sorted(array_names(file)), kinds=f"{NUMBERS}U")


def write_result(result: Recorded, folder: Path) -> Row:
    """Write the tables and arrays of a result into a folder, and return the content of metrics.json."""
    columns = file_columns(dict(result.metrics))
    for name, table in result.tables.items():
        write_table(folder / f"{name}.csv", table.rename(columns=columns))
    for name, arrays in result.arrays.items():
        write_npz(folder / f"{name}.npz", arrays)
    return dict(result.metrics)


def file_columns(metrics: Row) -> dict[str, str]:
    """Return the names that columns in dBm and dB have in the files of a run, by its quantity and direction.

    Example:
        >>> file_columns({"unit": "ms", "coverage": [{"direction": "below"}]})["scans_above"]
        'scans_below'
    """
    from swiftwrf.models.prediction import difference_unit, suffix

    unit = metrics.get("unit", "dBm")
    names = {f"{name}_dbm": f"{name}_{suffix(unit)}" for name in IN_DBM}
    names |= {f"{name}_db": f"{name}_{suffix(difference_unit(unit))}" for name in IN_DB}
    coverage = metrics.get("coverage")
    if isinstance(coverage, list) and coverage and coverage[0].get("direction") == "below":
        names |= {name: name.replace("above", "below") for name in ("above", "scans_above", "test_above")}
    return names


def notes(run: Records) -> list[str]:
    """Return what the reader of the data found, in sentences; nothing for a run that did not keep it."""
    return [f"{note[0].upper()}{note[1:]}." for note in run.metrics.get("notes", [])]


class Records:
    """The files of one run, or a result in memory.

    Args:
        folder: Directory of the run.
        metrics: Content of metrics.json. Defaults to the file in the directory.
        number: Number of the run in a report over several runs, from 1. 0 for a report over one run.

    Raises:
        InputError: The directory contains no finished run.
    """

    def __init__(self, folder: Path, metrics: Row | None = None, number: int = 0) -> None:
        self.folder, self.number = folder, number
        if metrics is None:
            file = folder / METRICS
            if not file.is_file():
                raise InputError(f"{folder} is no finished run: it has no {METRICS}")
            metrics = read_json(file)
        self.metrics = metrics
        self._tables: dict[str, pd.DataFrame] = {}
        self._arrays: dict[str, dict[str, NDArray[Any]]] = {}

    @classmethod
    def of(cls, result: Recorded, config: Row) -> Records:
        """Return the records that a run with this result and `CONFIG` would have, without its environment."""
        run = cls(result.folder or Path(os.devnull), strict(result.metrics))
        run.config = config
        run._tables, run._arrays = dict(result.tables), {name: dict(part) for name, part in result.arrays.items()}
        return run

    @property
    def place(self) -> str:
        """The data and their split in words."""
        data = self.metrics["data"]
        return f"{'the ' + data.replace('-', ' ') if data.startswith('simulated-') else data}, {self.metrics['split']} split"

    @property
    def scene(self) -> str:
        """The data and their split in words, and which run it is where there are several."""
        return self.place + (f", run {self.number}" if self.number else "")

    @property
    def file_name(self) -> str:
        """Prefix of the names of the run's figures, unique within a report."""
        names = [re.sub(r"[^\w.=-]+", "_", self.metrics[key], flags=re.ASCII)[:40] for key in ("data", "split")]
        return "-".join([*names, f"s{self.metrics['seed']}", *([f"run{self.number}"] if self.number else [])])

    @cached_property
    def config(self) -> Row:
        """Command and configuration."""
        return read_json(self.folder / CONFIG)

    @cached_property
    def environment(self) -> Row:
        """Environment of the run: machine, versions, commit."""
        return read_json(self.folder / ENVIRONMENT)

    def table(self, name: str) -> pd.DataFrame:
        """One of the run's tables, e.g. `errors`; not to be changed."""
        if name not in self._tables:
            columns = {written: column for column, written in file_columns(self.metrics).items()}
            self._tables[name] = read_table(self.folder / f"{name}.csv").rename(columns=columns)
        return self._tables[name]

    def in_files(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return a table with the names of columns that the files of the run have; see `file_columns`."""
        return table.rename(columns=file_columns(self.metrics))

    def arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays that the run saved in a file, e.g. `maps`, by their names; none without that file."""
        if name not in self._arrays:
            file = self.folder / f"{name}.npz"
            self._arrays[name] = read_npz(file) if file.is_file() else {}
        return self._arrays[name]

    @property
    def path(self) -> str:
        """Directory of the run as commands take it, also while the run is not finished."""
        return str(self.folder).removesuffix(PARTIAL)
