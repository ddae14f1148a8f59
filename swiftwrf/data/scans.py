"""Scans: times of rows, rows of RSSI that repeat, that belong together, and that list a part of the receivers only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from swiftwrf.data.cells import CLOCK_ONLY, Floats, parsed, plain_name, seconds, text_of
from swiftwrf.data.columns import candidates
from swiftwrf.data.powers import end_of_scale

HOUR_S = 3600.0


def repeated_scans(
    coordinate: Floats, rssi: Floats, min_receivers: int = 3, min_rows: int = 5, min_fraction: float = 0.05
) -> NDArray[np.bool_]:
    """Return which rows repeat the RSSI of the row before at another place.

    A scan of fewer than `min_receivers` repeats by chance. None is repeated, if fewer than `min_rows` or a fraction of the
    rows are. The bounds are not studied.
    """
    before = np.isnan(rssi[:-1]) & np.isnan(rssi[1:]) | (rssi[:-1] == rssi[1:])
    top = np.nanmax(rssi) if end_of_scale(rssi) else np.inf  # which repeats by chance
    several = (rssi[1:] < top).sum(axis=1) >= min_receivers
    repeated = np.append(False, before.all(axis=1) & several & (coordinate[1:, :2] != coordinate[:-1, :2]).any(axis=1))
    enough = repeated.sum() >= max(min_rows, min_fraction * len(rssi))
    return repeated if enough else np.zeros_like(repeated)


def held_fixes(coordinate: Floats, min_rows: int = 5, min_jump: float = 5.0) -> NDArray[np.bool_]:
    """Return which rows of a walk repeat the position before because the receiver of satellites had no new one.

    Most positions of a walk differ from the one before. Who stands still goes on from there, but after a held fix the
    position jumps.

    Args:
        coordinate: Coordinates of successive rows (n, 3) in any unit.
        min_rows: Number of rows at a held position, at least. The bounds are not studied.
        min_jump: Distance of the next position in median steps, at least.

    Example:
        >>> x = [0, 1, 2, 3, 3, 3, 3, 3, 3, 9, 10, 11]
        >>> held_fixes(np.array([[value, 0.0, 0.0] for value in x])).nonzero()[0]
        array([4, 5, 6, 7, 8])
    """
    step = np.linalg.norm(np.diff(coordinate, axis=0), axis=1)
    if not (step > 0).sum() > len(step) / 2:
        return np.zeros(len(coordinate), dtype=bool)
    run = np.append(0, (step > 0).cumsum())
    jump = np.append(step[step > 0], 0.0)  # after each run; the last one has none
    held = (np.bincount(run) >= min_rows) & (jump >= min_jump * np.median(step[step > 0]))
    repeats: NDArray[np.bool_] = np.append(False, step == 0) & held[run]
    return repeats


def bad_fixes(accuracy: Floats, min_ratio: float = 5.0, max_fraction: float = 0.5) -> tuple[NDArray[np.bool_], float]:
    """Return which fixes are far less accurate than usual ones by their stated accuracy, and the limit.

    The accuracy is a distance or a dilution of precision (n,), 0 or nan where unknown. A fix above `min_ratio` times the
    median is left out, unless that are more than `max_fraction` of all (not studied).

    Example:
        >>> bad_fixes(np.array([4.0, 5.0, 6.0, 90.0]))
        (array([False, False, False,  True]), 27.5)
    """
    known = accuracy[accuracy > 0]
    limit = min_ratio * float(np.median(known)) if len(known) else np.inf
    bad = accuracy > limit
    return (bad, limit) if bad.mean() <= max_fraction else (np.zeros_like(bad), np.inf)


def split_packets(rssi: Floats, time: Floats, min_rows: int = 5, min_fraction: float = 0.9) -> list[str]:
    """Return a note on rows of one receiver each that follow each other within a second, or none."""
    alone = float(((~np.isnan(rssi)).sum(axis=1) == 1).mean())
    step = float(np.median(np.diff(np.sort(time)))) if len(time) >= min_rows else np.inf  # nan without some times
    if rssi.shape[1] < 2 or alone < min_fraction or not step < 1:
        return []
    return [
        f"rows hold the packet of one receiver each, {step:.2g} s after the row before; --window 1 joins the packets of a "
        "second"
    ]


def windows(
    kind: NDArray[Any], time: Floats, rssi: Floats, position: Floats, window: float, n_phases: int = 20
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Return the first row, and mean RSSI [dBm], position and time of the rows in each window. Kinds are kept apart.

    Windows begin where the cycles of the receivers do: where they contain the fewest packets of one receiver twice. Of
    `n_phases` beginnings, the best counts (not studied).
    """
    alone = -1.0 - np.arange(len(time))  # rows without a time
    row, receiver = np.nonzero(~np.isnan(rssi))
    most = -1
    for phase in np.linspace(0, 1, n_phases, endpoint=False):
        number_of_window = np.where(np.isnan(time), alone, np.floor((time - np.nanmin(time)) / window + phase))
        keys = pd.DataFrame({"kind": kind, "window": number_of_window})
        tried = keys.groupby(["kind", "window"], sort=False).ngroup().to_numpy()
        if (n := len(np.unique(tried[row] * rssi.shape[1] + receiver))) > most:
            most, number = n, tried
    _, first = np.unique(number, return_index=True)
    n_rssi, n_position = rssi.shape[1], position.shape[1]
    means = pd.DataFrame(np.column_stack([rssi, position, time])).groupby(number).mean().to_numpy()
    return first, means[:, :n_rssi], means[:, n_rssi : n_rssi + n_position], means[:, -1]


def list_margin(
    rssi: Floats,
    position: Floats,
    roaming_db: float = 8.0,
    *,
    min_rows: int = 20,
    min_fraction: float = 0.95,
    min_at_most: float = 0.5,
    max_by_chance: float = 0.8,
    min_agreement: float = 0.25,
) -> float | None:
    """Return how far an empty cell may be above the weakest value of its row [dB], None if rows list all receivers.

    Scan apps and modems list the N strongest receivers: the margin is 0 dB. Phones and drive tests log the associated one,
    which another one replaces if it is stronger by a hysteresis. Rows with single packets of receivers in turn have an
    infinite margin. In all these an empty cell is no sign of a signal below the limit of detection.

    Args:
        rssi: RSSI (n, R) [dBm], nan where a row has no value.
        position: Positions of the rows (n, 3) [m].
        roaming_db: Hysteresis of roaming [dB]: that of Apple's devices while they transmit ("About wireless roaming for
            enterprise", support.apple.com/102002).
        min_rows: Least number of rows with a value. The bounds are not studied.
        min_fraction: Least fraction of the rows with N values or fewer.
        min_at_most: Least fraction of the rows with N values.
        max_by_chance: Largest probability of as few values, if each receiver detects packets independently of the others.
        min_agreement: Least fraction of rows with the receiver of the nearest other row, beyond that by chance, from which
            on single values are of associated receivers.

    Example:
        >>> row = np.arange(60)[:, None]
        >>> list_margin(np.where(row // 20 == np.arange(3), -60.0, np.nan), row * [1.0, 0.0, 0.0])
        8.0
    """
    count = (~np.isnan(rssi)).sum(axis=1)
    detected, position, count = ~np.isnan(rssi[count > 0]), position[count > 0], count[count > 0]
    if len(count) < min_rows:
        return None
    number = int(np.quantile(count, min_fraction, method="higher"))
    single = number == 1
    if number == rssi.shape[1] or (count == number).mean() < min_at_most:
        return None
    groups = [np.arange(rssi.shape[1])] if single else _detected_together(detected)
    by_chance = [_at_most(number, detected[:, group]) for group in groups if len(group) > number]
    if min(by_chance, default=1.0) > max_by_chance:
        return None
    if not single:
        return 0.0
    receiver = detected.argmax(axis=1)
    nearest = cKDTree(position).query(position, k=2)[1]
    other = np.where(nearest[:, 0] == np.arange(len(position)), nearest[:, 1], nearest[:, 0])
    chance = float(np.square(detected.mean(axis=0)).sum())
    agreement = float((receiver == receiver[other]).mean())
    return roaming_db if agreement - chance >= min_agreement * (1 - chance) else np.inf


def _at_most(number: int, detected: NDArray[np.bool_]) -> float:
    """Return the probability that a row with a detection has at most a number of them, of independent receivers."""
    counts = np.eye(1, number + 1)[0]  # probabilities of 0 to number detections
    for fraction in detected[detected.any(axis=1)].mean(axis=0):
        counts = counts * (1 - fraction) + np.append(0.0, counts[:-1]) * fraction
    return float(counts[1:].sum() / max(1 - counts[0], 1e-9))


def _detected_together(detected: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Return groups of columns, of which each has a value in a row of another one of its group."""
    pairs = csr_array(detected.T.astype(np.float32) @ detected.astype(np.float32))
    number, label = connected_components(pairs, directed=False)
    return [np.flatnonzero(label == group) for group in range(number)]


def times_of(
    table: pd.DataFrame,
    name: str,
    position: Floats,
    max_speed_m_s: float = 2e-3,
    max_step_m: float = 1.0,
    min_rows: int = 6,
    max_change_s: float = 60.0,
) -> tuple[Floats, list[str]]:
    """Return the times of the rows [s] in a column, and notes; dates may be in another column.

    Whole numbers at which the positions move slower than anybody walks, but not in milliseconds, are milliseconds. They
    are those of a log of movement, with at least 6 rows and a median step below 1 m. Dates that run back once, by an hour up
    to a minute, are those of the end of summer time. The bounds are not studied.
    """
    column = table[name]
    days = [other for other in candidates(table, "time") if plain_name(other) == "date" and other != name]
    is_joined = bool(days) and column.dtype.kind not in "biufM" and text_of(column).str.fullmatch(CLOCK_ONLY).all()
    time, notes = seconds(column, table[days[0]] if is_joined else None)
    if is_joined:
        notes.append(f"columns {days[0]} and {column.name} together are the time")
    if not notes and np.isfinite(time).all() and len(time) >= min_rows and (parsed(column)[0] % 1 == 0).all():
        order = np.argsort(time, kind="stable")
        step, length = np.diff(time[order]), np.linalg.norm(np.diff(position[order, :3], axis=0), axis=1)
        speed = length[step > 0].sum() / max(step.sum(), 1e-9)
        if 1e-5 < speed < max_speed_m_s and np.median(length) < max_step_m:
            time = time / 1e3
            notes.append(
                f"column {column.name} counts milliseconds, which are converted to seconds: as seconds, the positions "
                f"move {1e3 * speed:.1g} mm/s"
            )
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back) == 1 and len(time) >= min_rows:
        after, seconds_back = int(back[0]) + 1, float(time[back[0]] - time[back[0] + 1])
        row = f"times of column {column.name} run back by {seconds_back:.4g} s before row {after + 1}"
        is_clock_change = abs(seconds_back - HOUR_S) <= max_change_s and column.dtype.kind not in "biuf"
        if is_clock_change:
            time = time + HOUR_S * (np.arange(len(time)) >= after)
        notes.append(f"{row}{', as at the end of summer time: an hour is added from there' if is_clock_change else ''}")
    return time, notes
