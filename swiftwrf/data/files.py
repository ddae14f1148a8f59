"""Files as they come from the field: read without running code, refused with a sentence that names file and row."""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from swiftwrf.errors import InputError


def sha256(file: Path) -> str:
    """Hex digest of a file's bytes."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def read_yaml(file: Path) -> dict[str, object]:
    """A YAML mapping, read without running code.

    Raises:
        InputError: no such file, not YAML, not a mapping, or a name twice.
    """
    if not file.is_file():
        raise InputError(f"{file} is missing")
    try:
        text = file.read_text()
        content, tree = yaml.safe_load(text), yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict) or not isinstance(tree, yaml.MappingNode):
        raise InputError(f"{file} must hold names and values, got {type(content).__name__}")
    names = [str(key.value) for key, _ in tree.value]
    if len(set(names)) < len(names):  # YAML would silently keep the last
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{file} names {twice!r} twice; each needs a name of its own")
    return content


def read_table(file: Path, columns: list[str] | None = None) -> tuple[list[str], Tensor]:
    """Header and numbers of a comma-separated file, float64 (rows, columns); numbers may be nan.

    Raises:
        InputError: no such file, another header than `columns`, a name twice, rows of unequal length, text in a
            number's place, no rows.
    """
    if not file.is_file():
        raise InputError(f"{file} is missing")
    with file.open(newline="") as stream:
        lines = [line for line in csv.reader(stream) if line]
    if not lines:
        raise InputError(f"{file} is empty; expected a header and one row a measurement")
    header = [name.strip() for name in lines[0]]
    if columns is not None and header != columns:
        raise InputError(f"{file} must start with the header {','.join(columns)}, got {','.join(header)}")
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise InputError(f"{file} names column {twice!r} twice; each needs a name of its own")
    if len(lines) == 1:
        raise InputError(f"{file} has a header but no rows")
    values = np.empty((len(lines) - 1, len(header)))
    for row, line in enumerate(lines[1:], start=1):
        if len(line) != len(header):
            raise InputError(f"{file} row {row} has {len(line)} values, but the header has {len(header)}")
        try:
            values[row - 1] = [float(text) for text in line]
        except ValueError:
            raise InputError(f"{file} row {row} holds text where a number is expected: {','.join(line)}") from None
    return header, torch.from_numpy(values)


def read_positions(file: Path) -> Tensor:
    """Positions, float64 (n, 3) [m], of a file with the header x,y,z.

    Raises:
        InputError: as `read_table`, or a position that is not finite.
    """
    _, position = read_table(file, ["x", "y", "z"])
    bad = (~position.isfinite()).any(dim=1).nonzero()
    if len(bad):
        row = int(bad[0])
        raise InputError(f"{file} row {row + 1} is {position[row].tolist()}; positions must be finite numbers [m]")
    return position
