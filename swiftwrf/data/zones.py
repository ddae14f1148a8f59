"""Positions in several zones of UTM, which are brought into one."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd

from swiftwrf.data.cells import Floats, parsed, plain_name, text_of
from swiftwrf.errors import InputError, listed

NAME = re.compile(r"(?:utm_?)?zone(?:_?(?:utm|number|no|id))?|utm")
ZONE = re.compile(r"([1-5]?\d|60) *([C-HJ-NP-X]?)", re.IGNORECASE)
BORDER_JUMP_M = 1e5  # of eastings where zones meet, at least, south of 80 degrees


def zone_column(table: pd.DataFrame, x: str) -> str | None:
    """Return the column of UTM zones of a table with eastings in column x, None without several zones.

    Names of areas in one zone are no zones: eastings of neighbouring zones are hundreds of kilometres apart.
    """
    easting = parsed(table[x])[0]
    for name in table.columns:
        if NAME.fullmatch(plain_name(name)) and name != x:
            zone = text_of(table[name]).str.removesuffix(".0")
            median = pd.Series(easting).groupby(zone).median().dropna()
            if len(median) > 1 and zone.isin(["", *filter(ZONE.fullmatch, zone.unique())]).all():
                return str(name) if median.max() - median.min() > BORDER_JUMP_M else None
    return None


def in_one_zone(source: object, zone: pd.Series, xy: Floats) -> tuple[Floats, list[str]]:
    """Return eastings and northings (n, 2) [m] in the most frequent zone, nan without a zone, and a note.

    Args:
        source: Name of the table, for messages.
        zone: Zones with the letter of their band, e.g. 32U.
        xy: Eastings and northings in these zones (n, 2) [m].

    Raises:
        InputError: A zone whose hemisphere is unknown: one without a letter, or S, which is a band and a hemisphere.

    Example:
        >>> at_12_degrees_east = np.array([[723775.9, 5320655.8], [276224.1, 5320655.8]])
        >>> xy, notes = in_one_zone("a.csv", pd.Series(["32U", "33U"]), at_12_degrees_east)
        >>> xy.round().tolist(), notes
        ([[723776.0, 5320656.0], [723776.0, 5320656.0]], ['positions in UTM zones 32U, 33U are those of zone 32U'])
    """
    from pyproj import Proj  # takes a moment, and most data are in one zone

    zone = text_of(zone).str.removesuffix(".0").str.upper().str.replace(" ", "")
    names = sorted(zone[zone != ""].unique())
    main = str(zone[zone != ""].mode().iloc[0])
    if doubtful := [name for name in names if name[-1].isdigit() or name[-1] == "S"]:
        raise InputError(
            f"{source} has positions in UTM zones {listed(names)}; the hemisphere of {doubtful[0]} is unknown: give the "
            "band of each zone, e.g. 32U, or longitudes and latitudes"
        )

    def projection(name: str) -> Proj:
        return Proj(proj="utm", zone=int(name[:-1]), ellps="WGS84", south=name[-1] < "N")

    joined = np.full_like(xy, np.nan)
    for name in names:
        rows = (zone == name).to_numpy()
        joined[rows] = xy[rows]
        if name != main:
            degrees = projection(name)(xy[rows, 0], xy[rows, 1], inverse=True)
            joined[rows] = np.stack(projection(main)(*degrees), axis=1)
    return joined, [f"positions in UTM zones {listed(names)} are those of zone {main}"]
