"""Tables and values on disk: written whole or not at all, read back as they were, refused where they are damaged.

A cell that begins with = + - @ is a formula to spreadsheet programs, which run it. Names come from the files of others, so
such a name is written behind an apostrophe, which those programs take for "this is text", and read back without.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from swiftwrf import InputError
from swiftwrf.runtime.durable import replacing, write_text

Row = dict[str, Any]
NAMES = (  # columns of text, whatever it looks like (NA, 1, 12:34)
    "method",
    "estimator",
    "training",
    "receiver",
    "synthesizer",
    "stage",
    "origin",
    "measured_fraction",  # a key: as a number it could lose a digit
    "mix",
)
FORMULA = re.compile(r"^'*[=+\-@\t\r]")


def strict(value: Any) -> Any:
    """The value as strict JSON carries it: nan and infinity become null."""
    if isinstance(value, dict):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if isinstance(value, torch.Tensor):
        return strict(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(file: Path, content: Any) -> None:
    """Strict JSON."""
    write_text(file, json.dumps(strict(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def read_json(file: Path) -> Row:
    """The JSON object in a file.

    Raises:
        InputError: no such file, or something else in it.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}); is this the directory of a run?") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is not the JSON that a run writes ({error}); restore it") from None
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold a JSON object, got a {type(content).__name__}; restore it")
    return content


def write_table(file: Path, rows: Iterable[Row]) -> None:
    """A comma-separated table with the keys of the rows as columns."""
    write_text(file, as_table(rows))


def as_table(rows: Iterable[Row]) -> str:
    """The text of such a table."""
    rows = list(rows)
    stream = io.StringIO(newline="")
    columns = list(dict.fromkeys(key for row in rows for key in row))
    writer = csv.writer(stream)
    writer.writerow(columns)
    writer.writerows([_escaped(row.get(name, "")) for name in columns] for row in rows)
    return stream.getvalue()


def write_npz(file: Path, arrays: Mapping[str, Any]) -> None:
    """Arrays by name."""
    with replacing(file) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def _escaped(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and FORMULA.match(value) else value


def read_table(file: Path) -> pd.DataFrame:
    """What `write_table` wrote; columns of names are text.

    Raises:
        InputError: no such file, or no table in it.
    """
    try:
        columns = list(pd.read_csv(file, nrows=0))
        names = [name for name in NAMES if name in columns]
        missing = {name: [""] if name in names else ["", "nan"] for name in columns}
        table = pd.read_csv(file, dtype=dict.fromkeys(names, str), keep_default_na=False, na_values=missing)
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}); is this the directory of a run?") from None
    except ValueError as error:  # pandas' own errors and those of decoding are such
        raise InputError(f"{file} is not the table that a run writes ({error}); restore it") from None
    for name in names:
        table[name] = table[name].map(_unescaped, na_action="ignore")
    return table


def _unescaped(text: str) -> str:
    return text[1:] if text.startswith("'") and FORMULA.match(text) else text
