"""Cells of tables as text, numbers, coordinates and times, in the units and words that people write.

Numbers may have a unit ("-54 dBm", "3.2 m") and a typographic minus. Cells without a value are empty, or contain a word such
as "n/a", "--" or "not detected".
"""

from __future__ import annotations

import re
from contextlib import suppress

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.errors import InputError

Floats = NDArray[np.float64]
MINUS = str.maketrans("\u2212\u2013\u2012\ufe63\uff0d", "-----", "\u00a0\u202f")  # minus signs; narrow spaces
NO_VALUE = re.compile(
    r"[-\u2014.?_*/\s]*|n\.?/?[ad]\.?|nan|null|none|nil|empty|(?:not|no|never|un|out of)[ _-]?"
    r"(?:heard|detected|received|found|seen|available|measured|reachable|visible|signal|data|value|reading|range|service)",
    re.IGNORECASE,
)
UNITS = {  # of numbers in cells and at the end of names, and how many of them a metre or a second has
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres", "s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e2),
    **dict.fromkeys(("mm", "millimeters", "millimetres", "ms", "msec", "millis", "millisecond", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "micros", "microseconds"), 1e6),
    **dict.fromkeys(("ns", "nanos", "nanoseconds"), 1e9),
    **dict.fromkeys(("km",), 1e-3),
    **dict.fromkeys(("ft", "foot", "feet"), 1 / 0.3048),
    **dict.fromkeys(("min", "minutes"), 1 / 60),
}
PIXELS = ("px", "pixel", "pixels")
OTHER_UNITS = ("dbm", "db", "%", "deg", "degrees", "\u00b0")
ANY_UNIT = "|".join(sorted((*UNITS, *PIXELS, *OTHER_UNITS), key=len, reverse=True))
NUMBER = re.compile(rf"([+-]?\s*(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?)\s*({ANY_UNIT}|\u00b0?\s*[nsew])", re.IGNORECASE)
UNIT_AT_THE_END = re.compile(rf"(?<=[a-z0-9])_({ANY_UNIT})$")
EPOCH_UNITS = (  # of times since 1970 by their size, from the year 1973 on
    ("milliseconds", 1e3, 1e11, 1e14),
    ("microseconds", 1e6, 1e14, 1e17),
    ("nanoseconds", 1e9, 1e17, 1e20),
)
DIGITS_OF_DATE = re.compile(
    r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])(?:[01]\d|2[0-3])[0-5]\d[0-5]\d(?:\d{3})?"
)
DAY_FIRST = re.compile(r"\s*(?:\d{1,2}\.\d{1,2}\.|(?:1[3-9]|2\d|3[01])/\d{1,2}/)\d{2,4}\b.*")
DAY_S = 86400.0  # length of a day
DECIMAL_COMMA = re.compile(r"^(\s*[+-]?\d+),(\d+\s*)$")
THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")  # or a number with a decimal comma
DOTTED = re.compile(r"\s*[+-]?\d{1,3}(?:\.\d{3})+(?:,\d+)?\s*")  # 1.000,05
CLOCK_ONLY = re.compile(r"\s*\d{1,2}:\d\d(?::\d\d(?:[.,]\d+)?)?\s*(?:[ap]\.?m\.?)?\s*", re.IGNORECASE)


def plain_name(name: str) -> str:
    """Return the name in lower case with underscores, without its unit: `Position X [m]` becomes position_x.

    Example:
        >>> plain_name("macAddress"), plain_name("Map X (px)"), plain_name("RSSI [dBm]")
        ('mac_address', 'map_x', 'rssi')
    """
    return UNIT_AT_THE_END.sub("", _words(name))


def unit_of(column: pd.Series) -> str:
    """Return the unit of a column, from its name or else from its first cell. Empty without one.

    Example:
        >>> unit_of(pd.Series([1.0], name="Map X (px)")), unit_of(pd.Series(["3 cm"])), unit_of(pd.Series([1.0], name="x"))
        ('px', 'cm', '')
    """
    words = _words(str(column.name))
    if {*PIXELS} & {*words.split("_")}:
        return PIXELS[0]
    in_name = UNIT_AT_THE_END.search(words)
    cells = text_of(column[column.notna()].iloc[:1])
    number = NUMBER.fullmatch(cells.iloc[0].translate(MINUS)) if len(cells) else None
    return in_name[1] if in_name else number[2].lower() if number else ""


def _words(name: str) -> str:
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.replace("dB", "db"))
    return re.sub(r"[^a-z0-9]+", "_", apart.lower()).strip("_")


def text_of(column: pd.Series) -> pd.Series:
    """Return the cells as text, empty for missing ones."""
    return column.astype(object).where(column.notna(), "").astype(str).str.strip()


def parsed(column: pd.Series) -> tuple[Floats, NDArray[np.bool_]]:
    """Return numbers, nan elsewhere, and a mask of cells that hold text.

    Example:
        >>> parsed(pd.Series(["-63 dBm", "−70", "--", "loud"]))
        (array([-63., -70.,  nan,  nan]), array([False, False, False,  True]))
    """
    if column.dtype.kind in "biuf":
        return column.to_numpy(np.float64), np.zeros(len(column), dtype=bool)
    with suppress(ValueError, TypeError):  # numbers alone, the usual case, are parsed fast
        if "_" not in (joined := "".join(column)) and joined.isascii():
            return np.fromiter(map(float, column), np.float64, len(column)), np.zeros(len(column), dtype=bool)
    cells = column.astype(str).str.strip()
    values = pd.to_numeric(cells, errors="coerce").to_numpy(np.float64, copy=True)
    rest = np.isnan(values) & column.notna().to_numpy()
    number_of = {word: _number_in(word) for word in cells[rest].unique()}
    text = rest & cells.isin([word for word, number in number_of.items() if number is None]).to_numpy()
    values[rest & ~text] = cells[rest & ~text].map(number_of).to_numpy(np.float64)
    return values, text


def _number_in(cell: str) -> float | None:
    """Return the number in a cell that has a unit or another minus, nan for a word without a value, None for other text."""
    plain = cell.translate(MINUS).strip()
    if NO_VALUE.fullmatch(plain):
        return float("nan")
    number = NUMBER.fullmatch(plain)
    sign = -1.0 if number and number[2][-1] in "SW" else 1.0  # of 47.4 N, 8.5 W
    value = sign * float(pd.to_numeric(number[1].replace(" ", "") if number else plain, errors="coerce"))
    return None if np.isnan(value) else value


def with_decimal_points(lines: list[list[str]], quoted: bool = False) -> list[list[str]]:
    """Return lines of cells whose decimal commas are points, without the points between thousands (1.000,05).

    Args:
        lines: Cells.
        quoted: The separator of cells is a comma, so that cells with a comma were in quotes. Commas are then decimal only if
            no number has a point, and not all of them may separate thousands.

    Example:
        >>> with_decimal_points([["0,5", "1.000,05", "2.000"]]), with_decimal_points([["1,000", "-60"]], quoted=True)
        ([['0.5', '1000.05', '2000']], [['1,000', '-60']])
    """
    with_comma = [cell for line in lines for cell in line if "," in cell]
    dotted = any(DOTTED.fullmatch(cell) for cell in with_comma)
    if quoted:
        commas = [cell for cell in with_comma if DECIMAL_COMMA.match(cell)]
        if all(THOUSANDS.fullmatch(cell) for cell in commas) and not dotted:
            return lines
        if not dotted and any("." in cell and NUMBER.fullmatch(cell.strip()) for line in lines for cell in line):
            return lines

    def pointed(cell: str) -> str:
        if dotted and DOTTED.fullmatch(cell):
            cell = cell.replace(".", "")
        return DECIMAL_COMMA.sub(r"\1.\2", cell)

    return [[pointed(cell) for cell in line] for line in lines]


def column_of_numbers(source: object, table: pd.DataFrame, name: str) -> Floats:
    """Return a column as numbers, nan where a cell is empty.

    Raises:
        InputError: A cell holds text.
    """
    values, text = parsed(table[name])
    if text.any():
        row = int(text.argmax())
        raise InputError(f"{source} row {row + 1}, column {name}: {table[name].iloc[row]!r} is not a number")
    return values


def seconds(column: pd.Series, date: pd.Series | None = None) -> tuple[Floats, list[str]]:
    """Return times [s] since the first cell, nan where a cell is no time, and a note on their unit.

    Cells are dates, durations, times of the day or numbers [s]. A unit in the name of the column counts. Otherwise, numbers
    as large as milliseconds, microseconds or nanoseconds since 1970 are these, and 14 or 17 digits may be a date
    (20240131120000).

    Args:
        column: Dates, numbers, or times of the day.
        date: Dates, if the cells are times of the day.

    Example:
        >>> seconds(pd.Series(["2024-01-01 10:00:00", "2024-01-01 10:01:00", "noon"], name="time"))
        (array([ 0., 60., nan]), ["cells of column time that hold no time are unknown: 1 of 3, e.g. 'noon'"])
        >>> seconds(pd.Series([1_700_000_000_000, 1_700_000_000_500], name="time"))
        (array([0. , 0.5]), ['column time counts milliseconds since 1970, which are converted to seconds'])
        >>> seconds(pd.Series(["20240131235959", "20240201000000"], name="t"))
        (array([0., 1.]), ['column t holds dates as digits (yyyymmddhhmmss)'])
    """
    notes = []
    text = text_of(column).str.removesuffix(".0")
    filled = text[text != ""]
    if column.dtype.kind == "O":  # text, maybe with a decimal comma, which is no date
        column = text.str.replace(DECIMAL_COMMA, r"\1.\2", regex=True).rename(column.name)
    values = np.full(len(column), np.nan) if column.dtype.kind == "M" else parsed(column)[0]
    if column.dtype.kind == "m":
        values = column.dt.total_seconds().to_numpy(np.float64)
    if len(filled) and filled.str.fullmatch(DIGITS_OF_DATE).all():
        notes.append(f"column {column.name} holds dates as digits (yyyymmddhhmmss)")
        second = pd.to_datetime(text.str[:14], errors="coerce", utc=True, format="%Y%m%d%H%M%S")
        part = pd.to_numeric(text.str[14:], errors="coerce").fillna(0).to_numpy(np.float64)
        values = (second - second.min()).dt.total_seconds().to_numpy(np.float64) + part / 1e3
    elif np.isnan(values).all():
        if date is not None:
            column = text_of(date).str.split().str[0].fillna("") + " " + text
        day_first = bool(text_of(column).str.fullmatch(DAY_FIRST).any())
        when = pd.to_datetime(column, errors="coerce", utc=True, format="mixed", dayfirst=day_first)
        values = (when - when.min()).dt.total_seconds().to_numpy(np.float64)
        back = np.flatnonzero(np.diff(values) < -DAY_S / 2)
        if len(back) == 1 and text_of(column).str.fullmatch(CLOCK_ONLY).all():
            values = values + DAY_S * (np.arange(len(values)) > back[0])
            notes.append(f"times of the day in column {column.name} pass midnight")
    else:
        size = np.nanmedian(values) if np.isfinite(values).any() else 0.0
        unit = unit_of(column)
        for name, factor, low, high in EPOCH_UNITS:
            if low <= size < high:
                values, unit = values / factor, ""
                notes.append(f"column {column.name} counts {name} since 1970, which are converted to seconds")
        if UNITS.get(unit, 1.0) != 1:
            values = values / UNITS[unit]
            notes.append(f"column {column.name} is in {unit}, which is converted to seconds")
    unknown = text[np.isnan(values) & ~text.str.fullmatch(NO_VALUE).to_numpy(bool)]
    if len(unknown):
        count = f"{len(unknown)} of {len(column)}, e.g. {unknown.iloc[0]!r}"
        notes.append(f"cells of column {column.name} that hold no time are unknown: {count}")
    return values - values[0] if len(values) and np.isfinite(values[0]) else values, notes
