"""Receivers by name, and tables with their positions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.columns import GEODETIC, column_of, column_of_numbers
from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.survey import read_frame
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import check_positions

MAX_FROM_ORIGIN_DEG = 2.0  # of receivers in degrees


def read_receivers(file: Path, names: Sequence[str], origin: GeodeticOrigin | None = None) -> tuple[Tensor, list[str]]:
    """Return the positions of receivers, float64 (R, 3) [m], nan where the table lacks one, and a note on these.

    Args:
        file: Table of positions with names of receivers, or without names in the order of the receivers.
        names: R names.
        origin: Origin of the measurements, if their positions were in degrees; then these are, too.

    Raises:
        InputError: A name twice, no position of any receiver, or a position that is not usable.
    """
    table = read_frame(file)
    label = column_of(table, "receiver", {}) or ("name" if "name" in table.columns else None)
    if label is None and len(table) != len(names):
        raise InputError(f"{file} has {len(table)} rows and no column of names, but there are {len(names)} receivers")
    listed_names = list(names) if label is None else table[label].astype(str).str.strip().tolist()
    if len(set(listed_names)) < len(listed_names):
        raise InputError(f"{file} must have each receiver once, got {listed(listed_names)}")
    position = _positions(file, table, origin, "receiver,x,y,z")
    given = np.flatnonzero(~np.isnan(position[:, :2]).all(axis=1))
    position, listed_names = position[given], [listed_names[row] for row in given]
    place = dict(zip(listed_names, check_positions(position, f"positions of {file}").tolist(), strict=True))
    unknown = [name for name in names if name not in place]
    if len(unknown) == len(names):
        raise InputError(f"{file} has none of the receivers ({listed(names)}); there are {listed(listed_names)}")
    found = torch.tensor([place.get(name, [float("nan")] * 3) for name in names], dtype=torch.float64)
    return found, unknown_positions(unknown)


def read_places(file: Path, origin: GeodeticOrigin | None = None) -> Tensor:
    """Return the positions in a table with columns x, y, z or longitude, latitude, altitude, float64 (n, 3) [m].

    Args:
        file: CSV or Parquet file. Without a column of heights, z is 0.
        origin: Origin of the metres, if positions are in degrees.

    Raises:
        InputError: A column that is missing, or a position that is not usable.
    """
    return check_positions(_positions(file, read_frame(file), origin, "x,y,z"), f"positions of {file}")


def _positions(file: Path, table: pd.DataFrame, origin: GeodeticOrigin | None, header: str) -> NDArray[np.float64]:
    """Return the positions (n, 3) [m] in a table, nan where a cell is empty."""
    columns = [column_of(table, axis, {}) or column_of(table, GEODETIC[axis], {}) for axis in "xy"]
    if None in columns:
        raise InputError(f"{file} must start with the header {header}, got {','.join(map(str, table.columns))}")
    height = column_of(table, "z", {})
    values = [column_of_numbers(file, table, str(name)) for name in columns]
    position = np.column_stack([*values, column_of_numbers(file, table, height) if height else np.zeros(len(table))])
    known = ~np.isnan(position[:, :2]).all(axis=1)
    position[known, :2] = _in_metres(file, position[known, :2], column_of(table, "longitude", {}) in columns, origin)
    return position


def unknown_positions(names: list[str]) -> list[str]:
    """Return a note on receivers of unknown position, or none."""
    return [f"the position of these receivers is unknown, so they have no path-loss model: {listed(names)}"] * bool(
        names
    )


def _in_metres(file: Path, xy: NDArray[np.float64], named: bool, origin: GeodeticOrigin | None) -> NDArray[np.float64]:
    """Return x and y (R, 2) [m] of receivers."""
    if origin is None:
        if named and (np.abs(xy) <= (180, 90)).all():
            raise InputError(
                f"{file} holds longitudes and latitudes, but the measurements are in metres; give one unit"
            )
        return xy
    if not (np.abs(xy - (origin.longitude, origin.latitude)) <= MAX_FROM_ORIGIN_DEG).all():
        raise InputError(
            f"{file}: receivers must be in degrees as the measurements are, within {MAX_FROM_ORIGIN_DEG:g} degrees of "
            f"{origin}"
        )
    return origin.to_metres(xy[:, ::-1])


def receiver_row(names: Sequence[str], asked: str, owner: str) -> int:
    """Return the index of a receiver.

    Args:
        names: Names of all receivers.
        asked: Name, or number counted from 1.
        owner: What has these receivers, for the message.

    Raises:
        InputError: An unknown receiver.

    Example:
        >>> receiver_row(["hall", "office"], "office", "floor"), receiver_row(["hall", "office"], "1", "floor")
        (1, 0)
    """
    if asked in names:
        return list(names).index(asked)
    if asked.isdecimal() and 1 <= int(asked) <= len(names):
        return int(asked) - 1
    known = ", ".join(f"{number} {name}" for number, name in enumerate(names, start=1))
    raise InputError(f"{owner} has no receiver {asked!r}; there are {known}")
