"""Check that RSSI decreases with the distance from the receivers, and diagnose the error of frames or units if not.

The score of a frame is the fraction of the variance of RSSI that path-loss models explain. An error is named if its fraction
clearly exceeds that of the declared frame. Errors that the positions cannot show are not tried, e.g. swaps with an axis
along which all positions are equal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.diagnostics.frames import MIRRORS, SWAPS, UNITS
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, log_distance

MIN_VARIANCE_GAIN = 0.1  # in explained variance, to prefer another frame
MIN_EXPLAINED = 0.25  # of the variance, by an error that is named
MAX_ROWS = 2000  # that are compared
TIE = 0.02  # difference in explained variance of errors that are not distinguished
MIN_EXTENT_M = 1e-6  # of an axis along which positions differ
SCANNED_OFFSETS = 40  # of a mirror


@dataclass(frozen=True)
class PathLossReport:
    """Result of `check_path_loss`.

    Args:
        explained: Fraction of the variance of RSSI that path-loss models of each receiver explain.
        level_dbm: RSSI at 1 m by one path-loss model of all receivers [dBm].
        exponent: Path-loss exponent of that model.
        explanation: Errors of frames with clearly more explained variance, in words, or an empty text.
    """

    explained: float
    level_dbm: float
    exponent: float
    explanation: str


def check_path_loss(data: Rssi) -> PathLossReport | None:
    """Compare RSSI with the distances from the receivers, in the declared frame and in others.

    Returns:
        The report, or None if the receivers' positions are unknown.

    Example:
        >>> from swiftwrf import rssi_room
        >>> check_path_loss(rssi_room(n=100)).explanation
        ''
    """
    if not data.located:
        return None
    report = _declared(data)
    data = data.subset(torch.linspace(0, len(data) - 1, min(MAX_ROWS, len(data))).round().long())
    place = data.transmitter_position
    found = {meaning: _explained(other, data) for meaning, other in _others(place)}
    best = max(found.values(), default=0.0)
    mirrors = {
        f"{axis} of the positions counts from the other side ({axis} = {offset:.1f} - {axis})": value
        for axis, offset, value in _mirrors(place, data)
        if value >= best + TIE
    }
    found |= mirrors
    best, declared = max(found.values(), default=0.0), _explained(place, data)
    if best < MIN_EXPLAINED or best - declared < MIN_VARIANCE_GAIN:
        return report
    return replace(report, explanation="; or if ".join(name for name, value in found.items() if value >= best - TIE))


def _declared(data: Rssi) -> PathLossReport:
    """Return the report of the declared frame."""
    distance = log_distance(data.transmitter_position, data.receiver_position)
    model = fit_path_loss(distance, data.rssi_dbm, shared=True)
    explained = _explained(data.transmitter_position, data)
    return PathLossReport(explained, float(model.level), float(-model.slope / 10), explanation="")


def _others(place: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield the positions under each error that they can show."""
    varying = _varying(place)
    for names, swap in SWAPS.items():
        if {names[0], names[-1]} <= varying:
            yield f"{names} of the positions are swapped", place @ swap
    for unit, scale in UNITS.items():
        yield f"the positions are in {unit}, the receivers' in metres", place * scale
    for axis, mirror in MIRRORS.items():
        if axis in varying:
            yield f"{axis} of the positions has the wrong sign", place @ mirror


def _varying(place: Tensor) -> set[str]:
    """Return the axes along which positions (n, 3) differ."""
    extent = place.amax(dim=0) - place.amin(dim=0)
    return {axis for axis, size in zip("xyz", extent.tolist(), strict=True) if size > MIN_EXTENT_M}


def _mirrors(place: Tensor, data: Rssi) -> Iterator[tuple[str, float, float]]:
    """Yield each axis, the offset c [m] of the mirror c - x that explains most, and the fraction that it explains."""
    every = torch.cat([place, data.receiver_position[data.receiver_located]])
    varying = _varying(place)
    for number, axis in enumerate("xyz"):
        if axis not in varying:
            continue

        def explained(offset: float, number: int = number) -> float:
            mirrored = place.clone()
            mirrored[:, number] = offset - place[:, number]
            return _explained(mirrored, data)

        low, high = 2 * float(every[:, number].amin()), 2 * float(every[:, number].amax())
        offsets = torch.linspace(low, high, SCANNED_OFFSETS).tolist()
        start, step = max(offsets, key=explained), (high - low) / (SCANNED_OFFSETS - 1)
        result = minimize_scalar(lambda c: -explained(float(c)), bounds=(start - step, start + step), method="bounded")
        yield axis, float(result.x), -float(result.fun)


def _explained(position: Tensor, data: Rssi) -> float:
    """Return the fraction of the variance of RSSI that path-loss models explain, if RSSI decreases with distance."""
    distance = log_distance(position, data.receiver_position)
    constant = PathLoss(data.rssi_dbm.nanmean(dim=0), torch.zeros(data.rssi_dbm.shape[1], dtype=torch.float64))
    model = fit_path_loss(distance, data.rssi_dbm)
    residual = data.rssi_dbm - model.where(model.slope < 0, constant)(distance)
    return 1 - float(residual.square().nansum() / (data.rssi_dbm - constant.level).square().nansum().clamp_min(1e-12))
