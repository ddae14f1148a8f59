"""Receivers of RSSI: the spelling of their names, radios of one access point, and tables of positions."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from swiftwrf.data.cells import Floats, column_of_numbers, text_of
from swiftwrf.data.columns import GEODETIC, column_of
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame, frame_of
from swiftwrf.data.files import numbers, read_table, read_yaml
from swiftwrf.data.radios import band_names, plain_receiver, several_bands
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import check_positions


def spelled_as(names: Sequence[str], known: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return names as the known ones are spelled, and a note on names that were spelled differently.

    Example:
        >>> spelled_as(["AA-BB-CC-DD-EE-01", "hall"], ["aa:bb:cc:dd:ee:01", "office"])[0]
        ['aa:bb:cc:dd:ee:01', 'hall']
    """
    plain = pd.Series(list(known), index=[plain_receiver(name) for name in known], dtype=object)
    plain = plain[~plain.index.duplicated(keep=False)]
    mine = pd.Series([plain_receiver(name) for name in names], dtype=object)
    once = ~mine.duplicated(keep=False)
    spelled = [
        plain[key] if name not in known and single and key in plain.index else name
        for name, key, single in zip(names, mine, once, strict=True)
    ]
    other = [f"{name} is {as_known}" for name, as_known in zip(names, spelled, strict=True) if name != as_known]
    return spelled, [f"receivers are matched whose names are spelled differently: {listed(other)}"] * bool(other)


def read_receivers(
    file: Path, names: Sequence[str], origin: GeodeticOrigin | None, frame: PlanFrame, stated: bool = True
) -> tuple[Tensor, list[str] | None, list[str]]:
    """Return the positions of receivers, float64 (R, 3) [m], nan where the table lacks one, their bands, and notes.

    A table with a column of bands, channels or frequencies may have no positions. One that is found beside the data and has
    none of the receivers is of others, and is not used.

    Args:
        file: Table of positions with names of receivers, or without names in the order of the receivers; or YAML with
            NAME: [x, y, z].
        names: R names.
        origin: Origin of the measurements, if their positions were in degrees; then these are, too.
        frame: Axes of the measurements, which the receivers share unless their columns state another unit.
        stated: The user states that the table is of these receivers.

    Raises:
        InputError: A name twice, no position of any receiver if it is stated, or a position that is not usable.
    """
    table = _positions_by_name(file, names) if file.suffix == ".yml" else read_table(file)
    name_column = column_of(table, "receiver", {}) or ("name" if "name" in table.columns else None)
    if name_column is None and len(table) != len(names):
        raise InputError(f"{file} has {len(table)} rows and no column of names, but there are {len(names)} receivers")
    listed_names = list(names) if name_column is None else table[name_column].astype(str).str.strip().tolist()
    if len(set(listed_names)) < len(listed_names):
        raise InputError(f"{file} must have each receiver once, got {listed(listed_names)}")
    listed_names, notes = spelled_as(listed_names, names)
    nowhere = torch.full((len(names), 3), torch.nan, dtype=torch.float64)
    if not stated and not {*names} & {*listed_names}:
        reason = f"it has none of the receivers ({listed(names)}), but {listed(listed_names)}"
        return nowhere, None, [f"{file.name} is not used: {reason}"]
    bands = _bands(table, listed_names, names)
    if bands and not any(column_of(table, role, {}) for role in ("x", "y", *GEODETIC.values())):
        return nowhere, bands, notes
    position = positions_of(file, table, origin, frame)
    given = np.flatnonzero(~np.isnan(position[:, :2]).all(axis=1))
    position, listed_names = position[given], [listed_names[row] for row in given]
    position_of = dict(zip(listed_names, check_positions(position, f"positions of {file}").tolist(), strict=True))
    unknown = [name for name in names if name not in position_of]
    if len(unknown) == len(names):
        raise InputError(f"{file} has none of the receivers ({listed(names)}); there are {listed(listed_names)}")
    positions = torch.tensor([position_of.get(name, [float("nan")] * 3) for name in names], dtype=torch.float64)
    if unknown:
        notes.append(f"the position of these receivers is unknown, so they have no path-loss model: {listed(unknown)}")
    return positions, bands, notes


def _bands(table: pd.DataFrame, listed_names: Sequence[str], names: Sequence[str]) -> list[str] | None:
    """Return the bands of receivers in the first column that has several of them; None without one."""
    for column in table.columns:
        if (found := band_names(column, text_of(table[column]))) is not None:
            band_of = dict(zip(listed_names, found, strict=True))
            bands = pd.Series([band_of.get(name, "") for name in names], dtype=object)
            if several_bands(bands):
                return [str(band) for band in bands]
    return None


def _positions_by_name(file: Path, names: Sequence[str]) -> pd.DataFrame:
    """Return the table of a file with NAME: [x, y, z], without receivers of unknown position and other content."""
    content = {name: value for name, value in read_yaml(file).items() if value not in ("", "~", "null", "none")}
    position_of = {name: numbers(value, 3) for name, value in content.items()}
    spelled, _ = spelled_as(list(content), names)
    if wrong := [
        name for name, known in zip(content, spelled, strict=True) if position_of[name] is None and known in names
    ]:
        got = reprlib.repr(content[wrong[0]])  # references may make it as long as any memory
        raise InputError(f"{file}: receiver {wrong[0]!r} needs a position of 3 finite numbers [m], got {got}")
    rows = [(name, *position) for name, position in position_of.items() if position is not None]
    return pd.DataFrame(rows, columns=["receiver", "x", "y", "z"])


def read_places(file: Path, origin: GeodeticOrigin | None, frame: PlanFrame, floors: Floors | None = None) -> Tensor:
    """Return the positions in a table with columns x, y, z or longitude, latitude, altitude, float64 (n, 3) [m].

    Without a column of heights, z is 0, or in a building with floors the height of the floor in column floor. Origin and
    axes are those of `read_receivers`.

    Raises:
        InputError: A column that is missing, an unknown floor, or a position that is not usable.
    """
    table = read_table(file)
    position = positions_of(file, table, origin, frame)
    if floors is not None and column_of(table, "z", {}) is None:
        column = column_of(table, "floor", {})
        named = [] if column is None else text_of(table[column]).tolist()
        height = {name: z for names, z in zip(floors.names, floors.height_m, strict=True) for name in names.split(", ")}
        if not named or not set(named) <= set(height):
            raise InputError(f"{file} needs a column z, or a column floor with names of floors: {listed(list(height))}")
        position[:, 2] = [height[name] for name in named]
    return check_positions(position, f"positions of {file}")


def positions_of(
    file: Path, table: pd.DataFrame, origin: GeodeticOrigin | None, frame: PlanFrame, max_from_origin_deg: float = 2.0
) -> Floats:
    """Return the positions (n, 3) [m] in a table, nan where a cell is empty; degrees lie near the origin."""
    columns = [column_of(table, axis, {}) or column_of(table, GEODETIC[axis], {}) for axis in "xy"]
    both = [name for name in columns if name is not None]
    if len(both) < 2:
        raise InputError(
            f"{file} has no columns of positions, x and y or longitude and latitude; there are {listed(table.columns)}"
        )
    height = column_of(table, "z", {})
    values = [column_of_numbers(file, table, name) for name in both]
    position = np.column_stack([*values, column_of_numbers(file, table, height) if height else np.zeros(len(table))])
    known = ~np.isnan(position[:, :2]).all(axis=1)
    xy = position[known, :2]
    if origin is None:
        if column_of(table, "longitude", {}) in both and (np.abs(xy) <= (360, 90)).all():
            raise InputError(
                f"{file} holds longitudes and latitudes, but the measurements are in metres; give one unit"
            )
        return frame_of(file, table, both, frame)[0].to_world(position)
    away = xy - (origin.longitude, origin.latitude)
    away[:, 0] = (away[:, 0] + 180) % 360 - 180
    if not (np.abs(away) <= max_from_origin_deg).all():
        raise InputError(
            f"{file}: positions must be in degrees as the measurements are, within {max_from_origin_deg:g} degrees of "
            f"{origin}"
        )
    position[known, :2] = origin.to_metres(xy[:, ::-1])
    return position
