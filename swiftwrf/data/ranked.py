"""Ranked lists in tables: numbered columns with names of receivers and their RSSI, e.g. ap1_bssid, ap1_rssi, ap2_bssid."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pandas as pd

from swiftwrf.data.cells import plain_name, text_of
from swiftwrf.data.columns import NO_POWER, has_role, is_rssi

NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")
NAMES = ("name", "id", "address")  # of receivers, as the last word of a numbered column


def from_ranked_lists(table: pd.DataFrame, asked: Mapping[str, str]) -> tuple[pd.DataFrame, int, list[str]]:
    """Return a table with one row a receiver of each list, the number of receivers in a list, and a note.

    A table without lists is returned as it is, with the number 1. Columns of numbered names and of numbered RSSI are lists
    if a name occurs under several numbers. Columns of the same names without a number are the first entry, e.g. the serving
    cell.

    Args:
        table: Columns, names of which may be numbered.
        asked: Columns by role that the user states. Numbered ones among them are no lists.

    Example:
        >>> scan = {"x": [0, 1], "ap1_mac": ["a", "b"], "ap1_rssi": [-50, -52]}
        >>> scan |= {"ap2_mac": ["b", "a"], "ap2_rssi": [-60, -58]}
        >>> from_ranked_lists(pd.DataFrame(scan), {})[0]
           x ap_mac  rssi
        0  0      a   -50
        1  0      b   -60
        2  1      b   -52
        3  1      a   -58
    """
    families: dict[tuple[str, str], dict[int, str]] = {}
    for column in table.columns:
        if match := NUMBERED.fullmatch(column):
            families.setdefault((match[1], match[3]), {})[int(match[2])] = column
    kinds = {stem: _kind("".join(stem), columns, table) for stem, columns in families.items() if len(columns) > 1}
    values = [families[stem] for stem, (role, _) in kinds.items() if role == "rssi"]
    names = [families[stem] for stem, (role, _) in kinds.items() if role == "receiver"]
    lists = next((value for value in values if any(_repeat(table, name, value) for name in names)), None)
    if lists is None or {*asked.values()} & {*lists.values()}:
        return table, 1, []
    entries = {name: families[stem] for stem, (_, name) in kinds.items() if families[stem].keys() >= lists.keys()}
    numbered = {column for columns in entries.values() for column in columns.values()}
    others = [column for column in table.columns if column not in numbered]
    alone = {name: next((c for c in others if _ends_with(c, name)), None) for name in entries}
    roles = {
        role: [name for r, name in kinds.values() if r == role and alone.get(name)] for role in ("receiver", "rssi")
    }
    ranks = sorted(lists)
    rows = [{name: table[columns[rank]] for name, columns in entries.items()} for rank in ranks]
    if all(roles.values()):
        first = {name: table[column] for name, column in alone.items() if column is not None}
        others = [column for column in others if column not in alone.values()]
        rows = [first, *rows]
    rest = table[others].rename(columns={name: f"{name} (without number)" for name in others if name in entries})
    parts = pd.concat([rest.assign(**row) for row in rows], ignore_index=True)
    order = np.arange(len(parts)).reshape(len(rows), len(table)).T.ravel()
    note = (
        f"numbered columns are lists of receivers: {', '.join(entries)} of {len(rows)} in a row, e.g. "
        f"{', '.join(columns[ranks[0]] for columns in entries.values())}"
    )
    return parts.iloc[order].reset_index(drop=True), len(rows), [note]


def _ends_with(column: str, name: str) -> bool:
    plain = plain_name(column)
    return plain == name or plain.endswith(f"_{name}")


def _kind(stem: str, columns: Mapping[int, str], table: pd.DataFrame) -> tuple[str, str]:
    """Return the role of numbered columns, rssi, receiver or none, and the name without the words of the list."""
    words = plain_name(stem).split("_")
    tails = ["_".join(words[start:]) for start in range(len(words))]
    if tail := next((t for t in tails if has_role(t, "rssi") and not NO_POWER.fullmatch(t)), ""):
        return ("rssi" if all(is_rssi(table[column]) for column in columns.values()) else ""), tail
    tail = next((t for t in tails if has_role(t, "receiver") or t in NAMES), "")
    return ("receiver" if tail else ""), "receiver" if tail in NAMES else tail or words[-1]


def _repeat(table: pd.DataFrame, names: Mapping[int, str], values: Mapping[int, str]) -> bool:
    """Return True if each numbered value has a name, some of which occur under several numbers."""
    if not names.keys() >= values.keys():
        return False
    each = [{*text_of(table[names[number]])} - {""} for number in values]
    return sum(map(len, each)) > len(set.union(*each))
