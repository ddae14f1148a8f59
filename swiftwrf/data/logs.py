"""Two logs of one walk, a track and scans, which are joined by time."""

from __future__ import annotations

import numpy as np
import pandas as pd

from swiftwrf.data.cells import EPOCH_UNITS, Floats, parsed, text_of
from swiftwrf.data.columns import GEODETIC, column_of, is_coordinate, is_rssi
from swiftwrf.errors import InputError

ZONE_STEP_S = 900.0  # time zones differ by multiples of it
MAX_ZONES_S = 26 * 3600.0  # largest difference of two time zones


def is_track(table: pd.DataFrame) -> bool:
    """Return True for a table of times and positions without RSSI."""
    return is_placed(table) and _time(table) is not None and not _has_power(table)


def is_log_of_scans(table: pd.DataFrame) -> bool:
    """Return True for a table of times and RSSI without positions."""
    return not is_placed(table) and _time(table) is not None and _has_power(table)


def is_placed(table: pd.DataFrame) -> bool:
    """Return True for a table with a column of x or longitude and one of y or latitude."""
    return all(column_of(table, x, {}) or column_of(table, longitude, {}) for x, longitude in GEODETIC.items())


def joined_by_time(
    source: object, track: pd.DataFrame, scans: pd.DataFrame, max_gap_s: float = 10.0, min_inside: float = 0.9
) -> tuple[pd.DataFrame, list[str]]:
    """Return scans with the positions of a track at their times, interpolated, and a note on their clocks.

    The clocks may differ by time zones or the end of summer time: by a multiple of 15 minutes, if one alone brings the scans
    into the time of the track. Scans in gaps of the track have no position. The bounds are not studied.

    Args:
        source: Name of both logs, for messages.
        track: Times and positions.
        scans: Times and RSSI.
        max_gap_s: Longest gap of the track in which positions are interpolated.
        min_inside: Fraction of the scans in the time of the track, at least.

    Raises:
        InputError: Logs of different times.
    """
    at_track, at_scan = _clock_s(track[_time(track)]), _clock_s(scans[_time(scans)])
    order = np.flatnonzero(np.isfinite(at_track))
    order = order[np.argsort(at_track[order], kind="stable")]
    at_track, track = at_track[order], track.iloc[order]
    known = at_scan[np.isfinite(at_scan)]
    if not len(at_track) or not len(known):
        raise InputError(
            f"{source}: no times of the track and the scans are known; give both a column of dates or seconds"
        )
    offsets = np.arange(-MAX_ZONES_S, MAX_ZONES_S + 1, ZONE_STEP_S)
    inside = {o: ((known - o >= at_track[0]) & (known - o <= at_track[-1])).mean() for o in [0.0, *offsets]}
    possible = [0.0] if inside[0.0] >= min_inside else [o for o in inside if inside[o] >= min_inside]
    if len(possible) != 1:
        raise InputError(
            f"{source}: {inside[0.0]:.0%} of the scans are in the time of the track, and {len(possible)} time zones bring "
            "them there; correct the times of one log, or take its part of this walk"
        )
    at_scan = at_scan - possible[0]
    after = np.searchsorted(at_track, at_scan).clip(1, len(at_track) - 1)
    away = np.maximum(at_track[after] - at_track[after - 1], 0) > max_gap_s
    away |= ~((at_scan >= at_track[0] - max_gap_s) & (at_scan <= at_track[-1] + max_gap_s))
    nearest = after - (at_scan - at_track[after - 1] < at_track[after] - at_scan)
    columns = {}
    for name in track.columns.difference([_time(track), *scans.columns], sort=False):
        values, text = parsed(track[name])
        cells = track[name].to_numpy(dtype=object)[nearest] if text.any() else np.interp(at_scan, at_track, values)
        columns[name] = pd.Series(cells, index=scans.index).mask(away & is_coordinate(name))
    joined = scans.assign(**columns)
    hours = possible[0] / 3600
    return joined, [
        f"the clock of the scans is {hours:+g} h from that of the track, which is corrected"
    ] if hours else []


def _time(table: pd.DataFrame) -> str | None:
    return column_of(table, "time", {})


def _has_power(table: pd.DataFrame) -> bool:
    return any(is_rssi(table[name]) and not is_coordinate(name) for name in table.columns)


def _clock_s(column: pd.Series) -> Floats:
    """Return times [s] since 1970 of dates or numbers, nan where a cell holds neither. Dates without a zone count as UTC."""
    values = np.full(len(column), np.nan) if column.dtype.kind == "M" else parsed(column)[0]
    if np.isnan(values).all():
        text = column if column.dtype.kind == "M" else text_of(column)
        when = pd.to_datetime(text, errors="coerce", utc=True, format="mixed")
        values = (when - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(np.float64)
    size = np.nanmedian(values) if np.isfinite(values).any() else 0.0
    unit = next((factor for _, factor, low, high in EPOCH_UNITS if low <= size < high), 1.0)
    return np.asarray(values / unit, dtype=np.float64)
