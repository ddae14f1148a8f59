"""Complex channels that a file holds in two arrays, or as pairs of real numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swiftwrf.errors import InputError

POLAR = ("abs", "amp", "amplitude", "mag", "magnitude"), ("angle", "arg", "phase")
CARTESIAN = ("re", "real", "i"), ("im", "imag", "imaginary", "q")
UNITS = r"_(deg|degrees|rad|radians)$"
PAIRS = (
    "csi holds pairs of numbers, read as real and imaginary part; if the imaginary part comes first, as in captures of an "
    "ESP32, directions are mirrored"
)


def channel_parts(names: Iterable[str]) -> tuple[str, str] | None:
    """Return the names of the arrays with modulus and phase, or real and imaginary part. None if there are no two.

    Example:
        >>> channel_parts(["position", "csi_abs", "csi_angle_deg"])
        ('csi_abs', 'csi_angle_deg')
    """
    plain = {_plain(name): name for name in sorted(names)}
    for kinds in (POLAR, CARTESIAN):
        found = [[plain[name] for name in kind if name in plain] for kind in kinds]
        if all(len(own) == 1 for own in found):
            return found[0][0], found[1][0]
    return None


def _plain(name: str) -> str:
    return re.sub(UNITS, "", re.sub("^(csi|channel|h)_?", "", name.lower()))


def joined(file: Path, first: tuple[str, NDArray[Any]], second: tuple[str, NDArray[Any]]) -> NDArray[np.complex128]:
    """Return the complex channel of two parts, each a name and an array of one shape.

    A phase is in degrees if its name ends so, in radians if its name ends so or if no value is beyond 2 pi.

    Raises:
        InputError: Arrays of different shapes, or a phase of unknown unit.

    Example:
        >>> joined(Path("a.npz"), ("abs", np.array([2.0])), ("phase_deg", np.array([90.0]))).round(3).tolist()
        [2j]
    """
    (name, value), (other, angle) = first, second
    if value.shape != angle.shape:
        raise InputError(f"{file}: {name} and {other} have different shapes, {value.shape} and {angle.shape}")
    if _plain(name) in CARTESIAN[0]:
        return value + 1j * angle
    unit = re.search(UNITS, other.lower())
    if unit is None and (most := float(np.nanmax(np.abs(angle), initial=0.0))) > 2 * math.pi + 1e-3:
        raise InputError(f"{file}: {other} reaches {most:.4g}; name it {other}_deg, or {other}_rad if it is unwrapped")
    phase = np.deg2rad(angle) if unit and unit[1].startswith("deg") else angle
    return value * np.exp(1j * phase)


def paired(csi: NDArray[Any], elements: int) -> NDArray[np.complex128] | None:
    """Return the channel of real numbers in pairs, (..., K, 2) or (..., 2 K) for K elements. None if they are neither.

    Example:
        >>> paired(np.array([[1, 2, 3, 4]], dtype=np.int8), elements=2).tolist()
        [[(1+2j), (3+4j)]]
    """
    if csi.dtype.kind not in "fiu" or csi.ndim < 2:
        return None
    if csi.shape[-1] != 2 * elements and csi.shape[-2:] != (elements, 2):
        return None
    parts = csi if csi.shape[-1] == 2 else csi.reshape(*csi.shape[:-1], elements, 2)
    channel: NDArray[np.complex128] = parts.astype(np.float64) @ np.array([1.0, 1.0j])
    return channel
