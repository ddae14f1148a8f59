"""Whether spectra and positions are in one frame, and if not, which error would explain it.

The strongest direction of a spectrum is often that of the line of sight. How often is told by the agreement

    a(frame) = mean over positions of exp(-theta^2 / (2 sigma^2)),    sigma = 10 degrees,

with theta the angle between peak and line of sight in that frame. What spectra of other positions would agree by chance is
the same mean over pairs of different positions; only what exceeds it is evidence, and there is none where all positions lie
in one direction. An error of frames (axes swapped, a quaternion in another order, millimetres, azimuths clockwise, ...) is
named where it explains clearly more than the declared frame does; so is any other constant rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.array.angles import angular_distance, to_angles, to_direction
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.rssi.law import fit_law, log_distance

WIDTH = math.radians(10)
MOST_POSITIONS = 300
EVIDENCE = 0.15  # beyond chance, that a frame needs to be believed, and to be preferred to the declared one
TIED = 0.02  # of agreement, within which explanations cannot be told from each other
ROTATIONS = 4000  # that are scanned
LEAST_TURN = math.radians(5)  # of a constant rotation that is worth a word
GAIN = 0.03  # in agreement that it needs
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048}
SWAPS = {"x and y": [1, 0, 2], "y and z": [0, 2, 1], "x and z": [2, 1, 0]}
FEW = 20  # positions that tell frames
EXPLAINED = 0.1  # of the variance of RSSI, by which another frame must be better


@dataclass(frozen=True)
class FrameReport:
    """What `check_frames` found.

    Args:
        agreement: of the declared frame, in [0, 1].
        chance: what spectra of other positions would have.
        angle_deg: median angle between peak and line of sight.
        explanations: errors that explain clearly more than the declared frame, each in words; several cannot be told apart.
        explained: agreement with them.
        turn_deg: constant rotation that explains more, a rotation vector in array coordinates; None where there is none.
        positions: number that was used.
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
        """Whether the declared frame explains the peaks, and no other does clearly better."""
        return self.agreement - self.chance >= EVIDENCE and not self.explanations and self.turn_deg is None


@dataclass(frozen=True, eq=False)
class _Scene:
    """Positions (n, 3) of the moving end, that of the fixed one (3,), rotation (3, 3), sign of the line of sight."""

    position: Tensor
    fixed: Tensor
    rotation: Tensor
    sign: float

    def direction(self) -> Tensor:
        """Unit vectors of the line of sight in array coordinates, folded above the plane, (n, 3)."""
        away = self.sign * (self.position - self.fixed) @ self.rotation
        return _folded(away / away.norm(dim=1, keepdim=True).clamp_min(1e-12))

    def of(
        self,
        position: Callable[[Tensor], Tensor] = lambda p: p,
        fixed: Callable[[Tensor], Tensor] = lambda p: p,
        rotation: Callable[[Tensor], Tensor] = lambda r: r,
    ) -> _Scene:
        return _Scene(position(self.position), fixed(self.fixed), rotation(self.rotation), self.sign)


def check_frames(spectra: Spectra) -> FrameReport | None:
    """Compares the peaks of the spectra with the lines of sight, in the declared frame and in others.

    Args:
        spectra: with known fixed end and orientation; positions known to be without line of sight are left out.

    Returns:
        None where there are fewer than 20 such positions, or the frame is not known.
    """
    rows = spectra.line_of_sight.nonzero()[:, 0]
    if len(rows) < FEW or spectra.fixed_position is None or spectra.rotation is None:
        return None
    rows = rows[torch.linspace(0, len(rows) - 1, min(MOST_POSITIONS, len(rows))).round().long()]
    peak = to_direction(*spectra.grid.peak_direction(spectra.store[rows]).unbind(-1))
    sign = 1.0 if spectra.moving == "transmitter" else -1.0
    scene = _Scene(spectra.position[rows], spectra.fixed_position, spectra.rotation, sign)
    declared = scene.direction()
    agreement, chance = _agreement(declared, peak)
    found = {meaning: _agreement(direction, peak) for meaning, direction in _others(scene).items()}
    named, by_chance = max(found.values())
    turn, angle = _constant_turn(scene, peak)
    turned, turned_by_chance = _agreement(_folded(_turned(scene, turn)), peak)
    error = named - by_chance >= EVIDENCE and named - agreement >= EVIDENCE and named >= turned - GAIN
    rotates = turned - turned_by_chance >= EVIDENCE and turned - agreement >= GAIN and angle >= LEAST_TURN
    return FrameReport(
        agreement=agreement,
        chance=chance,
        angle_deg=math.degrees(float(angular_distance(declared, peak).median())),
        explanations=tuple(name for name, (value, _) in found.items() if value >= named - TIED) if error else (),
        explained=named if error else turned if rotates else agreement,
        turn_deg=tuple(np.degrees(turn).tolist()) if rotates and not error else None,
        positions=len(rows),
    )


def _folded(direction: Tensor) -> Tensor:
    return torch.cat([direction[..., :2], direction[..., 2:].abs()], dim=-1)


def _agreement(direction: Tensor, peak: Tensor) -> tuple[float, float]:
    """Agreement of directions and peaks (n, 3) of the same positions, and of different ones."""
    angle = angular_distance(peak[:, None].expand(-1, len(direction), -1), direction.expand(len(peak), -1, -1))
    kernel = torch.exp(-0.5 * (angle / WIDTH).square())
    n = len(peak)
    same = float(kernel.diagonal().mean())
    return same, float((kernel.sum() - kernel.diagonal().sum()) / (n * (n - 1)))


def _others(scene: _Scene) -> dict[str, Tensor]:
    """Directions (n, 3) of the line of sight, had one error been made."""
    quaternion = Rotation.from_matrix(scene.rotation.numpy()).as_quat()

    def reordered(_: Tensor) -> Tensor:
        return torch.from_numpy(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())

    def columns(order: list[int]) -> Callable[[Tensor], Tensor]:
        return lambda p: p[..., order]

    def mirrored(axis: int) -> Callable[[Tensor], Tensor]:
        signs = torch.ones(3, dtype=torch.float64)
        signs[axis] = -1
        return lambda p: p * signs

    def scaled(scale: float) -> Callable[[Tensor], Tensor]:
        return lambda p: p * scale

    scenes = {
        "the quaternion is in the order w, x, y, z; it must be x, y, z, w": scene.of(rotation=reordered),
        "the quaternion turns world into array coordinates; it must turn array into world": scene.of(
            rotation=lambda r: r.T
        ),
    }
    for names, order in SWAPS.items():
        swap = columns(order)
        scenes[f"{names} of the positions are swapped"] = scene.of(position=swap)
        scenes[f"{names} of positions and array are swapped against the orientation"] = scene.of(
            position=swap, fixed=swap
        )
    for name, axis in (("x", 0), ("y", 1), ("z", 2)):
        mirror = mirrored(axis)
        scenes[f"{name} of the positions has the wrong sign"] = scene.of(position=mirror)
        scenes[f"{name} of positions and array has the wrong sign against the orientation"] = scene.of(
            position=mirror, fixed=mirror
        )
    for unit, scale in UNITS.items():
        scenes[f"the positions are in {unit}, the array's is in metres"] = scene.of(position=scaled(scale))
        scenes[f"the array's position is in {unit}, the others are in metres"] = scene.of(fixed=scaled(scale))
    found = {meaning: other.direction() for meaning, other in scenes.items()}
    x, y, z = scene.direction().unbind(1)
    found |= {
        "azimuths of the spectra turn clockwise (or the array's y axis is reversed)": torch.stack([x, -y, z], 1),
        "azimuths of the spectra turn clockwise from -x (or the array's x axis is reversed)": torch.stack(
            [-x, y, z], 1
        ),
        "azimuths of the spectra are half a turn off (or phases have the wrong sign)": torch.stack([-x, -y, z], 1),
        "azimuths of the spectra count from y instead of x": torch.stack([y, -x, z], 1),
        "azimuths of the spectra count from -y instead of x": torch.stack([-y, x, z], 1),
        "azimuths turn clockwise from y, as on a compass (or the array's x and y are swapped)": torch.stack(
            [y, x, z], 1
        ),
    }
    azimuth, elevation = to_angles(scene.direction())
    found["rows of the spectra run from the zenith down; row 0 must be the lowest elevation"] = to_direction(
        azimuth, math.pi / 2 - elevation
    )
    return found


def _turned(scene: _Scene, turn: NDArray[np.float64]) -> Tensor:
    """Directions with the array turned by a rotation vector in its own coordinates, not folded."""
    away = scene.sign * (scene.position - scene.fixed) @ scene.rotation
    matrix = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
    direction: Tensor = away / away.norm(dim=1, keepdim=True) @ matrix
    return direction


def _constant_turn(scene: _Scene, peak: Tensor) -> tuple[NDArray[np.float64], float]:
    """The rotation of the array that agrees best, as a rotation vector in its coordinates, and its angle."""
    away = _turned(scene, np.zeros(3)).float()
    turns = Rotation.concatenate([Rotation.identity(), Rotation.random(ROTATIONS, random_state=0)])
    matrices = torch.from_numpy(turns.as_matrix()).float()
    score = torch.cat([_mean_kernel(_folded(away @ part), peak.float()) for part in matrices.split(200)])

    def miss(turn: NDArray[np.float64]) -> float:
        return -float(_mean_kernel(_folded(_turned(scene, turn)), peak))

    starts = [np.zeros(3), *(turns[int(i)].as_rotvec() for i in score.topk(3).indices)]
    simplex = [np.vstack([start, start + 0.1 * np.eye(3)]) for start in starts]
    results = [
        minimize(miss, start, method="Nelder-Mead", options={"initial_simplex": s, "xatol": 1e-4, "fatol": 1e-6})
        for start, s in zip(starts, simplex, strict=True)
    ]
    best = min(results, key=lambda result: result.fun)
    rotation = Rotation.from_rotvec(best.x)
    return rotation.as_rotvec(), float(rotation.magnitude())


def _mean_kernel(direction: Tensor, peak: Tensor) -> Tensor:
    """Agreement of directions (..., n, 3) and peaks (n, 3), (...)."""
    angle = angular_distance(direction, peak.expand_as(direction))
    mean: Tensor = torch.exp(-0.5 * (angle / WIDTH).square()).mean(-1)
    return mean


@dataclass(frozen=True)
class LawReport:
    """What `check_law` found.

    Args:
        explained: share of the variance of RSSI that a law of the distance from each receiver explains.
        level_dbm: RSSI at 1 m by one law for all receivers.
        exponent: of the distance in it.
        explanation: error of frames under which the laws explain clearly more, in words; nothing where there is none.
    """

    explained: float
    level_dbm: float
    exponent: float
    explanation: str


def check_law(data: Rssi) -> LawReport | None:
    """Compares RSSI with the distances from the receivers, in the declared frame and in others.

    Returns:
        None where the receivers' positions are unknown.
    """
    if not data.located:
        return None
    place = data.transmitter_position
    flips = dict(zip("xyz", 1 - 2 * torch.eye(3, dtype=place.dtype), strict=True))
    others = {f"{names} of the positions are swapped": place[:, order] for names, order in SWAPS.items()}
    others |= {f"the positions are in {unit}, the receivers' in metres": place * scale for unit, scale in UNITS.items()}
    others |= {f"{axis} of the positions has the wrong sign": place * flip for axis, flip in flips.items()}
    declared = _explained(place, data)
    found = {meaning: _explained(other, data) for meaning, other in others.items()}
    meaning, best = max(found.items(), key=lambda pair: pair[1])
    law = fit_law(log_distance(place, data.receiver_position), data.rssi_dbm, pooled=True)
    return LawReport(
        explained=declared,
        level_dbm=float(law.level),
        exponent=float(-law.slope / 10),
        explanation=meaning if best - declared >= EXPLAINED else "",
    )


def _explained(position: Tensor, data: Rssi) -> float:
    """Share of the variance of RSSI that laws of the distance explain, where they fall with it."""
    distance = log_distance(position, data.receiver_position)
    law = fit_law(distance, data.rssi_dbm)
    law = law._replace(level=law.level.where(law.slope < 0, data.rssi_dbm.nanmean(dim=0)), slope=law.slope.clamp(max=0))
    left = (data.rssi_dbm - law(distance)).square().nansum()
    return 1 - float(left / (data.rssi_dbm - data.rssi_dbm.nanmean(dim=0)).square().nansum().clamp_min(1e-12))
