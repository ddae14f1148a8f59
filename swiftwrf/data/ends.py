"""Tables of links both of whose ends move: columns of the second end, and its positions as receivers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from swiftwrf.data.columns import candidates, plain_name
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import cells

Floats = NDArray[np.float64]
MAX_PLACES = 500  # positions of the second end that stay apart: each has a column of RSSI
MARKS = {"tx": "transmitter", "transmitter": "transmitter", "rx": "receiver", "receiver": "receiver"}  # words in names


def transmitter_columns(label: object, table: pd.DataFrame, given: Sequence[str]) -> dict[str, str]:
    """Return the columns of the second end by x, y and z; none in a table with positions of one end.

    Args:
        label: Name of the table, for messages.
        table: Its columns.
        given: Columns that the user names, in this order. Otherwise those marked tx or transmitter beside others, or those
            marked rx or receiver beside unmarked ones.

    Raises:
        InputError: A missing column, or another number of columns.

    Example:
        >>> table = pd.DataFrame(columns=["x", "y", "tx_x", "tx_y", "rssi"])
        >>> transmitter_columns("walk.csv", table, ())
        {'x': 'tx_x', 'y': 'tx_y'}
    """
    if given:
        missing = [name for name in given if name not in table.columns]
        if missing or len(given) not in (2, 3) or len(set(given)) < len(given):
            raise InputError(
                f"{label}: transmitter takes the columns of x, y and, if it is known, z, or one column of names, got "
                f"{' '.join(given)}; there are {listed(table.columns)}"
            )
        return dict(zip("xyz", given, strict=False))
    marked = {axis: {_mark(name): name for name in reversed(candidates(table, axis))} for axis in "xyz"}
    for mark, beside in (("transmitter", {"receiver", ""}), ("receiver", {""})):
        if all(mark in marked[axis] and beside & marked[axis].keys() for axis in "xy"):
            return {axis: names[mark] for axis, names in marked.items() if mark in names}
    return {}


def _mark(name: str) -> str:
    return next((MARKS[word] for word in plain_name(name).split("_") if word in MARKS), "")


def as_receivers(label: object, rssi: Floats, ends: Floats) -> tuple[list[str], Floats, Floats, Floats, list[str]]:
    """Return links as RSSI of one moving end at the positions of the other.

    Args:
        label: Name of the table, for messages.
        rssi: RSSI of the links, (n, 1) [dBm].
        ends: Positions of both ends, (n, 6) [m]. The end with fewer positions becomes the receivers.

    Returns:
        Names of P receivers, RSSI (n, P) [dBm], positions of the other end (n, 3) [m], those of the receivers (P, 3) [m],
        and notes.

    Raises:
        InputError: RSSI of several receivers.
    """
    if rssi.shape[1] != 1:
        raise InputError(
            f"{label} has positions of both ends and RSSI of {rssi.shape[1]} receivers; name one: columns rssi=NAME, or "
            "pool them: pool_by"
        )
    own, other = ends[:, :3], ends[:, 3:]
    if len(np.unique(own, axis=0)) < len(np.unique(other, axis=0)):
        own, other = other, own
    place, edge = cells(torch.from_numpy(other), MAX_PLACES)
    n = int(place.max()) + 1
    count = np.bincount(place.numpy(), minlength=n)
    position = np.stack([np.bincount(place.numpy(), axis, minlength=n) / count for axis in other.T], axis=1)
    notes = [f"both ends move; {n} positions of one of them count as receivers place1 to place{n}"]
    if edge:
        notes.append(f"its positions are averaged in cubes of {edge:.3g} m")
    values = np.full((len(rssi), n), np.nan)
    values[np.arange(len(rssi)), place.numpy()] = rssi[:, 0]
    return [f"place{number}" for number in range(1, n + 1)], values, own, position, notes
