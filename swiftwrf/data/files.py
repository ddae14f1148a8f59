"""Files as they come from the field: read without running code, refused with a sentence that names file and row."""

from __future__ import annotations

import csv
import hashlib
import io
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

from swiftwrf.errors import InputError

MOST_BYTES = 2**28  # of a text file: a million rows of positions take a tenth of it
FARTHEST = 1e9  # [m] from the origin: beyond, float64 no longer keeps a wavelength apart
CARRIERS_HZ = (1e6, 1e13)
DECIMAL_COMMA = re.compile(r"^(\s*[+-]?\d+),(\d+\s*)$")
PLAIN_TAGS = {
    f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "timestamp", "seq", "map")
}


def sha256(file: Path) -> str:
    """Hex digest of a file's bytes, which may be more than fit into memory."""
    with _refusing_unreadable(file), file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_of_all(digests: Iterable[tuple[str, str]]) -> str:
    """One digest for many files, of their names and digests."""
    return hashlib.sha256("".join(f"{digest}  {name}\n" for name, digest in digests).encode()).hexdigest()


@contextmanager
def _refusing_unreadable(file: Path) -> Iterator[None]:
    """Says in a sentence that a file is not there or may not be read."""
    if not file.is_file():
        raise InputError(f"{file} is missing")
    try:
        yield
    except OSError as error:
        reason = "no permission to read it" if isinstance(error, PermissionError) else error.strerror
        raise InputError(f"{file} cannot be read ({reason})") from None


def read_bytes(file: Path) -> bytes:
    """The content of a file.

    Raises:
        InputError: it is not there or may not be read.
    """
    with _refusing_unreadable(file):
        return file.read_bytes()


def read_text(file: Path) -> str:
    """A text in UTF-8, with or without a byte-order mark.

    Raises:
        InputError: no such file, one too large, or another encoding.
    """
    if file.is_file() and file.stat().st_size > MOST_BYTES:
        raise InputError(f"{file} has {file.stat().st_size} bytes; a table or list has at most {MOST_BYTES}")
    try:
        text = read_bytes(file).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no text in UTF-8 (byte {error.start + 1}); save it in that encoding") from None
    if "\0" in text:
        raise InputError(f"{file} is no text in UTF-8: it holds zero bytes; save it in that encoding")
    return text


def number(text: object) -> float:
    """The number that a text says, nan where it says none: Python also takes 1_0 for 10."""
    try:
        return float(text) if isinstance(text, str) and "_" not in text else math.nan
    except ValueError:
        return math.nan


def read_yaml(file: Path) -> dict[str, Any]:
    """A YAML mapping; all that is no list or mapping is text, so that names are names whatever they look like and nothing
    is read as a date.

    Raises:
        InputError: no such file, not YAML, not a mapping, a name twice, or a tag (YAML's way to make objects).
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
    """The text, list or mapping that a node describes; what is referred to twice is built once, or lists of references to
    lists of references would grow without bound."""
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
    """So many finite numbers from a list of `read_yaml`; None where it is something else."""
    found = tuple(number(item) for item in value) if isinstance(value, list) and len(value) == count else (math.nan,)
    return found if all(map(math.isfinite, found)) else None


def read_cells(file: Path, separators: str = ",") -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table, as text.

    Args:
        file: with one row a line and values between separators.
        separators: of these, the one that the header has most of; numbers may have a decimal comma if it is another.

    Raises:
        InputError: no such file, a column without name or a name twice, rows of unequal length, no rows.
    """
    text = read_text(file)
    first = text.split("\n", 1)[0]
    separator = max(separators, key=first.count)
    try:
        stream = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        lines = [line for line in stream if line]
    except csv.Error as error:
        raise InputError(f"{file} is not a comma-separated table ({error})") from None
    if not lines:
        raise InputError(f"{file} is empty; expected a header and one row a measurement")
    header = [name.strip() for name in lines[0]]
    if "" in header:
        raise InputError(f"{file} has no name for column {header.index('') + 1}; give it one in the header")
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise InputError(f"{file} names column {twice!r} twice; each needs a name of its own")
    if len(lines) == 1:
        raise InputError(f"{file} has a header but no rows")
    for row, line in enumerate(lines[1:], start=1):
        if len(line) != len(header):
            raise InputError(f"{file} row {row} has {len(line)} values, but the header has {len(header)}")
    if separator == ",":
        return header, lines[1:]
    return header, [[DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in line] for line in lines[1:]]


def read_table(file: Path, columns: list[str] | None = None) -> tuple[list[str], Tensor]:
    """Header and numbers of a comma-separated file, float64 (rows, columns); numbers may be nan.

    Raises:
        InputError: as `read_cells`, another header than `columns`, text in a number's place.
    """
    header, rows = read_cells(file)
    if columns is not None and header != columns:
        raise InputError(f"{file} must start with the header {','.join(columns)}, got {','.join(header)}")
    values = np.empty((len(rows), len(header)))
    for row, line in enumerate(rows, start=1):
        try:
            values[row - 1] = [float(text) for text in line]
        except ValueError:
            raise InputError(f"{file} row {row} holds text where a number is expected: {','.join(line)}") from None
        if any("_" in text for text in line):  # Python takes 1_0 for 10
            raise InputError(f"{file} row {row} holds text where a number is expected: {','.join(line)}")
    return header, torch.from_numpy(values)


def read_positions(file: Path) -> Tensor:
    """Positions, float64 (n, 3) [m], of a file with the header x,y,z.

    Raises:
        InputError: as `read_table`, or a position that is not finite or too far away.
    """
    _, position = read_table(file, ["x", "y", "z"])
    bad = (~(position.abs() <= FARTHEST)).any(dim=1).nonzero()  # nan compares false, so it is bad too
    if len(bad):
        row = int(bad[0])
        raise InputError(
            f"{file} row {row + 1} is {position[row].tolist()}; positions must be finite numbers [m], at most {FARTHEST:g}"
        )
    return position


def check_carrier(file: Path, frequency_hz: float) -> None:
    """Refuses what is no carrier in Hz.

    Raises:
        InputError: below 1 MHz, above 10 THz, or not finite.
    """
    low, high = CARRIERS_HZ
    if not low <= frequency_hz <= high:
        raise InputError(f"{file}: frequency_hz is {frequency_hz}; expected the carrier in Hz, {low:g} to {high:g}")
