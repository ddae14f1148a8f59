"""Tables in documents: lists of records anywhere in JSON, and the points of GPX and KML, by the names in them.

Objects and elements inside a record are flattened. Records inside a record, e.g. the access points of a scan, become rows
of their own, with the values of the record around them. A record without records inside, e.g. an empty scan, is one row.
"""

from __future__ import annotations

import json
import re
from collections import ChainMap, Counter
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from swiftwrf.data.archives import refusing_broken
from swiftwrf.data.cells import plain_name
from swiftwrf.data.columns import GEODETIC, PLACE, column_of, has_role, is_coordinate, receiver_columns
from swiftwrf.errors import InputError, listed
from swiftwrf.runtime.plain import read_json

XML = (".gpx", ".kml")
POINTS = ("wpt", "rtept", "trkpt", "Placemark")  # elements of GPX and KML
VIEWS = ("LookAt", "Camera")  # of KML, which hold the position of the viewer
NAMED = ("Data", "SimpleData")  # of KML, whose name is an attribute
AXES = ("longitude", "latitude", "altitude")  # of coordinates in GeoJSON and KML
POSITION = re.compile(f"(?:(?:{PLACE}|xyz?|coordinates|at|where)_?)+")  # names of lists that hold x, y and z
MAX_CELLS, MIN_CELLS = 2**26, 2**22  # that are read of any document, and of a short one
MAX_LISTS, MAX_DEPTH, MAX_NAMES = 1000, 50, 2**14  # lists and levels of a document, values of a record
HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")  # in JSON, where the other half may be missing
Keys = tuple[str, ...]  # keys that lead to a value or a list
Row = ChainMap[Keys, Any]  # values of a record, then those of each record around it, which the rows inside share
Record = tuple[Keys, Row, dict[Keys, Any]]  # where a record is, its values with those around it, and the lists in it


def table_in_document(source: object, text: str, suffix: str) -> pd.DataFrame:
    """Return the records of a document as a table, whose cells are text. The source stands for it in messages.

    Of several lists, it is the one with positions and RSSI, the outermost first.

    Args:
        source: Name of the document.
        text: Its content.
        suffix: Its kind, one of `swiftwrf.data.files.DOCUMENTS`.

    Raises:
        InputError: A document that is broken or holds no records.

    Example:
        >>> text = '{"points": [{"x": 1, "y": 2, "scan": [{"bssid": "a", "rssi": -60}, {"bssid": "b", "rssi": -70}]}]}'
        >>> table_in_document("walk.json", text, ".json").to_numpy().tolist()
        [['1', '2', 'a', '-60'], ['1', '2', 'b', '-70']]
    """
    records: list[Record] = []
    with refusing_broken(source, f"a complete {suffix.lstrip('.').upper()} document"):
        content = _points(text) if suffix in XML else read_json(text)
        if HALF_CHARACTER.search(text):
            json.dumps(content, ensure_ascii=False).encode()  # raises an error for half a character
        _collect(content, (), ChainMap(), records)
    if not records:
        raise InputError(f"{source} holds no records with names, e.g. points with positions and RSSI")
    rows: dict[Keys, list[Row]] = {}
    for where, row, _ in records:
        rows.setdefault(where, []).append(row)
    if len(rows) > MAX_LISTS:
        raise InputError(f"{source} has lists of records under {len(rows)} names; at most {MAX_LISTS} are read")
    # values around many records make a table far larger than the document
    most = min(MAX_CELLS, max(MIN_CELLS, len(text)))
    tables = {where: _table(source, found, most) for where, found in rows.items()}
    path = max(tables, key=lambda path: (_n_known(tables[path]), -len(path), len(tables[path])))
    table = _table(source, [row for at, row, lists in records if at == path or _is_empty(at, lists, path)], most)
    table.attrs["notes"] = [f"rows are the records in {' > '.join(path)}"] if path else []
    others = {
        " > ".join(where) for *_, lists in records for where, items in lists.items() if items and where not in rows
    }
    if others:
        table.attrs["notes"].append(
            f"lists that hold no records, position or RSSI are left out: {listed(sorted(others))}"
        )
    return table


def _is_empty(at: Keys, lists: dict[Keys, Any], path: Keys) -> bool:
    """Return True for a record around those of a path that holds none of them, e.g. a place with an empty scan."""
    return at == path[: len(at)] and not any(items and where == path[: len(where)] for where, items in lists.items())


def _collect(node: Any, path: Keys, around: Row, records: list[Record]) -> None:
    """Add a record or a list of them, with the values around it; then the records inside it."""
    if len(path) > MAX_DEPTH:
        raise ValueError(f"it nests records more than {MAX_DEPTH} deep")
    if isinstance(node, list):
        for item in node:
            _collect(item, path, around, records)
    elif isinstance(node, dict):
        row, lists = around.new_child(), dict[Keys, Any]()
        _flatten(node, path, row, lists)
        records.append((path, row, lists))
        for where, inside in lists.items():
            _collect(inside, where, row, records)


def _flatten(node: dict[str, Any], path: Keys, row: Row, lists: dict[Keys, Any]) -> None:
    """Add the values of an object to a row, and its lists to others, except those of numbers that have a known name.

    Numbers are x, y and z in a list with the name of a position, and NAME_1, NAME_2, ... in one with the name of RSSI.
    """
    for key, value in node.items():
        where = (*path, key)
        if isinstance(value, dict) and value and all(map(_is_scan, value.values())):  # by name of the receiver
            lists[where] = [{"receiver": name, **scan} for name, scan in value.items()]
        elif isinstance(value, dict):
            _flatten(value, where, row, lists)
        elif not isinstance(value, list):
            row[where] = value
        elif any(not isinstance(item, int | float | None) for item in value):
            lists[where] = value
        elif len(value) in (2, 3) and POSITION.fullmatch(plain_name(key)):
            axes = AXES if key == "coordinates" else "xyz"
            row.update({(*where, axis): item for axis, item in zip(axes, value, strict=False)})
        elif has_role(key, "rssi"):
            row.update({(*path, f"{key}_{number}"): item for number, item in enumerate(value, start=1)})
        else:
            lists[where] = value


def _is_scan(value: Any) -> bool:
    """Return True for an object with RSSI that does not name its receiver."""
    return (
        isinstance(value, dict)
        and any(has_role(key, "rssi") for key in value)
        and not any(has_role(key, "receiver") for key in value)
    )


def _table(source: object, rows: list[Row], most: int) -> pd.DataFrame:
    """Return rows as a table. Columns have the last key, or all keys where several have one last key."""
    parts = {id(part): part for row in rows for part in reversed(row.maps)}
    paths = list(dict.fromkeys(path for part in parts.values() for path in part))
    if len(paths) > MAX_NAMES or len(rows) * len(paths) > most:
        raise InputError(
            f"{source} has {len(rows)} records of {len(paths)} values; at most {most} cells and {MAX_NAMES} values of a "
            "record are read"
        )
    text = {key: {path: "" if x is None else str(x) for path, x in part.items()} for key, part in parts.items()}
    count = Counter(path[-1] for path in paths)
    names = [path[-1] if count[path[-1]] == 1 else "_".join(path) for path in paths]
    cells = []
    for row in rows:
        whole: dict[Keys, str] = {}
        for part in reversed(row.maps):
            whole |= text[id(part)]
        cells.append([whole.get(path, "") for path in paths])
    return pd.DataFrame(cells, columns=names, dtype=object)


def _n_known(table: pd.DataFrame) -> int:
    """Return 2 for a table with positions and RSSI, 1 for one of them."""
    if not table.columns.is_unique:
        return 0
    placed = all(column_of(table, axis, {}) or column_of(table, other, {}) for axis, other in GEODETIC.items())
    return placed + bool(receiver_columns(table, [name for name in table if not is_coordinate(name)])[0])


def _points(text: str) -> list[dict[str, Any]]:
    """Return the points of GPX or KML as JSON would hold them."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares entities, which are not read")
    return [_tree(element) for element in ElementTree.fromstring(text).iter() if _tag(element.tag) in POINTS]


def _tree(element: ElementTree.Element) -> dict[str, Any]:
    """Return attributes and children of an element by name, lists of those with one name."""
    found: dict[str, list[Any]] = {_tag(name): [value] for name, value in element.attrib.items()}
    for child in element:
        tag = _tag(child.tag)
        value = "".join(child.itertext() if tag in NAMED else child.text or "").strip()
        content: Any = value or _tree(child)
        if tag == "coordinates" and len(value.split()) == 1:  # of a point, and no line
            content = dict(zip(AXES, map(float, value.split(",")), strict=False))
        if tag not in VIEWS:
            found.setdefault(child.get("name", tag) if tag in NAMED else tag, []).append(content)
    return {name: values[0] if len(values) == 1 else values for name, values in found.items()}


def _tag(name: str) -> str:
    return name.rpartition("}")[2]
