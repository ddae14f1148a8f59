"""Reader of captures of CSI tools: a folder with one capture per position, their positions, and a description of the array.

| file | content |
|---|---|
| `NAME.dat` | Linux 802.11n CSI Tool (Intel 5300). Elements are the ports A, B, C, in any order of the receiver's chains |
| `NAME.pcap` | nexmon_csi of a 4358 or 4366c0 (Nexus 6P, RT-AC86U), 20 to 80 MHz. Elements are the cores 0, 1, ... |
| `positions.csv` | columns `file`, `x`, `y`, `z` [m], optionally `time` [s]: a row per capture |
| `array.yml` | `frequency_hz`, `array_position`, `array_orientation`; `rows`, `columns`, `spacing_m` or `element_position` |

Snapshots of a position are the subcarriers of at most 32 packets, evenly spaced in the capture. Null, guard and DC
subcarriers are left out. The first transmitted stream is used. Packets of other numbers of antennas are left out and
counted. Nexmon scales each core separately, so use the beamformer `phase`. Correct constant phase offsets of the chains,
e.g. by a capture over equal cables: a calibration from positions needs a planar array. Captures with one antenna (ESP32,
Raspberry Pi) are refused. PicoScenes is not read: write its channels as array snapshots.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.archives import MAX_UNPACKED_BYTES, refusing_broken
from swiftwrf.data.cells import column_of_numbers, text_of
from swiftwrf.data.columns import column_of
from swiftwrf.data.files import read_bytes, read_table, read_yaml
from swiftwrf.data.formats.array_description import array_of, described_arrays
from swiftwrf.data.formats.base import Format, ReadOptions
from swiftwrf.data.formats.snapshots import snapshots_of
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.errors import InputError, listed, optional_module, ranges

POSITIONS, DESCRIPTION = "positions.csv", "array.yml"
NEEDED = (
    f"captures need, in their folder, {POSITIONS} (file,x,y,z: a row per capture) and {DESCRIPTION} (array_position, "
    "array_orientation, frequency_hz, and rows, columns and spacing_m or element_position)"
)
GIVEN = ("frequency_hz", "array_position")
OFFSETS = "phases of the receiver's chains are as measured; they contain constant offsets unless these were corrected"
MAX_PACKETS = 32  # used of each capture, evenly spaced
Channel = NDArray[np.complex128]
ONE_ANTENNA = "which has one antenna and receives no direction"

BFEE_HEADER_BYTES = 21  # code included
BFEE_ANTENNAS = 3

PCAP_ORDERS: dict[bytes, Literal["little", "big"]] = dict.fromkeys((b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1"), "little")
PCAP_ORDERS |= dict.fromkeys((b"\xa1\xb2\xc3\xd4", b"\xa1\xb2\x3c\x4d"), "big")
PCAP_HEADER_BYTES, RECORD_HEADER_BYTES, UDP_HEADER_BYTES = 24, 16, 42  # the last with those of Ethernet and IP
NEXMON_MARK, NEXMON_HEADER_BYTES = b"\x11\x11", 18
NEXMON_CHIPS = {3: "4358", 0xDEAD: "4358", 106: "4366c0"}  # 0xDEAD in captures of earlier versions
NEXMON_USED = {64: (1, 28), 128: (2, 58), 256: (2, 122)}  # size of the FFT: first and last subcarrier beside DC


class Tool(NamedTuple):
    """Captures of one tool: recognition and decoding."""

    name: str
    recognises: Callable[[bytes], bool]
    """whether the first bytes of a file are of such a capture"""
    split: Callable[[bytes, int], tuple[list[bytes], int]]
    """packets of that many antennas in a capture, and the number of others; refuses damaged captures by ValueError"""
    decode: Callable[[bytes, int], Channel]
    """channel (subcarriers, K) of a packet"""
    sender: Callable[[bytes], str] = lambda packet: ""
    """hardware address of the sender of a packet, empty where captures have none"""


def _split_csitool(content: bytes, elements: int) -> tuple[list[bytes], int]:
    packets, left_out, start = [], 0, 0
    while start < len(content):
        size = int.from_bytes(content[start : start + 2], "big")
        frame = content[start + 2 : start + 2 + size]
        if not 0 < size == len(frame):
            raise ValueError(f"the frame at byte {start} is cut off")
        if frame[0] == 0xBB:  # CSI; other frames are skipped
            n_receive, n_transmit = frame[9:11] if size > BFEE_HEADER_BYTES else (0, 0)
            expected = (30 * (16 * n_receive * n_transmit + 3) + 7) // 8
            if not (
                1 <= n_receive <= BFEE_ANTENNAS
                and 1 <= n_transmit <= BFEE_ANTENNAS
                and int.from_bytes(frame[17:19], "little") == expected == size - BFEE_HEADER_BYTES
            ):
                raise ValueError(f"the frame at byte {start} does not have the size of its antennas")
            port = [frame[16] >> shift & 3 for shift in (0, 2, 4)][:n_receive]  # of each chain
            if n_receive == elements and sorted(port) == list(range(elements)):
                packets.append(frame)
            else:
                left_out += 1
        start += 2 + size
    return packets, left_out


def _decode_csitool(packet: bytes, elements: int) -> Channel:
    """Return the channel of the first transmitted stream. Elements are the ports A, B, C."""
    capture = _csiread().Intel(None, nrxnum=BFEE_ANTENNAS, ntxnum=BFEE_ANTENNAS, if_report=False)
    capture.pmsg(packet)
    channel: Channel = capture.csi[0, :, :elements, 0].copy()
    return channel


def _split_nexmon(content: bytes, elements: int) -> tuple[list[bytes], int]:
    """Join the packets of all cores for one frame: they follow each other."""
    order = PCAP_ORDERS.get(content[:4])
    if order is None:
        raise ValueError("it does not begin as a pcap file; save pcapng as pcap")
    groups: list[dict[int, bytes]] = []
    start, last = PCAP_HEADER_BYTES, None
    while start < len(content):
        size = int.from_bytes(content[start + 8 : start + 12], order)
        begin = start + RECORD_HEADER_BYTES
        payload = content[begin + UDP_HEADER_BYTES : begin + size]
        if begin + size > len(content):
            raise ValueError(f"the record at byte {start} is cut off")
        if payload[:2] == NEXMON_MARK:
            if (len(payload) - NEXMON_HEADER_BYTES) / 4 not in NEXMON_USED:
                raise ValueError(f"the record at byte {start} does not have 64, 128 or 256 subcarriers")
            if int.from_bytes(payload[16:18], "little") == 101:
                raise InputError(f"it is of a 43455c0 (Raspberry Pi), {ONE_ANTENNA}")
            core, stream = payload[12] & 7, payload[12] >> 3 & 7
            frame = payload[4:12], payload[16:18], len(payload)  # address and number, chip, bandwidth
            if stream == 0:
                if frame != last or core in groups[-1]:
                    groups.append({})
                groups[-1][core] = payload
                last = frame
        start = begin + size
    cores = range(elements)
    packets = [b"".join(group[core] for core in cores) for group in groups if sorted(group) == list(cores)]
    if len(set(map(len, packets))) > 1:
        raise ValueError("its packets have several bandwidths")
    return packets, len(groups) - len(packets)


def _decode_nexmon(packet: bytes, elements: int) -> Channel:
    """Return the channel without null, guard and DC subcarriers. Elements are the cores."""
    size = len(packet) // elements
    number, tones = int.from_bytes(packet[16:18], "little"), (size - NEXMON_HEADER_BYTES) // 4
    chip = NEXMON_CHIPS.get(number)
    if chip is None:
        raise ValueError(f"chip {number} is none of {', '.join(sorted({*NEXMON_CHIPS.values()}))}")
    capture = _csiread().Nexmon(None, chip=chip, bw=tones * 5 // 16, if_report=False)
    channel = np.empty((tones, elements), dtype=np.complex128)
    for core in range(elements):
        capture.pmsg(2 * NEXMON_MARK + packet[core * size + 4 : (core + 1) * size])
        channel[:, core] = capture.csi[0]
    first, last = NEXMON_USED[tones]
    used = np.r_[first : last + 1, -last : 1 - first]  # in the order of the FFT
    used = used[:: max(1, len(used) // 64)]  # about 64 of each packet
    return channel[used]


def _csiread() -> Any:
    return optional_module("csiread", "captures are decoded by csiread", "csi")


TOOLS = {
    ".dat": Tool(
        "the Linux 802.11n CSI Tool", lambda start: start[2:3] in (b"\xbb", b"\xc1"), _split_csitool, _decode_csitool
    ),
    ".pcap": Tool(
        "nexmon_csi",
        lambda start: start[:4] in PCAP_ORDERS,
        _split_nexmon,
        _decode_nexmon,
        lambda packet: packet[4:10].hex(":"),
    ),
}


class Captures(Format[Snapshots]):
    """Packets of a capture and their subcarriers are the snapshots of its position."""

    takes = frozenset({"beamformer", "grid", "every", "drop_elements", "round_trip", "sender"})

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
        content, frame = read_yaml(described), read_table(table)
        if absent := [name for name in GIVEN if name not in content]:
            raise InputError(f"{described} lacks {', '.join(absent)}: {NEEDED}")
        description = described_arrays(described, content)
        elements = len(array_of(described, description).element)
        files = _files(table, frame)
        packets = {file: _packets(file, elements) for file in files}
        sender, others = _sender(path, packets, options.sender)
        channels = [_channels(file, own, sender, elements) for file, (own, _) in packets.items()]
        left_out = sum(count for _, count in packets.values())
        counts = list(map(len, channels))
        subcarriers = {channel.shape[1] for channel in channels}
        if len(subcarriers) > 1:
            raise InputError(f"{path}: captures have different numbers of subcarriers: {listed(sorted(subcarriers))}")
        packet = np.arange(max(counts))  # repeated in shorter captures, because all rows need one number of snapshots
        csi = np.stack([channel[packet * len(channel) // len(packet)] for channel in channels])
        position = np.stack([_column(table, frame, axis) for axis in "xyz"], axis=1)
        time = {"time": _column(table, frame, "time")} if column_of(frame, "time", {}) else {}
        arrays = description | time | {"csi": csi.reshape(len(files), -1, elements), "position": position}
        notes = [f"packets used of each capture: {ranges(sorted(set(counts)))}", OFFSETS, *others]
        if left_out:
            notes.append(f"packets without a channel of all {elements} elements are left out: {left_out}")
        if unlisted := [file.name for file in _captures(path) if file not in files]:
            notes.append(f"captures without a row in {POSITIONS} are left out: {listed(unlisted)}")
        return snapshots_of(path, arrays, options, [table, described, *files], None, tuple(notes))


def holds_captures(path: Path) -> bool:
    """Return True for a capture, and for a folder with captures or with the description of their array."""
    return (path / DESCRIPTION).is_file() or bool(_captures(path))


def _captures(path: Path) -> list[Path]:
    """Return the captures in a folder, or the file itself if it is one."""
    found = []
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.suffix in (*TOOLS, ".csv") and file.is_file():
            with file.open("rb") as stream:
                start = stream.read(4096)
            if TOOLS[file.suffix].recognises(start) if file.suffix in TOOLS else b"CSI_DATA" in start:
                found.append(file)
    return found


def _files(table: Path, frame: pd.DataFrame) -> list[Path]:
    """Return the captures that a table of positions names, each once."""
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


def _packets(file: Path, elements: int) -> tuple[list[bytes], int]:
    """Return the packets of a capture, and the number of those without K elements."""
    tool = TOOLS[file.suffix]
    if file.stat().st_size > MAX_UNPACKED_BYTES:
        raise InputError(f"{file} has more than {MAX_UNPACKED_BYTES} bytes; split it")
    with refusing_broken(file, f"a complete capture of {tool.name}"):
        packets, left_out = tool.split(read_bytes(file), elements)
        if not packets:
            raise InputError(
                f"no packet has a channel of the {elements} elements in {DESCRIPTION}; {left_out} have others"
            )
        return packets, left_out


def _sender(path: Path, packets: Mapping[Path, tuple[list[bytes], int]], wanted: str | None) -> tuple[str, list[str]]:
    """Return the sender that is wanted, or that of most packets, and a note on others.

    Raises:
        InputError: No packet of it in some capture, or another sender has half as many packets, and none is wanted.
    """
    of_file = {file: Counter(map(TOOLS[file.suffix].sender, own)) for file, (own, _) in packets.items()}
    counts = sum(of_file.values(), Counter[str]()).most_common()
    named = ", ".join(f"{sender} {count}" for sender, count in counts[:5])
    if wanted is None and len(counts) > 1 and counts[1][1] > counts[0][1] / 2:
        raise InputError(f"captures of {path} are of several senders, with these packets: {named}; choose one: sender")
    sender = counts[0][0] if wanted is None else wanted.lower()
    if absent := [file.name for file, own in of_file.items() if sender not in own]:
        raise InputError(f"{absent[0]} of {path} has no packet of sender {sender}; there are {named}")
    return sender, [f"packets of sender {sender} are used; packets by sender: {named}"] if len(counts) > 1 else []


def _channels(file: Path, packets: list[bytes], sender: str, elements: int) -> Channel:
    """Return channels (packets, subcarriers, K) of evenly spaced packets of a sender."""
    tool = TOOLS[file.suffix]
    own = [packet for packet in packets if tool.sender(packet) == sender]
    size = min(len(own), MAX_PACKETS)
    with refusing_broken(file, f"a complete capture of {tool.name}"):
        return np.stack([tool.decode(own[i * len(own) // size], elements) for i in range(size)])
