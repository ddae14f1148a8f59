"""Radios of one access point as one receiver."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swiftwrf.errors import InputError, listed

Floats = NDArray[np.float64]
MAC = "mac"  # pools radios by the first five bytes of their addresses
ADDRESS = re.compile(r"((?:[0-9a-f]{2}[:-]?){4}[0-9a-f]{2})[:-]?[0-9a-f]{2}", re.IGNORECASE)


def pool_names(names: Sequence[str], by: str) -> list[str]:
    """Return the access point of each radio; a radio that does not match is one of its own.

    Args:
        names: Names of the radios.
        by: "mac" for the first five bytes of a MAC address, else a regular expression whose group is the access point.

    Raises:
        InputError: An expression that is broken, has no group, or matches no radio.

    Example:
        >>> pool_names(["a4:56:cc:00:10:b0", "a4:56:cc:00:10:b1", "lab"], "mac")
        ['a4:56:cc:00:10', 'a4:56:cc:00:10', 'lab']
        >>> pool_names(["hall-2G", "hall-5G"], "(.*)-.G")
        ['hall', 'hall']
    """
    try:
        pattern = ADDRESS if by == MAC else re.compile(by)
    except re.error as error:
        raise InputError(f"pool_by {by!r} is no column and no regular expression ({error})") from None
    if pattern.groups != 1:
        raise InputError(f"pool_by takes {MAC}, a column, or a regular expression with one group, got {by!r}")
    found = [pattern.fullmatch(name) for name in names]
    if not any(found):
        raise InputError(f"pool_by {by!r} matches no receiver; there are {listed(names)}")
    return [name if match is None else match.group(1) for name, match in zip(names, found, strict=True)]


def pooled(rssi: Floats, pools: Sequence[str]) -> tuple[list[str], Floats]:
    """Return the access points and their RSSI: the mean power of those radios that detected the transmitter.

    Args:
        rssi: RSSI of the radios (n, R) [dBm], nan where not detected.
        pools: Access point of each radio, R names.

    Returns:
        P names in order of their first radio, and RSSI (n, P) [dBm].

    Example:
        >>> pooled(np.array([[-50.0, -50.0], [-60.0, np.nan]]), ["hall", "hall"])
        (['hall'], array([[-50.],
               [-60.]]))
    """
    names = list(dict.fromkeys(pools))
    member = np.array([[pool == name for name in names] for pool in pools], dtype=np.float64)
    detected = ~np.isnan(rssi)
    power = np.where(detected, 10 ** (np.nan_to_num(rssi) / 10), 0.0) @ member
    with np.errstate(divide="ignore", invalid="ignore"):
        return names, 10 * np.log10(power / (detected @ member))
