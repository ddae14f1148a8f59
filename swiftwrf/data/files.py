"""Text files of measurements: read without running code, refused in one sentence that names file and row."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from swiftwrf.choices import CARRIERS_HZ
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions

MAX_TEXT_BYTES = 2**28  # a million rows of positions take a tenth of it
MAX_PREAMBLE_LINES = 20  # before the header of a table
DECIMAL_COMMA = re.compile(r"^(\s*[+-]?\d+),(\d+\s*)$")
PLAIN_TAGS = {
    f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "timestamp", "seq", "map")
}


def sha256(file: Path) -> str:
    """Return the hex digest of a file, which may be larger than the memory.

    Raises:
        InputError: The file is missing or may not be read.
    """
    with refusing_unreadable(file), file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_of_all(digests: Iterable[tuple[str, str]]) -> str:
    """Return one digest for many files, from pairs of their names and digests."""
    return hashlib.sha256("".join(f"{digest}  {name}\n" for name, digest in digests).encode()).hexdigest()


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
    """Return a text in UTF-8, with or without a byte-order mark.

    Raises:
        InputError: The file is missing, larger than 256 MiB, or in another encoding.
    """
    with refusing_unreadable(file):
        size = file.stat().st_size
    if size > MAX_TEXT_BYTES:
        raise InputError(f"{file} has {size} bytes; a table or list has at most {MAX_TEXT_BYTES}")
    try:
        text = read_bytes(file).decode("utf-8-sig")
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
    """Return a YAML mapping. Scalars stay text, so that a name such as `NA` or `2001-01-01` stays a name.

    Raises:
        InputError: No such file, not YAML, not a mapping, a name twice, or a tag (YAML's way to create objects).
    """
    text = read_text(file)
    try:
        content = _plain(yaml.compose(text, Loader=yaml.SafeLoader), {})
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{file} is not valid YAML: {error or 'nested too deeply'}") from None
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold names and values, got {type(content).__name__}")
    return content


def _plain(node: yaml.Node | None, done: dict[int, Any]) -> Any:
    """Return the text, list or mapping of a node.

    Nodes referred to twice are built once, because nested references would grow without bound.
    """
    if node is None or id(node) in done:
        return done.get(id(node))
    if node.tag not in PLAIN_TAGS:
        raise ValueError(f"the tag {node.tag} is not allowed")
    value: Any
    if isinstance(node, yaml.MappingNode):
        value = {}
        for key, item in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ValueError("a name must be text")
            if key.value in value:  # YAML would silently keep the last
                raise ValueError(f"it names {key.value!r} twice; each needs a name of its own")
            value[key.value] = _plain(item, done)
    else:
        value = [_plain(item, done) for item in node.value] if isinstance(node, yaml.SequenceNode) else node.value
    done[id(node)] = value
    return value


def numbers(value: Any, count: int) -> tuple[float, ...] | None:
    """Return `count` finite numbers from a list of `read_yaml`, None if it is something else."""
    found = tuple(number(item) for item in value) if isinstance(value, list) and len(value) == count else (math.nan,)
    return found if all(map(math.isfinite, found)) else None


def lines_before_header(file: Path, separators: str = ",") -> int:
    """Return the number of lines before the header of a table, e.g. 1 for a first line of metadata.

    The header is the first line of names that has as many cells as the line below.

    Raises:
        InputError: The file cannot be read.
    """
    lines = read_text(file).split("\n", MAX_PREAMBLE_LINES + 2)[: MAX_PREAMBLE_LINES + 2]
    for skipped, (line, below) in enumerate(itertools.pairwise(lines)):
        separator = max(separators, key=line.count)
        try:
            header, row = (next(csv.reader([text], delimiter=separator), []) for text in (line, below))
        except csv.Error:  # read_cells refuses it
            return 0
        is_header = all(cell.strip() and math.isnan(number(cell)) for cell in header)
        if len(header) == len(row) > 1 and (is_header or not skipped):
            return skipped
    return 0


def read_cells(file: Path, separators: str = ",", skipped: int = 0) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a table, as text.

    Args:
        file: One row a line, with separators between values.
        separators: Possible separators; the most frequent one in the header counts. Numbers may have a decimal comma if it
            is not the comma.
        skipped: Number of lines before the header.

    Raises:
        InputError: No such file, a column without name or a name twice, rows of unequal length, no rows.
    """
    return cells_of(file, read_text(file).split("\n", skipped)[-1], separators)


def cells_of(label: object, text: str, separators: str = ",") -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the text of a table, as `read_cells`; the label stands for it in messages."""
    first = text.split("\n", 1)[0]
    separator = max(separators, key=first.count)
    try:
        stream = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        lines = [line for line in stream if line]
    except csv.Error as error:
        raise InputError(f"{label} is not a comma-separated table ({error})") from None
    if not lines:
        raise InputError(f"{label} is empty; expected a header and one row a measurement")
    header = [name.strip() for name in lines[0]]
    if "" in header:
        raise InputError(f"{label} has no name for column {header.index('') + 1}; give it one in the header")
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise InputError(f"{label} names column {twice!r} twice; each needs a name of its own")
    if len(lines) == 1:
        raise InputError(f"{label} has a header but no rows")
    for row, line in enumerate(lines[1:], start=1):
        if len(line) != len(header):
            raise InputError(f"{label} row {row} has {len(line)} values, but the header has {len(header)}")
    if separator == ",":
        return header, lines[1:]
    return header, [[DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in line] for line in lines[1:]]


def read_table(file: Path, columns: list[str] | None = None) -> tuple[list[str], Tensor]:
    """Return header and numbers of a comma-separated file, float64 (rows, columns). Numbers may be nan.

    Raises:
        InputError: As `read_cells`, another header than `columns`, or text in place of a number.
    """
    header, rows = read_cells(file)
    if columns is not None and header != columns:
        raise InputError(f"{file} must start with the header {','.join(columns)}, got {','.join(header)}")
    values = np.empty((len(rows), len(header)))
    for row, line in enumerate(rows, start=1):
        try:
            values[row - 1] = [float(text.replace("_", "x")) for text in line]  # float accepts 1_0
        except ValueError:
            raise InputError(f"{file} row {row} holds text where a number is expected: {','.join(line)}") from None
    return header, torch.from_numpy(values)


def read_positions(file: Path) -> Tensor:
    """Return the positions in a file with the header x,y,z, float64 (n, 3) [m].

    Raises:
        InputError: As `read_table`, or a coordinate that is not finite or beyond 1e9 m.
    """
    _, position = read_table(file, ["x", "y", "z"])
    return check_positions(position, f"positions of {file}")


def check_carrier(file: Path, frequency_hz: float) -> None:
    """Refuse a value that is no carrier in Hz.

    Raises:
        InputError: Below 1 MHz, above 10 THz, or not finite.
    """
    low, high = CARRIERS_HZ
    if not low <= frequency_hz <= high:
        raise InputError(f"{file}: frequency_hz is {frequency_hz}; expected the carrier in Hz, {low:g} to {high:g}")
