"""Received powers in tables: fillers, ends of the scale, and values that are no received power.

A filler is a constant where a receiver detected nothing: 0, 100, 127 (Bluetooth: not available), -100, or a value just below
the weakest measurement. It is recognised by its place at the edge of all values and by its frequency.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from swiftwrf.data.cells import Floats, column_of_numbers, parsed
from swiftwrf.errors import InputError

NOT_DETECTED_DBM = -100.0  # the usual filler
KNOWN_FILLERS = (NOT_DETECTED_DBM, -200.0, 0.0, 100.0, 127.0)
MIN_RSSI_DBM, MAX_RSSI_DBM = -150.0, 30.0
# Microsoft, WLAN_ASSOCIATION_ATTRIBUTES: a quality of 0 is -100 dBm, and of 100 it is -50 dBm
RSSI_UNITS = {  # beside dBm: largest value, factor and offset to dBm, and what converts so
    "percent": (100.0, 0.5, -100.0, "RSSI in percent counts as percent / 2 - 100 dBm, the scale of Windows"),
    "positive": (150.0, -1.0, 0.0, "RSSI without sign counts as negative"),
}


def find_fillers(
    rssi: Floats, min_repeats: int = 5, min_usual_dbm: float = -1.0, within_db: float = 10.0
) -> list[float]:
    """Return the values in a table of RSSI (n, R) [dBm] that stand for "not detected", apart from nan and -inf.

    Args:
        rssi: Values of the cells.
        min_repeats: Number of cells with a filler that is not known. The bounds are not studied.
        min_usual_dbm: A frequent value from here on is a filler, unless another one within `within_db` is as frequent.
        within_db: Distance to the values that are compared [dB].

    Example:
        >>> find_fillers(np.array([[-60.0, 127.0], [-70.0, -65.0], [0.0, -80.0]]))
        [127.0, 0.0]
    """
    value, count = np.unique(rssi[rssi > -np.inf], return_counts=True)
    impossible = (value < MIN_RSSI_DBM) | (value > MAX_RSSI_DBM)
    is_filler = impossible & np.isin(value, KNOWN_FILLERS)
    if (others := impossible & ~is_filler).sum() == 1:
        is_filler |= others & (count >= min_repeats)
    fillers: list[float] = value[is_filler].tolist()
    value, count = value[~impossible], count[~impossible]
    while len(value) and value[-1] >= min_usual_dbm and _is_frequent(value, count, len(value) - 1, within_db):
        fillers.append(float(value[-1]))
        value, count = value[:-1], count[:-1]
    usual = np.flatnonzero(value == NOT_DETECTED_DBM)
    if len(usual) and (usual[0] == 0 or _is_frequent(value, count, int(usual[0]))):
        fillers.append(NOT_DETECTED_DBM)
    elif _fills_the_lower_edge(rssi, value, count):
        fillers.append(float(value[0]))
    return fillers


def has_frequent_edge(rssi: Floats, min_values: int = 5, min_fraction: float = 0.2) -> bool:
    """Return True if the least of the values of a receiver (n,) [dBm] is far more frequent than those above it.

    There are more than `min_values` different values, and at least a fraction of all are the least one (not studied).

    Example:
        >>> has_frequent_edge(np.array([-90.0] * 9 + [-89, -88, -87, -80, -75, -70, -60]))
        True
    """
    value, count = np.unique(rssi, return_counts=True)
    return len(value) > min_values and int(count[0]) >= min_fraction * len(rssi) and _is_frequent(value, count, 0)


def _is_frequent(
    value: Floats, count: NDArray[np.int64], index: int, within_db: float = 5.0, ratio: float = 3.0
) -> bool:
    """Return True if a value is `ratio` times as frequent as every other one within a distance, in bins of 1 dB."""
    near = np.abs(value - value[index]) <= within_db
    near[index] = False
    bins = np.bincount((value[near] - value[index] + within_db).round().astype(int), count[near], minlength=1)
    return bool(count[index] > ratio * bins.max())


def _fills_the_lower_edge(
    rssi: Floats,
    value: Floats,
    count: NDArray[np.int64],
    fraction: float = 0.5,
    min_values: int = 5,
    min_repeats: int = 5,
) -> bool:
    """Return True if the least value is frequent, and is that of more than a fraction of the receivers."""
    if len(value) <= min_values or count[0] < min_repeats or not _is_frequent(value, count, 0):
        return False
    weakest = np.where(rssi >= value[0], rssi, np.inf).min(axis=0)
    return bool((weakest[np.isfinite(weakest)] == value[0]).mean() > fraction)  # near receivers detect every row


def without_fillers(rssi: Floats, fillers: list[float], quantity: str | None = None) -> tuple[Floats, list[str]]:
    """Return RSSI (n, R) with nan in place of fillers and of -inf, and a note on each of them.

    Another quantity than RSSI has no usual filler.

    Example:
        >>> without_fillers(np.array([[-60.0, 127.0]]), [127.0])
        (array([[-60.,  nan]]), ['127 counts as not detected: 1 of 2 cells (50%)'])
    """
    notes = []
    filled = np.zeros(rssi.shape, dtype=bool)
    for filler in [-np.inf, *fillers]:
        cells = rssi == filler
        if n := int(cells.sum()):
            notes.append(f"{filler:g} counts as not detected: {n} of {rssi.size} cells ({n / rssi.size:.0%})")
        filled |= cells
    if quantity is None and NOT_DETECTED_DBM not in fillers and (n := int((rssi == NOT_DETECTED_DBM).sum())):
        notes.append(f"{NOT_DETECTED_DBM:g} dBm counts as measured: {n} cells")
    return np.where(filled, np.nan, rssi), notes


def end_of_scale(rssi: Floats, min_fraction: float = 0.25) -> list[str]:
    """Return a note on the largest value of RSSI (n, R) [dBm] if it is as frequent as only the end of a scale is, or none.

    More than `min_fraction` of the receivers reach it (not studied).

    Example:
        >>> end_of_scale(np.array([[-50.0] * 6 + [-51, -52, -53, -58, -60, -62]]).T)
        ['the scale ends at -50 dBm: 6 of 12 cells (50%) have this largest value, so their power is at least that']
    """
    value, count = np.unique(-rssi[~np.isnan(rssi)], return_counts=True)
    if not _fills_the_lower_edge(-rssi, value, count, min_fraction):
        return []
    cells = f"{count[0]} of {rssi.size} cells ({count[0] / rssi.size:.0%})"
    return [f"the scale ends at {-value[0]:g} dBm: {cells} have this largest value, so their power is at least that"]


def signal_power(
    rssi: Floats, snr: Floats, min_fraction: float = 0.05, min_packets: int = 20, max_ratio: float = 0.5
) -> Floats | None:
    """Return the power of the signals of LoRa packets [dBm], None if RSSI is that power already.

    Below the noise, RSSI is the power of the noise. With the signal-to-noise ratio it determines that of the signal:
    RSSI + SNR - 10 log10(1 + 10^(SNR / 10)), since RSSI is the sum of both. Other receivers detect nothing there.

    Args:
        rssi: RSSI (n, R) [dBm], nan where empty.
        snr: Signal-to-noise ratios [dB], (n, R) or (n, 1).
        min_fraction: Least fraction of packets below the noise. The bounds are not studied.
        min_packets: Least number of packets below the noise.
        max_ratio: Largest standard deviation of their RSSI, relative to that of RSSI less SNR.

    Example:
        >>> level = np.linspace(-125, -105, 81)[:, None]
        >>> total = 10 * np.log10(10 ** (level / 10) + 10**-11.7)
        >>> bool(np.allclose(signal_power(total, level + 117), level))
        True
    """
    below = np.isfinite(rssi) & (snr < 0)
    if below.sum() < max(min_packets, min_fraction * np.isfinite(rssi).sum()):
        return None
    noise = rssi - np.where(np.isfinite(rssi), snr, np.nan)
    if rssi[below].std() > max_ratio * noise[below].std():  # RSSI follows the signal, not the noise
        return None
    power = rssi + snr - 10 * np.log10(1 + 10 ** (snr / 10))
    return np.where(np.isnan(power), rssi, power)


def of_one_power(
    rssi: Floats, transmitted: Floats, position: Floats, min_slope: float = 0.5, min_rows: int = 10
) -> tuple[Floats, float] | None:
    """Return RSSI as if all packets had the most frequent transmit power, and that power; None if RSSI does not follow it.

    It follows if differences of RSSI between rows and their nearest rows of another power have a slope of 1, within
    `min_slope` (not studied), over the differences of the transmit power.

    Args:
        rssi: RSSI (n, R) [dBm], nan where empty.
        transmitted: Transmit power (n, R) or (n, 1) [dBm], or its difference to another one.
        position: Positions of the rows, (n, 2 or more).
        min_slope: Largest difference of the slope to 1.
        min_rows: Least number of rows of each transmit power.

    Example:
        >>> power, place = np.array([0.0, -12.0] * 10)[:, None], np.arange(20.0)[:, None] * [1, 0]
        >>> np.unique(of_one_power(-60 + power, power, place)[0])
        array([-72.])
    """
    transmitted = np.broadcast_to(transmitted, rssi.shape)
    values, count = np.unique(transmitted[np.isfinite(rssi) & np.isfinite(transmitted)], return_counts=True)
    if not 2 <= len(values) <= 30 or count.min() < min_rows:
        return None
    products, squares = 0.0, 0.0
    for column, power in zip(rssi.T, transmitted.T, strict=True):
        known = np.isfinite(column) & np.isfinite(power)
        for value in values:
            here, others = np.flatnonzero(known & (power == value)), np.flatnonzero(known & (power != value))
            if len(here) and len(others):
                near = here[cKDTree(position[here]).query(position[others])[1]]
                step = power[others] - value
                products += float(step @ (column[others] - column[near]))
                squares += float(step @ step)
    reference = float(values[count.argmax()])
    if not squares or abs(products / squares - 1) > min_slope:
        return None
    return rssi - np.nan_to_num(transmitted - reference), reference


def in_dbm(source: object, table: pd.DataFrame, names: Sequence[str], unit: str) -> tuple[pd.DataFrame, list[str]]:
    """Return a table whose columns of RSSI in another unit are in dBm, and a note.

    Raises:
        InputError: No such column, or a value that the unit does not have.

    Example:
        >>> in_dbm("a.csv", pd.DataFrame({"rssi": [80, 0]}), ["rssi"], "percent")[0].rssi.tolist()
        [-60.0, -100.0]
    """
    if not names:
        raise InputError(
            f"{source}: unit {unit} needs the columns of RSSI; choose with columns rssi=NAME or rssi='PREFIX*'"
        )
    most, factor, offset, note = RSSI_UNITS[unit]
    columns = {}
    for name in names:
        values, text = parsed(table[name])
        wrong = values[(values < 0) | (values > most) & ~np.isin(values, KNOWN_FILLERS)]
        if len(wrong):
            raise InputError(f"{source}: {name} has the value {wrong[0]:g}; unit {unit} has values of 0 to {most:g}")
        converted = np.where(values <= most, factor * values + offset, values)
        columns[name] = table[name].where(text, converted) if text.any() else converted
    return table.assign(**columns), [note]


def check_powers(source: object, rssi: Floats, receivers: Sequence[str], table_row: NDArray[np.int64]) -> None:
    """Refuse RSSI (n, R) [dBm] that is no received power.

    Rows of the values in the table are counted from 0, (n, R) or (n, 1).

    Raises:
        InputError: The first such value, with its row and receiver.
    """
    bad = (rssi < MIN_RSSI_DBM) | (rssi > MAX_RSSI_DBM)
    if not bad.any():
        return
    rows = np.broadcast_to(table_row, rssi.shape)
    if bad.sum() > 1 and np.nanmedian(rssi) > 0:  # one is an error
        raise InputError(
            f"{source} has positive values of RSSI; if they are dBm without sign, give unit positive, and if they are "
            "percent, unit percent"
        )
    row, column = min(np.argwhere(bad), key=lambda cell: rows[tuple(cell)])
    value = rssi[row, column]
    raise InputError(
        f"{source} row {rows[row, column] + 1}, receiver {receivers[column]}: {value:g} dBm is no received power; expected "
        f"{MIN_RSSI_DBM:g} to {MAX_RSSI_DBM:g}; if it stands for not detected, give nan or --filler {value:g}"
    )


def powers_in(
    source: object, table: pd.DataFrame, names: Sequence[str], min_repeats: int = 5
) -> tuple[Floats, list[str]]:
    """Return the RSSI in columns (n, len(names)), nan where it was not detected, for which a repeated word may stand.

    Raises:
        InputError: Text in place of numbers.
    """
    values, text = (np.stack(part, axis=1) for part in zip(*(parsed(table[name]) for name in names), strict=True))
    words = pd.Series(table[list(names)].to_numpy(dtype=object)[text], dtype=object).astype(str).str.strip()
    if len(words) >= min_repeats and words.nunique() == 1:
        cells = f"{len(words)} of {text.size} cells ({text.mean():.0%})"
        return values, [f"{words[0]!r} counts as not detected: {cells}"]
    for name in np.array(names)[text.any(axis=0)]:
        column_of_numbers(source, table, name)
    return values, []
