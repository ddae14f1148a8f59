"""Columns of tables and what they hold: roles by names first, by kinship of names second, by values last."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd

from swiftwrf.data.cells import parsed, plain_name, text_of
from swiftwrf.data.powers import KNOWN_FILLERS, MIN_RSSI_DBM
from swiftwrf.data.radios import unknown_ids
from swiftwrf.errors import InputError, listed

PLACE = (
    "pos|position|coord|coordinate|loc|location|tx|rx|transmitter|receiver|map|plan|floorplan|image|point|pixels?|px|local|robot|ue|"
    "true|truth|gt|field|pose"
)
MEAN = "(?:(?:mean|avg|average|median|max|raw|filtered|wifi|wlan|ble|bt|lora|lte|nr|ss|serving|measured)_?)*"
GPS, GPS_END = "(?:(?:gps|gnss|current|location|device|phone|best|tri)_?)?", "(?:_?(?:1?e7|dd|wgs_?84|nmea))?"
CELL_ID = "(?:global_?)?cell_?id|cid|eci|cgi|pci"
ROLES = {  # patterns of names in lower case with underscores and without units, the first ones preferred
    "x": [f"(?:(?:{PLACE})_?)*x(?:_?(?:{PLACE}))*|east(?:ing)?s?|e_?coord"],
    "y": [f"(?:(?:{PLACE})_?)*y(?:_?(?:{PLACE}))*|north(?:ing)?s?|n_?coord"],
    "z": [f"(?:(?:{PLACE})_?)*z(?:_?(?:{PLACE}))*", "height", f"{GPS}(?:alt|altitude|ele|elevation)"],
    "longitude": [f"{GPS}(?:lon|lng|long|longitude){GPS_END}"],
    "latitude": [f"{GPS}(?:lat|latitude){GPS_END}"],
    "floor": ["floor(?:_?(?:id|name|number|no|level))?|storey|etage|stockwerk"],
    "time": [
        "time_?stamp|date_?time|unix(?:_?time)?|epoch(?:_?time)?|(?:gps|utc|local|phone|device|system|event|scan|measured|received)_?time",
        "time|when|t|ts|elapsed(?:_?time)?|uptime",
        "date",
        "(?:first|last)_?seen|(?:received|measured|recorded|created|logged|reported)_?at",
    ],
    "session": ["(?:session|run|walk)(?:_?id)?"],
    "receiver": [
        "receiver(?:_?(?:name|id))?|rx(?:_?(?:name|id))?",
        "(?:gateway|gw|gtw)(?:_?(?:name|id|eui))?",
        "(?:(?:ap|wifi|wlan|ble|bt|beacon|router|station)_?)?(?:bssid|mac(?:_?addr(?:ess)?)?)(?:_of_ap)?",
        "(?:ap|access_?point)(?:_?(?:id|name|mac|address))?",
        "(?:anchor|sensor|node|station|beacon|tag_?reader|reader)(?:_?(?:id|name|mac|address))?|eui|(?:ble_?)?address",
        CELL_ID,
        "(?:wifi_?)?e?ssid",
    ],
    "rssi": [
        f"{MEAN}rsrp",
        f"(?:rx_)?{MEAN}rssi?(?:_?(?:value|mean|avg|average|median|raw))*",
        f"{MEAN}(?:rscp|rxlev|rx_?lev(?:el)?|rx_?power|received_?power|dbm)",
        f"{MEAN}(?:received_)?signal(?:_?(?:strength|level|power|dbm))?",
        f"{MEAN}(?:power|strength|level)(?:_?dbm)?",
    ],
}
NO_POWER = re.compile(  # quantities beside received power that may be negative, as the last words of a name
    r"(?:.*_)?(?:"
    r"rsrq|rsr_q|r?ss?nr|sinr|l?snr|esnr|ec_?[in]?o|cqi|qual|quality|noise(?:_?(?:floor|level|power))?|nf|offset|path_?loss|error|gain"
    r"|tx_?p\w*|transmit\w*_power|power_?tx|eirp|erp|measured_power|ref\w*_power"
    r"|(?:mag|magnet\w*|geomag\w*|acc|accel\w*|gyro\w*|grav\w*|ori|orient\w*|rot|rotation\w*|imu|odom\w*)_?[xyzw]?\d?"
    r"|(?:b|m|q|v|vel|velocity|speed|est|estimated?|pred|predicted|hat|slam|vio|ekf|euler|angle)_?[xyzw]"
    r"|(?:x|y|z|lat|lon|lng|latitude|longitude|alt)_?(?:est|estimated?|pred|predicted|hat|odom|imu|slam|vio|ekf|mag|acc|gyro)"
    r"|roll|pitch|yaw|heading|azimuth|bearing|course|tilt|speed|velocity|temp|temperature\w*"
    r")(?:_(?:mean|avg|std|serving|\d+))*"
)
GROUPS_OF_ROWS = re.compile(  # columns that distinguish rows, but not the receivers
    r"(?:.*_)?(device|phone|user|model|brand|person|operator|mode|weather|channel|ch|freq\w*|band|sf|data_?rate|modulation|bw"
    r"|bandwidth|codr|(?P<place>building\w*|room|zone|area|space\w*|site|place|location|point)|snapshot|direction|orientation|date|day"
    r"|time\w*|type|security|auth_?mode|capabilities|vendor|manufacturer|provider|experiment\w*|trial|comment|notes?|version|os"
    r"|app\w*|sample\w*|index|idx|row|count\w*|seq\w*|packet\w*|frame\w*|node_?addr\w*|dev_?(?:eui|addr))"
    r"(?:_?(?:id|name|no|number))?"
)
MARKS = {"tx": "transmitter", "transmitter": "transmitter", "rx": "receiver", "receiver": "receiver"}  # words in names
TRANSMITTED = re.compile(r"(?:.*_)?(?:tx_?(?:power|pwr|pow)\w*|transmit\w*_power|power_?tx|eirp|erp)")
SNR = re.compile(r"(?:.*_)?[le]?snr(?:_(?:mean|avg|median))?")
ACCURACY = re.compile(
    rf"(?:{GPS}|h_?|horizontal_?|position_?|fix_?)(?:accuracy|uncertainty|[hp]?dop)(?:_?(?:m|met(?:er|re)s))?"
)
HOPS = re.compile(r"(?:n_?)?hops(?:_?(?:away|taken|count))?|hop_?count")  # of packets in a mesh
GEODETIC = {"x": "longitude", "y": "latitude"}  # that take the place of x and y


def column_of(table: pd.DataFrame, role: str, columns: Mapping[str, str]) -> str | None:
    """Return the column of a role: the one that `columns` names, or else the first with a known name. None without one."""
    return columns[role] if role in columns else next(iter(candidates(table, role)), None)


def candidates(table: pd.DataFrame, role: str) -> list[str]:
    """Return the columns whose names are of a role, the most specific name first.

    A column of powers does not hold names of receivers.
    """
    plain = {name: plain_name(name) for name in map(str, table.columns)}
    matches = [name for pattern in ROLES[role] for name in plain if re.fullmatch(pattern, plain[name])]
    if role == "receiver":
        return [name for name in matches if not is_rssi(table[name])]
    return [name for name in matches if not NO_POWER.fullmatch(plain[name])]


def find_roles(
    source: object, table: pd.DataFrame, asked: Mapping[str, str], taken: Collection[str] = ()
) -> dict[str, str]:
    """Return the column of each role: the one asked for, or else the first one with a known name that is not taken.

    Raises:
        InputError: A column that is missing, no or several columns for x or y, or receivers without RSSI.
    """
    for role, name in asked.items():
        if role not in ROLES:
            raise InputError(f"columns takes {', '.join(ROLES)}, got {role!r}")
        if name not in table.columns and not (role == "rssi" and fnmatch.filter(table.columns, name)):
            raise InputError(f"{source} has no column {name!r} for {role}; there are {listed(table.columns)}")
    roles = {role: name for role, name in asked.items() if name in table.columns}
    for role in ROLES:
        matches = [name for name in candidates(table, role) if name not in (*roles.values(), *taken)]
        if role == "rssi":  # e.g. not a level that is a floor
            matches = [name for name in matches if not parsed(table[name])[1].all()]
        if role in asked or not matches:
            continue
        if len(matches) > 1 and role in (*GEODETIC, *GEODETIC.values()):
            raise InputError(
                f"{source} has {len(matches)} columns that may be {role} ({listed(matches)}); choose one with columns "
                f"{role}=NAME"
            )
        roles[role] = matches[0] if role != "receiver" else _with_known_ids(table, matches)
    for role, other in GEODETIC.items():
        if other in roles and role in roles:
            del roles[other]
        if role not in roles and other not in roles:
            raise InputError(
                f"{source} has no column for {role}; there are {listed(table.columns)}; choose one with columns {role}=NAME"
            )
    name = roles.get("receiver", "")
    if "receiver" not in asked and re.fullmatch(CELL_ID, plain_name(name)) and table[name].nunique() == 1:
        del roles["receiver"]  # the log of one cell
    others = [name for name in table.columns if name not in roles.values()]
    if "receiver" in roles and "rssi" not in roles:
        if "receiver" in asked or len(receiver_columns(table, others)[0]) < 2:
            raise InputError(
                f"{source} has receivers in column {roles['receiver']!r}, but no RSSI beside; name it with columns "
                "rssi=NAME, or map another quantity, e.g. the SNR: quantity and unit"
            )
        del roles["receiver"]  # which distinguishes rows of a wide table
    return roles


def relay_columns(table: pd.DataFrame) -> list[str]:
    """Return the column with the number of relays of each packet, or those of hops left at the start and the end."""
    plain = {plain_name(name): name for name in table.columns}
    counted = [name for word, name in plain.items() if HOPS.fullmatch(word)]
    return counted[:1] or (
        [plain["hop_start"], plain["hop_limit"]] if {"hop_start", "hop_limit"} <= plain.keys() else []
    )


def labels_of(
    table: pd.DataFrame, names: Sequence[str], receiver: str | None, max_values: int = 30, min_rows: int = 10
) -> tuple[str, ...]:
    """Return columns with few different values, each in several rows, that are no names of receivers. Not studied."""
    if receiver is not None:
        several = table.groupby(receiver)[list(names)].nunique().max() > 1
        names = [name for name in names if several[name]]
    counts = {name: text_of(table[name]).value_counts() for name in names}
    return tuple(name for name, n in counts.items() if 2 <= len(n) <= max_values and int(n.min()) >= min_rows)


def column_of_quantity(source: object, table: pd.DataFrame, quantity: str) -> str:
    """Return the only column of numbers whose name contains a quantity, or else begins with its first word.

    Raises:
        InputError: None or several of them.

    Example:
        >>> column_of_quantity("a.csv", pd.DataFrame({"x": [1.0], "latency_ms": [3.0]}), "latency")
        'latency_ms'
    """
    plain = plain_name(quantity)
    found = [
        n for n in table.columns if plain in plain_name(n) and not is_coordinate(n) and not parsed(table[n])[1].all()
    ]
    if len(found) != 1:
        raise InputError(
            f"{source} has {len(found)} columns that are named {quantity}; choose one with columns rssi=NAME; there are "
            f"{listed(table.columns)}"
        )
    return str(found[0])


def _with_known_ids(table: pd.DataFrame, names: Sequence[str], max_unknown: float = 0.1) -> str:
    """Return the first column of ids with few unknown ones, e.g. the PCI if neighbours lack the cell id (not studied)."""
    unknown = {name: ((text_of(table[name]) == "") | unknown_ids(table[name])).mean() for name in names}
    return next((name for name in names if unknown[name] <= max_unknown), min(names, key=lambda name: unknown[name]))


def receiver_columns(
    table: pd.DataFrame,
    names: Sequence[str],
    min_rows: int = 5,
    max_median_dbm: float = -25.0,
    max_positive: float = 0.02,
    min_family: float = 0.6,
) -> tuple[list[str], list[str], list[str]]:
    """Return those columns that hold the RSSI of receivers, others that look like it, and notes on these.

    Names of other quantities are left out. Of several columns whose names are nothing but received power, the most specific
    one counts. Other columns must be akin to columns of received power, by their names or by their values.

    Args:
        table: Columns of receivers and others.
        names: Columns that may hold RSSI.
        min_rows: Values are compared from this number of rows on. The bounds are not studied.
        max_median_dbm: Largest median of a column that is a received power by its values alone.
        max_positive: Fraction of positive values in such a column, at most.
        min_family: Fraction of the receivers with names of one kind, from which on others are reported.

    Example:
        >>> table = pd.DataFrame({"AP1": [-60] * 9, "AP2": [-70] * 9, "SNR": [-3] * 9, "drift": [-20.5] * 9})
        >>> receiver_columns(table, list(table))[0]
        ['AP1', 'AP2']
    """
    receivers = [name for name in names if is_rssi(table[name]) and not is_coordinate(name)]
    plain = {name: plain_name(name) for name in receivers}
    others = [name for name in receivers if NO_POWER.fullmatch(plain[name])]
    bare = [name for name in candidates(table, "rssi") if name in receivers]
    weaker = bare[1:]
    receivers = [name for name in receivers if name not in (*others, *weaker)]
    values = {name: parsed(table[name])[0] for name in receivers}
    powers = {name: v[np.isfinite(v) & ~np.isin(v, KNOWN_FILLERS)] for name, v in values.items()}
    usual = {
        name: not len(p) or (np.median(p) <= max_median_dbm and (p > 0).mean() < max_positive)
        for name, p in powers.items()
    }
    plausible = [name for name in receivers if usual[name]] or receivers
    of_integers = [name for name in plausible if (powers[name] % 1 == 0).all()]
    reference = of_integers if len(of_integers) > 1 or set(of_integers) & set(bare) else plausible
    if len(table) < min_rows:  # e.g. one of a stream
        reference = receivers
    kin = {_kinship(plain[name]) for name in reference}
    doubtful = [name for name in receivers if name not in reference and _kinship(plain[name]) not in kin]
    notes = []
    if others or weaker:
        notes.append(f"columns of other quantities than the received power are left out: {listed([*others, *weaker])}")
    if doubtful:
        notes.append(
            f"columns are left out whose values are unlike those of {listed(reference[:3])}: {listed(doubtful)}; if "
            "they are receivers, give --columns rssi=PATTERN"
        )
    receivers = [name for name in receivers if name not in doubtful]
    families = pd.Series([_kinship(plain[name]) for name in receivers], dtype=object)
    sizes = families.value_counts()
    if len(sizes) > 1 and sizes.iloc[0] >= max(3, min_family * len(receivers)):
        odd = [name for name, family in zip(receivers, families, strict=True) if family != sizes.index[0]]
        notes.append(f"columns count as receivers though they are named unlike the others: {listed(odd)}")
    return receivers, [*others, *weaker, *doubtful], notes


def _kinship(name: str) -> str:
    """Return the kind of a name: "address" for a MAC address, otherwise its first word without digits."""
    if re.fullmatch(r"(?:[0-9a-f]{2}_?){5}[0-9a-f]{2}", name):
        return "address"
    return re.split(r"[_\d]", name, maxsplit=1)[0] or "number"


def check_receiver_known(
    source: object,
    table: pd.DataFrame,
    rssi: str,
    others: Sequence[str],
    place: Sequence[str],
    min_repeats: float = 3.0,
    min_text: float = 0.9,
    min_together: float = 0.3,
    min_different: float = 0.8,
    min_changes: float = 0.5,
) -> None:
    """Refuse a table with one column of RSSI beside names that may be those of its receivers.

    Such names repeat in one of the other columns, each in `min_repeats` rows on average. Several of them occur at one place
    and time, or they alternate from row to row. All other bounds are fractions of rows. None of them was studied.

    Raises:
        InputError: The question whether the column contains the receivers.
    """
    timed = len(place) > 2
    together = table.groupby([text_of(table[name]) for name in place], sort=False).ngroup()
    several = together.groupby(together).transform("size") > 1
    for name in others:
        cell = text_of(table[name])
        values, is_text = parsed(table[name])
        count = cell.value_counts()
        if not 2 <= len(count) <= len(cell) / min_repeats or "" in count.index:
            continue
        is_name = is_text.mean() > min_text or bool((values % 1 == 0).all())
        apart = ~pd.DataFrame({"row": together, "cell": cell}).duplicated(keep=False)
        is_packet = several.mean() > min_together and apart[several].mean() > min_different
        alternates = is_text.all() and not several.any() and (cell != cell.shift()).mean() > min_changes
        if group := GROUPS_OF_ROWS.fullmatch(plain_name(name)):
            # a transmitter is in one room at a time, but a receiver may detect several devices at one place
            may_be_receiver = bool(group["place"]) or (timed and group[1] == "device")
            if not (is_packet and may_be_receiver):
                continue
        if is_name and (is_packet or alternates):
            raise InputError(
                f"{source}: is {name!r} the receiver of each row? Then give --columns receiver={name}, or --columns "
                f"rssi={rssi} if all rows are of one receiver"
            )


def columns_of_end(source: object, table: pd.DataFrame, given: Sequence[str]) -> dict[str, str]:
    """Return the columns of the second end by x, y and z; none in a table with positions of one end.

    They are the given ones. Otherwise they are those marked tx or transmitter beside others, or those marked rx or receiver
    beside unmarked ones.
    """
    if given:
        missing = [name for name in given if name not in table.columns]
        if missing or len(given) not in (2, 3) or len(set(given)) < len(given):
            raise InputError(
                f"{source}: transmitter takes the columns of x, y and, if it is known, z, or one column of names, got "
                f"{' '.join(given)}; there are {listed(table.columns)}"
            )
        return dict(zip("xyz", given, strict=False))

    def end_of(name: str) -> str:
        return next((MARKS[word] for word in plain_name(name).split("_") if word in MARKS), "")

    marked = {axis: {end_of(name): name for name in reversed(candidates(table, axis))} for axis in "xyz"}
    for mark, others in (("transmitter", {"receiver", ""}), ("receiver", {""})):
        if all(mark in marked[axis] and others & marked[axis].keys() for axis in "xy"):
            return {axis: names[mark] for axis, names in marked.items() if mark in names}
    return {}


def is_rssi(column: pd.Series) -> bool:
    """Return True if most cells are received powers or fillers, whatever the number of these."""
    values, text = parsed(column)
    known = np.unique(values[~np.isnan(values)])
    if not len(known) or (text.sum() > np.isfinite(values).sum() and column[text].nunique() > 1):
        return False
    power = known[~np.isin(known, KNOWN_FILLERS) & np.isfinite(known)]
    if not len(power):
        return bool((known != 0).any())
    below = power[power < 0]
    mostly_below = len(power) - len(below) <= 1 or np.median(power) < 0
    return bool(mostly_below and len(below) and np.median(below) >= MIN_RSSI_DBM)


def has_role(name: str, *roles: str) -> bool:
    """Return True for the name of a column of one of these roles."""
    return any(re.fullmatch(pattern, plain_name(name)) for role in roles for pattern in ROLES[role])


def is_coordinate(name: str) -> bool:
    """Return True for the name of a column with a coordinate."""
    return has_role(name, *GEODETIC, "z", *GEODETIC.values())
