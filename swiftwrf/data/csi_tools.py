"""Captures of CSI tools: their packets, and the channels that csiread decodes from these.

csiread does not check sizes, so packets are checked before it gets them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swiftwrf.errors import InputError

Channel = NDArray[np.complex128]
ONE_ANTENNA = "which has one antenna and receives no direction"

BFEE = 0xBB  # code of the frames with CSI; others are skipped
BFEE_HEADER_BYTES = 21  # code included
BFEE_SUBCARRIERS, BFEE_ANTENNAS = 30, 3

PCAP_ORDERS: dict[bytes, Literal["little", "big"]] = dict.fromkeys((b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1"), "little")
PCAP_ORDERS |= dict.fromkeys((b"\xa1\xb2\xc3\xd4", b"\xa1\xb2\x3c\x4d"), "big")
PCAP_HEADER_BYTES, RECORD_HEADER_BYTES, UDP_HEADER_BYTES = 24, 16, 42  # the last with those of Ethernet and IP
NEXMON_MARK, NEXMON_HEADER_BYTES = b"\x11\x11", 18
NEXMON_CHIPS = {3: "4358", 0xDEAD: "4358", 106: "4366c0"}  # 0xDEAD in captures of earlier versions
NEXMON_ONE_ANTENNA = 101  # 43455c0, of the Raspberry Pi
NEXMON_USED = {64: (1, 28), 128: (2, 58), 256: (2, 122)}  # size of the FFT: first and last subcarrier beside DC
MAX_SUBCARRIERS = 64  # used of each packet, about


class Tool(NamedTuple):
    """Captures of one tool: recognition and decoding."""

    name: str
    recognises: Callable[[bytes], bool]
    """whether the first bytes of a file are of such a capture"""
    split: Callable[[bytes, int], tuple[list[bytes], int]]
    """packets of that many antennas in a capture, and the number of others; refuses damaged captures by ValueError"""
    decode: Callable[[bytes, int], Channel]
    """channel (subcarriers, K) of a packet"""


def _split_csitool(content: bytes, elements: int) -> tuple[list[bytes], int]:
    packets, left_out, start = [], 0, 0
    while start < len(content):
        size = int.from_bytes(content[start : start + 2], "big")
        frame = content[start + 2 : start + 2 + size]
        if not 0 < size == len(frame):
            raise ValueError(f"the frame at byte {start} is cut off")
        if frame[0] == BFEE:
            n_receive, n_transmit = frame[9:11] if size > BFEE_HEADER_BYTES else (0, 0)
            expected = (BFEE_SUBCARRIERS * (16 * n_receive * n_transmit + 3) + 7) // 8
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
            if int.from_bytes(payload[16:18], "little") == NEXMON_ONE_ANTENNA:
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
    used = used[:: max(1, len(used) // MAX_SUBCARRIERS)]
    return channel[used]


def _csiread() -> Any:
    try:
        import csiread
    except ImportError:
        raise InputError("captures are decoded by csiread; install it with pip install 'swiftwrf-tasks[csi]'") from None
    return csiread


TOOLS = {
    ".dat": Tool(
        "the Linux 802.11n CSI Tool", lambda start: start[2:3] in (b"\xbb", b"\xc1"), _split_csitool, _decode_csitool
    ),
    ".pcap": Tool("nexmon_csi", lambda start: start[:4] in PCAP_ORDERS, _split_nexmon, _decode_nexmon),
}
