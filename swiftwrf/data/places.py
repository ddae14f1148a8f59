"""Places in tables of RSSI: coordinates of rows, local metres, and the end of a link that counts as receivers."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd
import torch

from swiftwrf.data.cells import UNITS, Floats, column_of_numbers, parsed, plain_name, text_of, unit_of
from swiftwrf.data.columns import GEODETIC, is_rssi
from swiftwrf.data.coordinates import (
    MIN_STOREY_M,
    STOREY_M,
    Coordinates,
    GeodeticOrigin,
    PlanFrame,
    degrees_in,
    floor_numbers,
    frame_of,
)
from swiftwrf.data.zones import in_one_zone, zone_column
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import cells, check_positions

STOREY = re.compile(
    r"(?:(?P<level>(?:building_?)?level|flr|story|niveau|ebene|geschoss|piso)|(?:floor_?)?(?:map|plan))"
    r"(?:_?(?:id|name|no|number))?"
)


def floor_column(source: object, table: pd.DataFrame, taken: Collection[str], max_floors: int = 30) -> str | None:
    """Return a column with another name than floor whose values are floors, e.g. Level, None without one.

    Args:
        source: Name of the table, for messages.
        table: Columns of a survey.
        taken: Columns with another use.
        max_floors: Number of different values, at most (not studied).

    Raises:
        InputError: The question whether a column of numbered maps, or of names without a known order, contains the floors.

    Example:
        >>> floor_column("a.csv", pd.DataFrame({"x": [0, 1], "Level": ["Ground", "1st"]}), ["x"])
        'Level'
    """
    for name in table.columns:
        cells = text_of(table[name])
        if name in taken or not 2 <= cells.nunique() <= max_floors:
            continue
        kind = STOREY.fullmatch(plain_name(name))
        if not kind or is_rssi(table[name]):
            continue
        order = floor_numbers(cells[cells != ""].unique().tolist())
        if (kind["level"] or parsed(table[name])[1].any()) and not np.isnan(order).any():
            return str(name)
        raise InputError(
            f"{source}: is {name!r} ({listed(cells.unique())}) the floor of each row? Then give --columns "
            f"floor={name}, with floors in a known order or a column of heights; if not, read each part "
            "alone, or rename the column"
        )
    return None


def read_coordinates(
    source: object, table: pd.DataFrame, roles: Mapping[str, str], frame: PlanFrame
) -> tuple[Floats, PlanFrame, list[str]]:
    """Return the coordinates of the rows (n, 3) [m] or [deg], nan where empty, the frame they were in, and notes.

    Raises:
        InputError: Degrees with a frame, a floor of unknown order without heights, or text in place of a number.
    """
    both = [roles.get(role) or roles[GEODETIC[role]] for role in "xy"]
    x, y = (column_of_numbers(source, table, name) for name in both)
    if "x" not in roles and frame != PlanFrame():
        raise InputError(f"{source} has longitudes and latitudes, which --scale, --y-down and --up do not apply to")
    frame, notes = frame_of(source, table, both, frame) if "x" in roles else (frame, [])
    if "x" in roles and (zone := zone_column(table, both[0])) is not None:
        joined, of_zones = in_one_zone(source, table[zone], np.stack([x, y], axis=1))
        (x, y), notes = joined.T, notes + of_zones
    if "floor" in roles:
        floor, text = parsed(table[roles["floor"]])
        floor_names = text_of(table[roles["floor"]])
        floor = np.where(text, floor_numbers(floor_names.tolist()), floor)
        unknown = sorted(set(floor_names[text & np.isnan(floor)]))
    if "z" in roles:
        z = column_of_numbers(source, table, roles["z"]) / UNITS.get(unit_of(table[roles["z"]]), 1.0)
    elif "floor" in roles:
        if unknown:
            raise InputError(
                f"{source} has no height, and the order of floor {unknown[0]!r} is unknown; number the floors or add "
                "column z"
            )
        z = STOREY_M * floor
        notes.append(f"there is no height, so each floor of column {roles['floor']} counts as {STOREY_M:g} m")
    else:
        z = np.zeros(len(table))
        notes.append("there is no height, so z is 0 m everywhere")
    position = frame.to_world(np.stack([x, y, z], axis=1))
    if "z" in roles and "floor" in roles and not unknown:
        heights = pd.Series(position[:, 2]).groupby(floor).median().dropna()  # in the order of floors
        if len(heights) > 1 and heights.diff().abs().max() < MIN_STOREY_M:
            position[:, 2] += STOREY_M * floor
            notes.append(f"heights count from the floor, so each floor of column {roles['floor']} adds {STOREY_M:g} m")
    return position, frame, notes


def local_metres(
    source: object,
    coordinate: Floats,
    roles: Mapping[str, str],
    asked: Coordinates | None = None,
    min_extent_m: float = 3.0,
) -> tuple[Floats, GeodeticOrigin | None, list[str]]:
    """Return positions (n, 3 or 6) [m] of coordinates that may be degrees, the origin of the metres, and notes.

    A walk that is wider and higher than `min_extent_m`, and five times as high as deep, may have another axis upwards
    (not studied).

    Raises:
        InputError: Positions that are not finite, or degrees that are none.
    """
    position, origin = coordinate.reshape(-1, 3), None
    both = roles.get("x") or roles["longitude"], roles.get("y") or roles["latitude"]
    named = "longitude" in roles and "latitude" in roles
    degrees, notes = degrees_in(source, both, position[:, :2], named, asked)
    if degrees is not None:
        origin = GeodeticOrigin.amid(degrees)
        x, y = both
        if not named and np.abs(position[:, 1]).max() > 90:  # only a longitude does
            x, y = y, x
        notes.append(f"longitude {x} and latitude {y} are projected to local metres about {origin}")
        position = np.column_stack([origin.to_metres(degrees), position[:, 2]])
    elif "y" in roles and "z" in roles:
        width, depth, height = np.ptp(position, axis=0)
        if depth < height / 5 and min(width, height) > min_extent_m:
            notes.append(
                f"y spans {depth:.1f} m and z {height:.1f} m; if y is the height, give --up y, and else this stands as "
                "it is"
            )
    check_positions(position, f"positions of {source}")
    return position.reshape(len(coordinate), -1), origin, notes


def receivers_of_ends(
    source: object, coordinate: Floats, rssi: Floats, max_receivers: int = 500
) -> tuple[Floats, Floats, Floats, list[str]]:
    """Take the end with fewer positions as receivers.

    If there are more than `max_receivers`, positions are averaged in cubes; each has a column of RSSI in memory.

    Returns:
        Positions of the other end (n, 3) and of the R receivers (R, 3) [m], RSSI (n, R) [dBm], and notes.

    Raises:
        InputError: RSSI of several receivers.
    """
    if rssi.shape[1] != 1:
        raise InputError(
            f"{source} has positions of both ends and RSSI of {rssi.shape[1]} receivers; name one: columns "
            "rssi=NAME, or pool them: pool_by"
        )
    ends = coordinate[:, 3:], coordinate[:, :3]
    other, coordinate = sorted(ends, key=lambda end: len(np.unique(end, axis=0)))
    number, edge = cells(torch.from_numpy(other), max_receivers)
    position: Floats = pd.DataFrame(other).groupby(number.numpy()).mean().to_numpy()
    n = len(position)
    notes = [f"both ends move; {n} positions of one of them count as receivers place1 to place{n}"]
    if edge:
        notes.append(f"its positions are averaged in cubes of {edge:.3g} m")
    power, rssi = rssi[:, 0], np.full((len(other), n), np.nan)
    rssi[np.arange(len(other)), number.numpy()] = power
    return coordinate, position, rssi, notes
