"""Rows of RSSI formed of packets: one a time and place, with the packets of all receivers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.cells import Floats, parsed, text_of
from swiftwrf.data.radios import plain_receiver, separate_radios, strongest_of_each, unknown_ids
from swiftwrf.errors import InputError, listed


def rows_of_packets(
    source: object,
    table: pd.DataFrame,
    column: str,
    power: Floats,
    keys: pd.DataFrame,
    n_listed: int = 1,
    max_values: int = 2**27,
) -> tuple[list[str], Floats, NDArray[np.int64], list[str]]:
    """Form the rows of a long table, one a time and place. Repeated packets have a row each.

    Without a receiver, nothing was detected.

    Args:
        source: Name of the table, for messages.
        table: Packets.
        column: Column of the receivers' names.
        power: Power of each packet (p,) [dBm], nan where empty.
        keys: Place, time and other values of packets whose rows stay apart; column time is empty without times.
        n_listed: Packets of one scan that follow each other.
        max_values: Number of values of RSSI, a limit of memory.

    Returns:
        Names of the R receivers, RSSI (n, R) [dBm], the packet of each value (n, R), and notes. A packet without a value is
        the first one of its row.

    Raises:
        InputError: A power without a receiver, or too many values.
    """
    receiver, notes, timed = text_of(table[column]), list[str](), bool((keys["time"] != "").any())
    if (unknown := unknown_ids(table[column]) & ~np.isnan(power)).any():
        ids = listed(receiver[unknown].unique())
        notes.append(f"{ids} in column {column} is no name, so these packets are left out: {unknown.sum()}")
    named = (receiver != "").to_numpy() & ~unknown_ids(table[column])
    if n_listed == 1 and len(nameless := np.flatnonzero((receiver == "").to_numpy() & ~np.isnan(power))):
        raise InputError(f"{source} row {nameless[0] + 1} has no receiver in column {column}")
    if not named.any():
        raise InputError(f"{source} has no receiver in column {column}; choose another one with columns receiver=NAME")
    keys = keys.assign(list=np.arange(len(keys)) // n_listed if n_listed > 1 else 0)
    together = keys.groupby(list(keys.columns), sort=False, dropna=False).ngroup()
    if by := separate_radios(table, column, together):
        receiver = receiver.where(receiver == "", receiver + " " + text_of(table[by]))
        notes.append(f"names in column {column} are those of several radios, which column {by} separates")
    spellings = {name: plain_receiver(name) for name in receiver.unique()}
    first_of = {plain: name for name, plain in reversed(spellings.items())}
    one = receiver.map({name: first_of[plain] for name, plain in spellings.items()})
    if len(others := receiver[one != receiver].unique()):
        notes.append(f"names count as those of one receiver that differ in case, separators or zeros: {listed(others)}")
    packets = pd.DataFrame(
        {"together": together, "receiver": pd.factorize(one)[0]}
    )  # groups of numbers take less memory
    strongest = strongest_of_each(packets, column, power, timed)
    if strongest is not None:
        n = int((~strongest & named).sum())
        notes.append(
            f"packets of one name, place and time are of several radios, of which the strongest counts: {n} are left out"
        )
        named &= strongest
    kept = named if n_listed > 1 else named | (receiver == "").to_numpy()
    repeats = packets[kept].groupby(["together", "receiver"]).cumcount().reindex(packets.index, fill_value=0)
    row = packets.groupby(["together", repeats], sort=False).ngroup().to_numpy()
    number, names = pd.factorize(one[named])
    _, first = np.unique(row, return_index=True)
    if len(first) * len(names) > max_values:
        raise InputError(
            f"{source} has {len(first)} rows and {len(names)} receivers; at most {max_values} values are read"
        )
    rssi, packet = np.full((len(first), len(names)), np.nan), np.tile(first[:, None], len(names))
    at = row[named], number
    rssi[at], packet[at] = power[named], np.flatnonzero(named)
    return list(names), rssi, packet, notes


def without_relayed(
    table: pd.DataFrame, columns: Sequence[str], rssi: Floats, packet: NDArray[np.int64]
) -> tuple[Floats, NDArray[np.bool_], list[str]]:
    """Return RSSI without packets that a relay sent from another place, the rows of such packets alone, and a note.

    Args:
        table: Packets.
        columns: Number of relays of each packet, or numbers of hops left at the start and the end. None of them is relayed
            without columns.
        rssi: RSSI (n, R) [dBm].
        packet: The packet of each value (n, R or 1).
    """
    if not columns:
        return rssi, np.zeros(len(rssi), dtype=bool), []
    start, *left = (parsed(table[name])[0] for name in columns)
    n_relays = start - left[0] if left else start
    relayed = (n_relays > 0)[packet] & ~np.isnan(rssi)
    of_row = np.asarray(relayed.any(axis=1))
    notes = [f"packets that a relay sent are left out: {of_row.sum()} of {len(rssi)}"] if of_row.any() else []
    rssi = np.where(relayed, np.nan, rssi)
    alone: NDArray[np.bool_] = of_row & np.isnan(rssi).all(axis=1)
    return rssi, alone, notes
