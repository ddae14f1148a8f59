"""Measurements as lines: reading them as they come, and the answer to each."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import torch

from swiftwrf import FieldModel, InputError, Rssi, Spectra
from swiftwrf.contrib.online import Step
from swiftwrf.data import ReadOptions
from swiftwrf.data.cells import text_of
from swiftwrf.data.columns import column_of
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.files import refusing_unreadable, table_of
from swiftwrf.data.receivers import spelled_as
from swiftwrf.errors import CONTENT_ERRORS
from swiftwrf.metrics import LEVEL
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime.durable import strict
from swiftwrf.runtime.plain import read_json
from tasks.configs import TABLE_SUFFIX

OF_ROWS = (
    "columns",
    "filler",
    "coordinates",
    "scale",
    "y_down",
    "up",
)  # options of reading that a followed table takes
POLL_S = 0.2  # between two looks at a file that grows
CHUNK_BYTES = 2**20
KNOWN_BYTES = 2**16  # before the end of a file that are compared to detect that it was rewritten


class Line(NamedTuple):
    """A line of a followed source."""

    number: int  # from 1
    content: bytes
    header: bytes = b""  # first line of a table; empty for JSON lines
    end: int = 0  # number of bytes of the file up to the end of the line
    sha256: str = ""  # digest of these bytes


def check_source(source: str, model: FieldModel | RssiModel) -> None:
    """Refuse a source that cannot be followed.

    Raises:
        InputError: No file that can be read, no standard input, or a table for a model that predicts no RSSI.
    """
    if source == "-":
        if sys.stdin is None:
            raise InputError("standard input is closed; connect it or give a file")
        return
    with refusing_unreadable(Path(source)), Path(source).open("rb"):
        if source.lower().endswith(TABLE_SUFFIX) and not isinstance(model, RssiModel):
            raise InputError(f"{source} is a table, but the model predicts spectra; give JSON lines")


def lines(source: str, end: int = 0, sha256: str = "") -> Iterator[Line]:
    """Yield the lines of standard input (-), to its end, or of a file, for as long as it may grow.

    A file that was rewritten, truncated or replaced while it is followed is read from its beginning, unless it begins with
    the bytes that were read.

    Args:
        source: Path of the file, or -.
        end: Number of bytes that were read before. Lines after them are yielded if the file begins with these bytes.
        sha256: Digest of these bytes.
    """
    if source == "-":
        yield from (Line(number, line) for number, line in enumerate(sys.stdin.buffer, start=1) if line.strip())
        return
    while True:
        with refusing_unreadable(Path(source)), Path(source).open("rb") as file:
            known = end if _digest(file, end) == sha256 else 0
            header, digest, end = b"", hashlib.sha256(), 0
            for number, line in enumerate(_growing(Path(source), file), start=1):
                digest.update(line)
                if not line.endswith(b"\n") and _begins_alike(source, end + len(line), digest.hexdigest()):
                    break  # the file was saved again while its last line was not whole
                end, sha256 = end + len(line), digest.hexdigest()
                if source.lower().endswith(TABLE_SUFFIX) and not header:
                    header = line.strip() and line
                elif end > known and line.strip():
                    yield Line(number, line, header, end, sha256)


def _begins_alike(source: str, end: int, sha256: str) -> bool:
    """Return whether the first bytes of a file have this digest."""
    with Path(source).open("rb") as file:
        return _digest(file, end) == sha256


def _digest(file: BinaryIO, end: int) -> str:
    """Return the SHA-256 of the first bytes of a file, and go back to its beginning."""
    digest = hashlib.sha256()
    for start in range(0, end, CHUNK_BYTES):
        digest.update(file.read(min(CHUNK_BYTES, end - start)))
    file.seek(0)
    return digest.hexdigest()


def _growing(path: Path, file: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of an open file until it is rewritten, or is read to its end and another file has its path."""
    part, known, is_replaced = b"", b"", False
    while True:
        read = file.readline()
        part += read
        if part.endswith(b"\n") or (is_replaced and part and not read):
            yield part
            known, part = (known + part)[-KNOWN_BYTES:], b""
        elif is_replaced and not read:
            return
        elif not read:
            time.sleep(POLL_S)
            place, last = file.tell(), known + part
            file.seek(0, os.SEEK_END)  # drops what is buffered
            file.seek(max(0, place - len(last)))
            if file.read(len(last)) != last:
                return
            with suppress(FileNotFoundError):  # renamed: it may grow until another file has its name
                is_replaced = not os.path.samestat(path.stat(), os.fstat(file.fileno()))


def measurement(line: Line, options: ReadOptions, model: FieldModel | RssiModel, left_out: set[str]) -> Rssi | Spectra:
    """Return the measurement in a line, of the kind that the model predicts.

    Receivers that the model does not have are added to `left_out`.

    Raises:
        InputError: No row or JSON object, or other values than the model needs.
    """
    needed = "rssi_dbm" if isinstance(model, RssiModel) else "spectrum"
    try:
        text = (line.header + line.content).decode("utf-8-sig")
        index = torch.tensor([line.number - 1 - bool(line.header)])  # as of the rows of the whole file
        if line.header:
            assert isinstance(model, RssiModel)
            return _of_row(text, options, model, left_out).derived(index=index)
        content = read_json(text)
        position, value = [list(map(_number, content["position"]))], content[needed]
        if isinstance(model, RssiModel):
            return _of_receivers(position, value, model, left_out).derived(index=index)
        spectrum = [[list(map(_number, row)) for row in value]]
        return Spectra(spectrum, position, grid=model.grid, index=index, name=f"line {line.number}", **vars(model.link))
    except InputError as error:
        raise InputError(f"line {line.number}: {error}") from None
    except CONTENT_ERRORS as error:
        kind = "row of the table" if line.header else f"JSON object with position and {needed}"
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise InputError(f"line {line.number} is no {kind}: {reason}; mend it") from None


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return float(value)


def _of_row(text: str, options: ReadOptions, model: RssiModel, left_out: set[str]) -> Rssi:
    """Return the measurement in a table of one row."""
    table, offsets = table_of("the table", text), model.offsets
    of_rows = {name: getattr(options, name) for name in OF_ROWS}
    if offsets is not None and offsets.column in table.columns:
        of_rows["offset_by"] = offsets.column
    data = Rssi.from_frame(table, **of_rows)
    rssi = zip(data.receiver_names, data.rssi_dbm[0].tolist(), strict=True)
    floor = column_of(table, "floor", options.columns or {}) if model.attenuation else None
    floors = None if floor is None else Floors((text_of(table[floor])[0],), (0.0,))  # of one name, whatever the height
    row = _of_receivers(data.transmitter_position.tolist(), dict(rssi), model, left_out)
    return replace(row, origin=data.origin, groups=data.groups, floors=floors, time=data.time)


def _of_receivers(
    position: list[list[float]], value: dict[str, float | None], model: RssiModel, left_out: set[str]
) -> Rssi:
    """Return a row at the receivers of the model; those that the line does not name count as not detecting."""
    value = dict(zip(spelled_as(list(value), model.receiver_names)[0], value.values(), strict=True))
    unknown = value.keys() - set(model.receiver_names)
    if unknown and unknown == value.keys():
        raise InputError("no receiver of the model detected the transmitter")
    left_out |= unknown
    row = [value.get(name) for name in model.receiver_names]
    return Rssi(
        [[torch.nan if x is None else _number(x) for x in row]],
        position,
        receiver_names=model.receiver_names,
        origin=model.origin,
        quantity=model.quantity,
        unit=model.unit,
    )


def answer(index: int, new: Rssi | Spectra, before: FieldModel | RssiModel, step: Step) -> str:
    """Return the answer to a line: what was predicted and observed, the interval, and alarms, as JSON in ASCII.

    The index is that of the record, and the model before had not learnt this measurement.
    """
    found: dict[str, Any] = {"measurement": index, "position": step.scores.position[0]}
    if isinstance(new, Rssi):
        assert isinstance(before, RssiModel)
        predicted = before.predict(new.transmitter_position)
        low, high = predicted.interval(LEVEL)
        columns = {"predicted": predicted.mean, "observed": new.rssi_dbm, "low": low, "high": high}
        found |= {
            name: dict(zip(before.receiver_names, [round(x, 2) for x in values[0].tolist()], strict=True))
            for name, values in columns.items()
        }
    else:
        assert isinstance(before, FieldModel)
        mean = before.synthesize(new.position)
        for name, spectrum in (("predicted", mean), ("observed", new.store[:])):
            direction = new.grid.peak_direction(spectrum).rad2deg()[0]
            found[f"{name}_peak_deg"] = [round(x, 1) for x in direction.tolist()]
        found["covered"] = float(step.scores.covered[0])
    found |= {"error": round(float(step.scores.error[0]), 5), "alarm": "; ".join(step.alarms) or None}
    if step.notice:
        found["notice"] = step.notice
    if step.correlation is not None:
        found["correlation"] = step.correlation
    return json.dumps(strict(found), allow_nan=False)
