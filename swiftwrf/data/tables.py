"""Tables of others in CSV or Parquet, and their columns as numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.archives import MOST_BYTES, refusing_broken
from swiftwrf.data.files import read_cells
from swiftwrf.errors import InputError

SUFFIXES = (".csv", ".parquet")
SEPARATORS = ",;\t"
MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}


def read_frame(file: Path) -> pd.DataFrame:
    """The table, cells of CSV as text.

    Raises:
        InputError: no such file, or one that is broken, has no rows, or a column without a name of its own.
    """
    if file.suffix.lower() == ".parquet":
        return _parquet(file)
    header, rows = read_cells(file, SEPARATORS)
    return pd.DataFrame(rows, columns=header, dtype=object)


def _parquet(file: Path) -> pd.DataFrame:
    try:
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{file} is Parquet, which pyarrow reads; install it with pip install 'swiftwrf-tasks[formats]'"
        ) from None
    with refusing_broken(file, "a Parquet file"):
        content = parquet.ParquetFile(file)
        groups = range(content.metadata.num_row_groups)
        if (total := sum(content.metadata.row_group(i).total_byte_size for i in groups)) > MOST_BYTES:
            raise InputError(f"it unpacks to {total} bytes; at most {MOST_BYTES} are read, so split the data")
        table = content.read().to_pandas()
    table.columns = [str(name).strip() for name in table.columns]
    if not len(table) or not table.columns.is_unique:
        raise InputError(f"{file} must have rows, and a name of its own for each column")
    return table


def column_of_numbers(file: Path, table: pd.DataFrame, name: str) -> NDArray[np.float64]:
    """A column as numbers, nan where a cell is empty.

    Raises:
        InputError: a cell of text.
    """
    values, text = parsed(table[name])
    if text.any():
        row = int(text.argmax())
        raise InputError(f"{file} row {row + 1}, column {name}: {table[name].iloc[row]!r} is not a number")
    return values


def parsed(column: pd.Series) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Numbers, nan elsewhere, and where a cell holds text that is none."""
    if column.dtype.kind in "biuf":
        return column.to_numpy(np.float64), np.zeros(len(column), dtype=bool)
    cells = column.astype(str).str.strip()
    values = pd.to_numeric(cells, errors="coerce").to_numpy(np.float64)
    empty = column.isna().to_numpy() | cells.str.lower().isin(MISSING).to_numpy()
    return np.where(empty, np.nan, values), np.isnan(values) & ~empty
