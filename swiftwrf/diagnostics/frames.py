"""Check that spectra and positions share one coordinate frame, and diagnose the error if not.

The peak of a spectrum is often in the direction of the line of sight. The score of a frame is the agreement

    a(frame) = mean over positions of exp(-theta^2 / (2 sigma^2)),    sigma = 10 degrees,

with theta the angle between peak and line of sight in that frame. Its chance level is the mean over pairs of different
positions; only the excess counts as evidence, and there is none if all positions lie in one direction. An error of frames
(axes swapped, a quaternion in another order, millimetres, azimuths clockwise, ...) is named if its agreement clearly exceeds
that of the declared frame, and so is any other constant rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.array.angles import angular_distance, to_angles, to_direction
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, log_distance

SIGMA = math.radians(10)
MAX_POSITIONS = 300
MIN_EVIDENCE = 0.15  # agreement above chance to accept a frame, and above the declared frame to prefer another one
TIE = 0.02  # difference in agreement of explanations that are not distinguished
SCANNED_ROTATIONS = 4000
MIN_TURN = math.radians(5)  # of a constant rotation that is reported
MIN_TURN_GAIN = 0.03  # in agreement, of such a rotation
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048}
AXES = torch.eye(3, dtype=torch.float64)
SWAPS = {"x and y": AXES[[1, 0, 2]], "y and z": AXES[[0, 2, 1]], "x and z": AXES[[2, 1, 0]]}
MIRRORS = {axis: AXES - 2 * torch.outer(unit, unit) for axis, unit in zip("xyz", AXES, strict=True)}
AZIMUTH_ERRORS = {  # maps from x, y of the line of sight to those of the peaks
    "azimuths of the spectra turn clockwise (or the array's y axis is reversed)": ((1, 0), (0, -1)),
    "azimuths of the spectra turn clockwise from -x (or the array's x axis is reversed)": ((-1, 0), (0, 1)),
    "azimuths of the spectra are half a turn off (or phases have the wrong sign)": ((-1, 0), (0, -1)),
    "azimuths of the spectra count from y instead of x": ((0, 1), (-1, 0)),
    "azimuths of the spectra count from -y instead of x": ((0, -1), (1, 0)),
    "azimuths turn clockwise from y, as on a compass (or the array's x and y are swapped)": ((0, 1), (1, 0)),
}
MIN_CLEAR_POSITIONS = 20  # with line of sight, to check frames
MIN_VARIANCE_GAIN = 0.1  # in explained variance of RSSI, to prefer another frame


@dataclass(frozen=True)
class FrameReport:
    """Result of `check_frames`.

    Args:
        agreement: Agreement in the declared frame, in [0, 1].
        chance: Chance level of the agreement.
        angle_deg: Median angle between peak and line of sight [deg].
        explanations: Errors with clearly more agreement than the declared frame, in words; several are not distinguished.
        explained: Agreement with them.
        turn_deg: Constant rotation with more agreement, as a rotation vector in array coordinates [deg], or None.
        positions: Number of positions used.
    """

    agreement: float
    chance: float
    angle_deg: float
    explanations: tuple[str, ...]
    explained: float
    turn_deg: tuple[float, float, float] | None
    positions: int

    @property
    def fits(self) -> bool:
        """True if the declared frame explains the peaks, and no other frame does clearly better."""
        return self.agreement - self.chance >= MIN_EVIDENCE and not self.explanations and self.turn_deg is None


@dataclass(frozen=True, eq=False)
class _Frame:
    """Positions of the moving end (n, 3) and of the fixed one (3,), rotation (3, 3), sign of the line of sight."""

    position: Tensor
    fixed: Tensor
    rotation: Tensor
    sign: float

    def towards(self) -> Tensor:
        """Return unit vectors of the line of sight in array coordinates, (n, 3)."""
        away = self.sign * (self.position - self.fixed) @ self.rotation
        direction: Tensor = away / away.norm(dim=1, keepdim=True).clamp_min(1e-12)
        return direction

    def direction(self) -> Tensor:
        """Return `towards`, folded to the front of the array."""
        return _folded(self.towards())

    def mapped(self, matrix: Tensor, both: bool = False) -> _Frame:
        """Return the frame with a matrix (3, 3) applied to the positions, and to the fixed one if `both`."""
        return replace(self, position=self.position @ matrix, fixed=self.fixed @ matrix if both else self.fixed)


def check_frames(spectra: Spectra) -> FrameReport | None:
    """Compare the peaks of the spectra with the lines of sight, in the declared frame and in others.

    Args:
        spectra: Spectra with known fixed end and orientation. Positions without line of sight are omitted.

    Returns:
        The report, or None with fewer than 20 such positions or an unknown frame.

    Example:
        >>> from swiftwrf.data.simulated import simulated_room
        >>> check_frames(simulated_room(n=40)).fits
        True
    """
    rows = spectra.line_of_sight.nonzero()[:, 0]
    if len(rows) < MIN_CLEAR_POSITIONS or spectra.fixed_position is None or spectra.rotation is None:
        return None
    rows = rows[torch.linspace(0, len(rows) - 1, min(MAX_POSITIONS, len(rows))).round().long()]
    peak = to_direction(*spectra.grid.peak_direction(spectra.store[rows]).unbind(-1))
    sign = 1.0 if spectra.moving == "transmitter" else -1.0
    frame = _Frame(spectra.position[rows], spectra.fixed_position, spectra.rotation, sign)
    declared = frame.direction()
    agreement, chance = _agreement(declared, peak)
    found = {meaning: _agreement(direction, peak) for meaning, direction in _others(frame).items()}
    named, by_chance = max(found.values())
    turn, angle = _constant_turn(frame, peak)
    turned, turned_by_chance = _agreement(_folded(frame.towards() @ _matrix(turn)), peak)
    error = named - by_chance >= MIN_EVIDENCE and named - agreement >= MIN_EVIDENCE and named >= turned - MIN_TURN_GAIN
    rotates = turned - turned_by_chance >= MIN_EVIDENCE and turned - agreement >= MIN_TURN_GAIN and angle >= MIN_TURN
    return FrameReport(
        agreement=agreement,
        chance=chance,
        angle_deg=math.degrees(float(angular_distance(declared, peak).median())),
        explanations=tuple(name for name, (value, _) in found.items() if value >= named - TIE) if error else (),
        explained=named if error else turned if rotates else agreement,
        turn_deg=tuple(np.degrees(turn).tolist()) if rotates and not error else None,
        positions=len(rows),
    )


def _folded(direction: Tensor) -> Tensor:
    return torch.cat([direction[..., :2], direction[..., 2:].abs()], dim=-1)


def _agreement(direction: Tensor, peak: Tensor) -> tuple[float, float]:
    """Return the agreement of directions and peaks (n, 3) of the same positions, and of different ones."""
    angle = angular_distance(peak[:, None].expand(-1, len(direction), -1), direction.expand(len(peak), -1, -1))
    kernel = torch.exp(-0.5 * (angle / SIGMA).square())
    n = len(peak)
    same = float(kernel.diagonal().mean())
    return same, float((kernel.sum() - kernel.diagonal().sum()) / (n * (n - 1)))


def _others(frame: _Frame) -> dict[str, Tensor]:
    """Return the directions (n, 3) of the line of sight under each error."""
    quaternion = Rotation.from_matrix(frame.rotation.numpy()).as_quat()
    reordered = torch.from_numpy(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())
    frames = {
        "the quaternion is in the order w, x, y, z; it must be x, y, z, w": replace(frame, rotation=reordered),
        "the quaternion turns world into array coordinates; it must turn array into world": replace(
            frame, rotation=frame.rotation.T
        ),
    }
    for names, swap in SWAPS.items():
        frames[f"{names} of the positions are swapped"] = frame.mapped(swap)
        frames[f"{names} of positions and array are swapped against the orientation"] = frame.mapped(swap, both=True)
    for axis, mirror in MIRRORS.items():
        frames[f"{axis} of the positions has the wrong sign"] = frame.mapped(mirror)
        against = f"{axis} of positions and array has the wrong sign against the orientation"
        frames[against] = frame.mapped(mirror, both=True)
    for unit, scale in UNITS.items():
        frames[f"the positions are in {unit}, the array's is in metres"] = frame.mapped(scale * AXES)
        metres = f"the array's position is in {unit}, the others are in metres"
        frames[metres] = replace(frame, fixed=scale * frame.fixed)
    found = {meaning: other.direction() for meaning, other in frames.items()}
    declared = frame.direction()
    for meaning, matrix in AZIMUTH_ERRORS.items():
        found[meaning] = torch.cat([declared[:, :2] @ torch.tensor(matrix).double().T, declared[:, 2:]], dim=1)
    azimuth, elevation = to_angles(declared)
    zenith = "rows of the spectra run from the zenith down; row 0 must be the lowest elevation"
    return found | {zenith: to_direction(azimuth, math.pi / 2 - elevation)}


def _constant_turn(frame: _Frame, peak: Tensor) -> tuple[NDArray[np.float64], float]:
    """Return the rotation of the array with most agreement, as a rotation vector in its coordinates, and its angle."""
    towards = frame.towards()
    scanned = Rotation.random(SCANNED_ROTATIONS, rng=np.random.default_rng(0))
    turns = Rotation.concatenate([Rotation.identity(), scanned])
    matrices = torch.from_numpy(turns.as_matrix()).float()
    score = torch.cat([_mean_kernel(_folded(towards.float() @ part), peak.float()) for part in matrices.split(200)])

    def miss(turn: NDArray[np.float64]) -> float:
        return -float(_mean_kernel(_folded(towards @ _matrix(turn)), peak))

    starts = [np.zeros(3), *(turns[int(i)].as_rotvec() for i in score.topk(3).indices)]
    options = {"xatol": 1e-4, "fatol": 1e-6}
    results = [
        minimize(miss, start, method="Nelder-Mead", options=options | {"initial_simplex": simplex})
        for start, simplex in ((s, np.vstack([s, s + 0.1 * np.eye(3)])) for s in starts)
    ]
    rotation = Rotation.from_rotvec(min(results, key=lambda result: result.fun).x)
    return rotation.as_rotvec(), float(rotation.magnitude())


def _matrix(turn: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())


def _mean_kernel(direction: Tensor, peak: Tensor) -> Tensor:
    """Return the agreement of directions (..., n, 3) and peaks (n, 3), (...)."""
    angle = angular_distance(direction, peak.expand_as(direction))
    mean: Tensor = torch.exp(-0.5 * (angle / SIGMA).square()).mean(-1)
    return mean


@dataclass(frozen=True)
class PathLossReport:
    """Result of `check_path_loss`.

    Args:
        explained: Fraction of the variance of RSSI that path-loss models of each receiver explain.
        level_dbm: RSSI at 1 m by one path-loss model of all receivers [dBm].
        exponent: Path-loss exponent of that model.
        explanation: Error of frames with clearly more explained variance, in words, or an empty text.
    """

    explained: float
    level_dbm: float
    exponent: float
    explanation: str


def check_path_loss(data: Rssi) -> PathLossReport | None:
    """Compare RSSI with the distances from the receivers, in the declared frame and in others.

    Returns:
        The report, or None if the receivers' positions are unknown.
    """
    if not data.located:
        return None
    place = data.transmitter_position
    others = {f"{names} of the positions are swapped": place @ swap for names, swap in SWAPS.items()}
    others |= {f"the positions are in {unit}, the receivers' in metres": place * scale for unit, scale in UNITS.items()}
    others |= {f"{axis} of the positions has the wrong sign": place @ mirror for axis, mirror in MIRRORS.items()}
    declared = _explained(place, data)
    found = {meaning: _explained(other, data) for meaning, other in others.items()}
    meaning, best = max(found.items(), key=lambda pair: pair[1])
    model = fit_path_loss(log_distance(place, data.receiver_position), data.rssi_dbm, shared=True)
    return PathLossReport(
        explained=declared,
        level_dbm=float(model.level),
        exponent=float(-model.slope / 10),
        explanation=meaning if best - declared >= MIN_VARIANCE_GAIN else "",
    )


def _explained(position: Tensor, data: Rssi) -> float:
    """Return the fraction of the variance of RSSI that path-loss models explain, if RSSI decreases with distance."""
    distance = log_distance(position, data.receiver_position)
    constant = PathLoss(data.rssi_dbm.nanmean(dim=0), torch.zeros(data.rssi_dbm.shape[1], dtype=torch.float64))
    model = fit_path_loss(distance, data.rssi_dbm)
    residual = data.rssi_dbm - model.where(model.slope < 0, constant)(distance)
    return 1 - float(residual.square().nansum() / (data.rssi_dbm - constant.level).square().nansum().clamp_min(1e-12))
