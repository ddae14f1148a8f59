"""Reader of captures of CSI tools: a folder with one capture per position, their positions, and a description of the array.

The files are NAME.dat (Linux 802.11n CSI Tool) or NAME.pcap (nexmon_csi), positions.csv and array.yml.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.archives import MAX_UNPACKED_BYTES, Arrays, refusing_broken
from swiftwrf.data.columns import column_of, column_of_numbers, text_of
from swiftwrf.data.csi_tools import ONE_ANTENNA, TOOLS, Channel
from swiftwrf.data.files import read_bytes, read_yaml
from swiftwrf.data.formats.base import SNAPSHOT_FORMATS, Format, ReadOptions
from swiftwrf.data.formats.snapshots import array_of, snapshots_of
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.survey import read_frame
from swiftwrf.errors import InputError, listed, ranges

POSITIONS, DESCRIPTION = "positions.csv", "array.yml"
NEEDED = (
    f"captures need, in their folder, {POSITIONS} (file,x,y,z: a row per capture) and {DESCRIPTION} (array_position, "
    "array_orientation, frequency_hz, and rows, columns and spacing_m or element_position)"
)
GIVEN = ("frequency_hz", "array_position", "array_orientation")
ELEMENTS = ("rows", "columns", "spacing_m", "element_position")
OFFSETS = "phases of the receiver's chains are as measured; they contain constant offsets unless these were corrected"
MAX_PACKETS = 32  # used of each capture, evenly spaced
ESP32_MARK, MARK_BYTES = b"CSI_DATA", 4096  # in the first bytes of its tables


@SNAPSHOT_FORMATS.register("captures")
class Captures(Format[Snapshots]):
    """Packets of a capture and their subcarriers are the snapshots of its position."""

    takes = frozenset({"beamformer", "grid", "every", "round_trip"})

    def recognises(self, path: Path) -> bool:
        return holds_captures(path)

    def read(self, path: Path, options: ReadOptions) -> Snapshots:
        table, described = path / POSITIONS, path / DESCRIPTION
        for file in _captures(path):
            if file.suffix == ".csv":
                raise InputError(f"{file} is a capture of an ESP32, {ONE_ANTENNA}")
        if path.is_file():
            raise InputError(f"{path} is one capture; name its folder: {NEEDED}")
        missing = [file.name for file in (table, described) if not file.is_file()]
        if missing:
            raise InputError(f"{path} lacks {' and '.join(missing)}: {NEEDED}")
        description, frame = _read_description(described), read_frame(table)
        elements = len(array_of(described, description).element)
        files = _files(table, frame)
        channels, left_out = zip(*(_read_capture(file, elements) for file in files), strict=True)
        counts = list(map(len, channels))
        subcarriers = {channel.shape[1] for channel in channels}
        if len(subcarriers) > 1:
            raise InputError(f"{path}: captures have different numbers of subcarriers: {listed(sorted(subcarriers))}")
        packet = np.arange(max(counts))  # repeated in shorter captures, because all rows need one number of snapshots
        csi = np.stack([channel[packet * len(channel) // len(packet)] for channel in channels])
        position = np.stack([_column(table, frame, axis) for axis in "xyz"], axis=1)
        time = {"time": _column(table, frame, "time")} if column_of(frame, "time", {}) else {}
        arrays = description | time | {"csi": csi.reshape(len(files), -1, elements), "position": position}
        notes = [f"packets used of each capture: {ranges(sorted(set(counts)))}", OFFSETS]
        if any(left_out):
            notes.append(f"packets without a channel of all {elements} elements are left out: {sum(left_out)}")
        if unlisted := [file.name for file in _captures(path) if file not in files]:
            notes.append(f"captures without a row in {POSITIONS} are left out: {listed(unlisted)}")
        return snapshots_of(path, arrays, options, [table, described, *files], None, tuple(notes))


def holds_captures(path: Path) -> bool:
    """Return True for a capture, and for a folder with captures or with the description of their array."""
    return (path / DESCRIPTION).is_file() or bool(_captures(path))


def _captures(path: Path) -> list[Path]:
    """Return the captures in a folder, or the file itself if it is one."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return [file for file in files if _is_capture(file)]


def _is_capture(file: Path) -> bool:
    if file.suffix not in (*TOOLS, ".csv") or not file.is_file():
        return False
    with file.open("rb") as stream:
        start = stream.read(MARK_BYTES)
    return TOOLS[file.suffix].recognises(start) if file.suffix in TOOLS else ESP32_MARK in start


def _read_description(file: Path) -> Arrays:
    """Return the arrays of snapshots.npz that describe the array, by name."""
    content = read_yaml(file)
    missing = [name for name in GIVEN if name not in content]
    if missing:
        raise InputError(f"{file} lacks {', '.join(missing)}: {NEEDED}")
    arrays = {}
    for name in (*GIVEN, *ELEMENTS):
        if name in content:
            try:
                arrays[name] = np.array(content[name], dtype=np.float64)
            except (TypeError, ValueError):
                raise InputError(f"{file}: {name} must be a number or lists of numbers of one length") from None
    return arrays


def _files(table: Path, frame: pd.DataFrame) -> list[Path]:
    """Return the captures that a table of positions names.

    Raises:
        InputError: No column of files, a file twice, or one that is missing or of another kind.
    """
    if "file" not in frame.columns:
        raise InputError(f"{table} has no column file; there are {listed(frame.columns)}: {NEEDED}")
    files = [table.parent / name for name in text_of(frame["file"])]
    if len(set(files)) < len(files):
        twice = next(file.name for file in files if files.count(file) > 1)
        raise InputError(f"{table} names {twice} twice; each capture has one position")
    for row, file in enumerate(files, start=1):
        if file.suffix not in TOOLS or not file.is_file():
            kinds = " or ".join(f"{suffix} ({tool.name})" for suffix, tool in TOOLS.items())
            raise InputError(f"{table} row {row} must name a capture beside it, {kinds}, got {file.name!r}")
    return files


def _column(table: Path, frame: pd.DataFrame, role: str) -> NDArray[np.float64]:
    name = column_of(frame, role, {})
    if name is None:
        raise InputError(f"{table} has no column {role}; there are {listed(frame.columns)}: {NEEDED}")
    return column_of_numbers(table, frame, name)


def _read_capture(file: Path, elements: int) -> tuple[Channel, int]:
    """Return channels (packets, subcarriers, K) of evenly spaced packets, and the number of packets without K elements."""
    tool = TOOLS[file.suffix]
    if file.stat().st_size > MAX_UNPACKED_BYTES:
        raise InputError(f"{file} has more than {MAX_UNPACKED_BYTES} bytes; split it")
    with refusing_broken(file, f"a complete capture of {tool.name}"):
        packets, left_out = tool.split(read_bytes(file), elements)
        if not packets:
            raise InputError(
                f"no packet has a channel of the {elements} elements in {DESCRIPTION}; {left_out} have others"
            )
        size = min(len(packets), MAX_PACKETS)
        return np.stack([tool.decode(packets[i * len(packets) // size], elements) for i in range(size)]), left_out
