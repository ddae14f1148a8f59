"""Positions in tables: rows without a fix, latitude and longitude as local metres, and floors of a building."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from swiftwrf.data.cells import PIXELS, UNITS, Floats, unit_of
from swiftwrf.errors import InputError

Coordinates = Literal["degrees", "metres"]
Up = Literal["y", "z"]
# x and y that receivers of satellites write without a position
NO_FIX = (0.0, -1.0, 999.0, -999.0, 9999.0, -9999.0)
STOREY_M = 4.0  # height of a floor where heights are missing or count from the floor
MIN_STOREY_M = 1.5  # between the heights of two floors
BELOW_GROUND = re.compile(r"(?:b|ug|u\.g\.?|basement|cellar|keller|sub|lower)[ ._-]*(?:level|floor)?[ ._-]*(\d*)")
VALUE, PX, METRE = r"(\d+(?:[.,]\d+)?)", "(?:px|pixels?)", "m(?:et(?:er|re)s?)?"
SCALES = [  # of a plan in lines above a table: pixels in a metre, and metres in a pixel, whose power is -1
    (re.compile(pattern, re.IGNORECASE), power)
    for pattern, power in (
        (rf"\b1 *{METRE} *[=:] *{VALUE} *{PX}\b", 1),
        (rf"{VALUE} *{PX} *(?:/|per|=) *(?:1 *)?{METRE}\b", 1),
        (rf"{PX}[ _]*(?:/|per)[ _]*{METRE}\W+{VALUE}", 1),
        (rf"\b1 *{PX} *[=:] *{VALUE} *{METRE}\b", -1),
        (rf"{VALUE} *{METRE} *(?:/|per|=) *(?:1 *)?{PX}\b", -1),
    )
]
FLOOR_NAMES = {  # numbers of floors without a digit in their name
    **dict.fromkeys(("ground", "g", "gf", "eg", "erdgeschoss", "parterre", "rdc", "lobby", "pb"), 0.0),
    **dict.fromkeys(("mezzanine", "zg"), 0.5),
    **dict.fromkeys(("og", "obergeschoss", "upper"), 1.0),
    **{name: n + 1.0 for n, name in enumerate(["first", "second", "third", "fourth", "fifth", "sixth", "seventh"])},
}


def stated_scale(text: str) -> float | None:
    """Return the number of pixels in a metre that lines above a table state, None if they do not.

    Example:
        >>> stated_scale("Scale: 1 m = 20.7 px"), stated_scale("0.05 m/px"), stated_scale("Project: office")
        (20.7, 20.0, None)
    """
    for pattern, power in SCALES:
        if (match := pattern.search(text)) and (value := float(match[1].replace(",", "."))) > 0:
            return float(value**power)
    return None


class PlanFrame(NamedTuple):
    """Axes of the coordinates in a table, e.g. of a floor plan or of a phone.

    Args:
        scale: Units of x and y in a metre, e.g. pixels of a floor plan. Defaults to what columns state.
        y_down: y points down in the plan, as in images.
        up: Axis that points up, "y" as in ARCore, ARKit and Unity.

    Example:
        >>> PlanFrame(scale=20.0, y_down=True).to_world(np.array([[10.0, 40.0, 3.0]]))
        array([[ 0.5, -2. ,  3. ]])
    """

    scale: float | None = None
    y_down: bool = False
    up: Up = "z"

    def to_world(self, xyz: Floats) -> Floats:
        """Return positions (n, 3) [m] with x and y in the horizontal plane, z up and right-handed axes."""
        x, y, z = (xyz / (self.scale or 1.0, self.scale or 1.0, 1.0)).T
        if self.y_down:
            y = -y
        return np.stack([x, -z, y] if self.up == "y" else [x, y, z], axis=1)


def frame_of(
    source: object, table: pd.DataFrame, names: Sequence[str], frame: PlanFrame
) -> tuple[PlanFrame, list[str]]:
    """Return the frame of coordinates in two columns, with the scale and direction that they state, and notes on these."""
    unit, stated = unit_of(table[names[0]]), stated_scale(table.attrs.get("preamble", ""))
    scale = frame.scale or stated
    if unit in PIXELS and scale is None:
        raise InputError(f"{source}: columns {' and '.join(names)} are in pixels; give --scale PIXELS_PER_METRE")
    in_pixels = unit in PIXELS or (frame.scale is None and stated is not None and not unit)
    frame = PlanFrame(UNITS.get(unit) or scale or 1.0, frame.y_down or in_pixels, frame.up)
    notes = []
    if frame.scale != 1:
        notes.append(f"columns {' and '.join(names)} have {frame.scale:.4g} {unit or 'units'} in a metre")
    if frame.y_down:
        notes.append(f"{names[1]} points down, so y is its negative")
    if frame.up != "z":
        notes.append(f"{frame.up} points up in the table, so its axes x, y, z are x, z, -y of the data")
    return frame, notes


class GeodeticOrigin(NamedTuple):
    """Point where local metres (x east, y north) touch the WGS84 ellipsoid, by azimuthal equidistant projection.

    Args:
        latitude: Latitude of x = y = 0 [deg].
        longitude: Longitude of x = y = 0 [deg].

    Example:
        >>> origin = GeodeticOrigin(48.0, 11.0)
        >>> origin.to_metres(np.array([[48.001, 11.0]])).round(1)
        array([[  0. , 111.2]])
        >>> origin.to_degrees(np.array([[0.0, 111.2]])).round(4)
        array([[48.001, 11.   ]])
    """

    latitude: float
    longitude: float

    @classmethod
    def amid(cls, degrees: Floats) -> GeodeticOrigin:
        """Return the median of latitudes and longitudes (n, 2) [deg], on either side of the antimeridian."""
        first = float(degrees[0, 1])
        east = (degrees[:, 1] - first + 180) % 360 - 180
        longitude = (first + float(np.median(east)) + 180) % 360 - 180
        return cls(round(float(np.median(degrees[:, 0])), 7), round(longitude, 7))

    def to_metres(self, degrees: Floats) -> Floats:
        """Return x and y (n, 2) [m] of latitudes and longitudes (n, 2) [deg]."""
        return self._projected(degrees[:, 1], degrees[:, 0])

    def to_degrees(self, xy: Floats) -> Floats:
        """Return latitudes and longitudes (n, 2) [deg] of x and y (n, 2) [m]."""
        return self._projected(xy[:, 0], xy[:, 1], inverse=True)[:, ::-1]

    def _projected(self, a: Floats, b: Floats, inverse: bool = False) -> Floats:
        from pyproj import Proj  # takes a moment, and most data are in metres

        projection = Proj(proj="aeqd", lat_0=self.latitude, lon_0=self.longitude, ellps="WGS84")
        return np.stack(projection(a, b, inverse=inverse), axis=1)

    def __str__(self) -> str:
        return f"latitude {self.latitude:.7g}, longitude {self.longitude:.7g}"


def degree_columns(origin: GeodeticOrigin | None, xy: Floats) -> dict[str, Floats]:
    """Return columns with latitude and longitude [deg] of positions (n, 2 or more) [m]; none without an origin.

    Example:
        >>> degree_columns(GeodeticOrigin(48.0, 11.0), np.zeros((1, 2)))
        {'latitude_deg': array([48.]), 'longitude_deg': array([11.])}
    """
    if origin is None:
        return {}
    return dict(zip(("latitude_deg", "longitude_deg"), origin.to_degrees(xy).T, strict=True))


def without_fix(position: Floats) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which positions (n, 3) in any unit are no fix, and notes on them.

    An empty position is no fix. Neither is x = y = 0 if it is far from all others, if it occurs more often than any other
    position without being the neighbour of one, or if z is 0 there alone. The same holds for -1, 999 and 9999, if repeated.

    Example:
        >>> without_fix(np.array([[50.0, 5.0, 1.0], [50.0, 6.0, 1.0], [np.nan, 5.0, 1.0], [0.0, 0.0, 0.0]]))[0]
        array([False, False,  True,  True])
    """
    empty, finite = np.isnan(position.sum(axis=1)), np.isfinite(position).all(axis=1)
    reasons = {"without a position": empty}
    omitted = empty.copy()
    for value in NO_FIX:
        rows = (position[:, 0] == value) & (position[:, 1] == value)
        if (rows.sum() > 1 or (value == 0 and rows.any())) and _is_apart(
            position[finite & ~omitted & ~rows], position[rows]
        ):
            reasons[f"at {value:g}, {value:g}, apart from all others"] = rows
            omitted |= rows
    notes = [
        f"rows {what} are left out: {int(rows.sum())} of {len(position)}"
        for what, rows in reasons.items()
        if rows.any()
    ]
    return omitted, notes


def _is_apart(others: Floats, same: Floats, far_ratio: float = 10.0) -> bool:
    """Return True if one repeated position, (m, 3), is apart from the places of the others (n, 3).

    They are far at `far_ratio` times the distance between neighbours (not studied).
    """
    places, times = np.unique(others[:, :2], axis=0, return_counts=True)
    if len(places) < 2:
        return False
    tree = cKDTree(places)
    spacing = float(np.median(tree.query(places, k=2)[0][:, 1]))
    distance = float(tree.query(same[0, :2])[0])
    of_no_height = not bool(same.any()) and bool((others[:, 2] != 0).all())
    more_often = len(same) > int(times.max())
    return of_no_height or distance > far_ratio * spacing or (more_often and distance > spacing)


def degrees_in(
    source: object,
    names: tuple[str, str],
    xy: Floats,
    named: bool,
    asked: Coordinates | None,
    far_ratio: float = 10.0,
    max_extent_deg: float = 2.0,
    max_walk_deg: float = 0.05,
) -> tuple[Floats | None, list[str]]:
    """Return latitudes and longitudes (n, 2) [deg], None if the coordinates are metres, and a note on their unit.

    Coordinates that are named after degrees may count 1e-7 degrees, or degrees and minutes (ddmm.mmmm). They are metres only
    if none of them can be degrees. Longitudes may count from 0 to 360 degrees.

    Args:
        source: Name of the table, for messages.
        names: Names of both columns.
        xy: Longitude or x, and latitude or y, (n, 2). Without names, x is the latitude if y exceeds 90.
        named: Whether the columns are named after longitude and latitude.
        asked: What the user states.
        far_ratio: Distance of degrees from 0, 0 in their extents, at least. The bounds are not studied.
        max_extent_deg: Largest extent of positions that are recognised as degrees.
        max_walk_deg: Largest extent of degrees without names, 5 km: in metres it is 5 cm, and no walk.

    Raises:
        InputError: Values that are no degrees though the user or their names state it, or that may be either.

    Example:
        >>> degrees_in("walk.csv", ("x", "y"), np.array([[11.0, 48.0], [11.0, 48.001]]), False, None)[0][1].tolist()
        [48.001, 11.0]
        >>> degrees_in("walk.csv", ("lon", "lat"), np.array([[850.5, 4730.0]]), True, None)[0].round(4)
        array([[47.5   ,  8.8417]])
    """
    columns, notes = f"columns {names[0]} and {names[1]}", list[str]()
    if asked == "metres" or not np.isfinite(xy).all():  # which is refused later
        return None, notes
    size = np.abs(xy)
    if named and (size > 180).any():
        xy, notes = _plain_degrees(source, columns, xy)
    swapped = not named and bool((np.abs(xy[:, 1]) > 90).any())
    degrees = xy if swapped else xy[:, ::-1]
    stated = named or asked == "degrees"
    if stated and 180 < degrees[:, 1].max() <= 360 and degrees[:, 1].min() >= 0:
        degrees = np.stack([degrees[:, 0], (degrees[:, 1] + 180) % 360 - 180], axis=1)
        notes.append(f"longitudes in {columns} count from 0 to 360 degrees")
    if not (np.abs(degrees) <= (90, 180)).all():
        if asked is None and (size > (360, 90)).all():
            return None, [f"{columns} count as metres, because none of their values can be degrees"] * named
        if stated:
            fault = "latitudes beyond 90 degrees; are they swapped? Name them with columns latitude=NAME longitude=NAME"
            if not (np.abs(degrees) <= 180).all():
                fault = "values beyond 180 degrees; if they are metres, give --coordinates metres"
            raise InputError(f"{source}: {columns} hold {fault}")
        return None, notes
    east = (degrees[:, 1] - degrees[0, 1] + 180) % 360  # on either side of the antimeridian
    extent, distance = float(max(np.ptp(degrees[:, 0]), np.ptp(east))), float(np.abs(xy).max())
    if asked == "degrees" or (named and extent <= max_extent_deg):
        return degrees, notes
    if not named and (distance <= far_ratio * extent or extent == 0 or extent > max_extent_deg):
        return None, notes
    if not named and extent <= max_walk_deg:
        return degrees, notes
    raise InputError(
        f"{source}: {columns} extend over {extent:.3g} and may be degrees or metres; choose --coordinates degrees or "
        "--coordinates metres"
    )


def _plain_degrees(
    source: object, columns: str, xy: Floats, min_extent_m: float = 2.0, max_extent_minutes: float = 30.0
) -> tuple[Floats, list[str]]:
    """Return values (n, 2) [deg] of counts of 1e-7 degrees or of ddmm.mmmm, and a note; others as they are.

    A walk extends over at least `min_extent_m` in metres, and at most `max_extent_minutes` in ddmm.mmmm (not studied).

    Raises:
        InputError: Values that may be ddmm.mmmm or metres.
    """
    size, extent = np.abs(xy), float(np.ptp(xy, axis=0).max())
    degree, minutes = np.divmod(size, 100)
    if bool((xy % 1 == 0).all()) and (size <= (180e7, 90e7)).all() and size.min(axis=0).max() >= 1e7:
        return xy / 1e7, [f"{columns} count 1e-7 degrees, which are converted to degrees"]
    if (minutes >= 60).any() or (degree > (180, 90)).any() or extent > max_extent_minutes:
        return xy, []
    if extent > min_extent_m:
        raise InputError(
            f"{source}: {columns} may be degrees and minutes (ddmm.mmmm) or metres; convert them to degrees, or give "
            "--coordinates metres"
        )
    note = f"{columns} count degrees and minutes (ddmm.mmmm), which are converted to degrees"
    return np.sign(xy) * (degree + minutes / 60), [note]


@dataclass(frozen=True)
class Floors:
    """Floors, ascending.

    Args:
        names: Names in the table.
        height_m: Median height z of the measurements on each floor [m].

    Example:
        >>> Floors(("ground", "first"), (1.2, 4.5)).number(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 5.0]]))
        tensor([0, 1])
    """

    names: Annotated[tuple[str, ...], "n"]
    height_m: Annotated[tuple[float, ...], "n"]

    def number(self, position: Tensor) -> Tensor:
        """Return the number of the floor whose height is nearest to each position (n, 3), int64 (n,)."""
        height = torch.tensor(self.height_m, dtype=torch.float64)
        return (position[:, 2:].double() - height).abs().argmin(dim=1)

    def named(self, position: Tensor) -> list[str]:
        """Return the name of the floor of each position (n, 3)."""
        return [self.names[number] for number in self.number(position).tolist()]


def floors_of(source: object, floor: list[str], position: Floats) -> Floors | None:
    """Return the floors by the name of each row's floor and its position (n, 3) [m]; None if there is one only.

    Names of one height at different places, e.g. in two buildings, are one floor.

    Raises:
        InputError: Floors of one height at the same places; the sentence begins with the source.

    Example:
        >>> position = np.array([[0, 0, 5.0], [0, 0, 1.0], [0, 0, 5.2]])
        >>> floors_of("walk.csv", ["1", "0", "1"], position)
        Floors(names=('0', '1'), height_m=(1.0, 5.1))
    """
    of_row = np.array(floor, dtype=object)
    rows = {name: position[of_row == name] for name in set(floor) - {""}}
    height = {name: float(np.median(at[:, 2])) for name, at in rows.items()}
    levels: list[list[str]] = []
    for name in sorted(height, key=lambda name: (height[name], name)):
        if levels and height[name] - height[levels[-1][0]] < MIN_STOREY_M:
            if above := [other for other in levels[-1] if _overlap(rows[name], rows[other])]:
                raise InputError(
                    f"{source}: floors {above[0]!r} and {name!r} have heights of {height[above[0]]:.3g} and "
                    f"{height[name]:.3g} m at the same places; give heights above one ground, or numbers of the floors "
                    "without heights"
                )
            levels[-1].append(name)
        else:
            levels.append([name])
    heights = (float(np.mean([height[name] for name in level])) for level in levels)
    return Floors(tuple(", ".join(level) for level in levels), tuple(heights)) if len(levels) > 1 else None


def _overlap(a: Floats, b: Floats, margin_m: float = 0.5) -> bool:
    """Return True if more than half of the positions of one floor are in the box of the other, with a margin in height."""
    margin = np.array([0.0, 0.0, margin_m])
    boxes = ((p >= q.min(axis=0) - margin) & (p <= q.max(axis=0) + margin) for p, q in ((a, b), (b, a)))
    return any(float(inside.all(axis=1).mean()) > 0.5 for inside in boxes)


def floor_numbers(names: Sequence[str]) -> Floats:
    """Return the number of each floor by its name: a number, a word such as "ground" or "second", or a digit in the name.

    Numbers of names that contain neither are nan. A basement is below 0.

    Example:
        >>> floor_numbers(["Ground", "2nd floor", "1.OG", "B2", "UG", "-1", "annex"]).tolist()
        [0.0, 2.0, 1.0, -2.0, -1.0, -1.0, nan]
    """

    def number(name: str) -> float:
        plain = name.strip().lower()
        if below := BELOW_GROUND.fullmatch(plain):
            return -float(below[1] or 1)
        word = plain.removesuffix("floor").removesuffix("level").strip(" _-")
        digits = re.findall(r"(?<![^\W_])-\d+|\d+", plain)
        return FLOOR_NAMES[word] if word in FLOOR_NAMES else float(digits[0]) if len(digits) == 1 else math.nan

    return np.array([number(name) for name in names], dtype=np.float64)
