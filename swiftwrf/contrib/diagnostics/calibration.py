"""Calibration of an array: phases of its elements, its orientation and its position, from positions with line of sight.

Cables and receivers add an unknown phase to each element, and arrays are mounted with errors of a few degrees and
decimetres. If the transmitter's position is known, so is the direct path: a_k = exp(j phi_k + j 2 pi e_k . d / wavelength)
at element k, with direction d in array coordinates. The estimate maximises the received power along the direct paths,

    J(phi, turn, shift) = sum_i w_i a_i^H C_i a_i / K^2,    C_i: covariance of the phases at position i,

over the parts that are asked for. It starts from a scan over rotations, or over shifts if the orientation is known. For
each of them phi is the principal eigenvector of the rotated covariances. It continues by least squares of the residual
phases. Positions without a clear direct path lose their weight.

Standard errors come from a block jackknife over neighbourhoods, because multipath errors of neighbouring positions are
correlated (J. W. Tukey, Ann. Math. Statist. 29, 1958). They do not include bias from a reflection common to all positions,
e.g. the floor, which can be one to two standard errors, and of a position five. What the data do not determine is refused:
the rotation of a linear array about its axis, any rotation if all positions lie in a narrow cone, or a shift if all of them
are far away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import angular_distance, rotation_matrix, wrap
from swiftwrf.array.beamforming import of_unit_power, unit, unit_phasor
from swiftwrf.array.planar import PlanarArray
from swiftwrf.choices import PHASES_AND_ORIENTATION, CalibrationPart
from swiftwrf.contrib.diagnostics import elements
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.splits import FOLDS, MIN_TRAINING, each_fold, slabs, some_rows
from swiftwrf.errors import InputError, ranges
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import checked

MAX_TURN = math.radians(45)  # a larger one is an error of frames, not of mounting
MAX_SHIFT_M = 0.5  # a larger one, too
SINGULAR = 1e-9  # relative eigenvalue below which a matrix is singular
CLEAR_SHARE = 0.5  # of the received power, along a clear line of sight


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`.

    Values of a part that was not estimated are 0, and so are their standard errors.

    Args:
        phase: Phase of each element relative to the first, float64 (K,) [rad] in [-pi, pi].
        phase_std: Standard error of the phases, (K,) [rad]; 0 for the first.
        turn: Rotation from the declared to the estimated orientation, a rotation vector in array coordinates, (3,) [rad].
        turn_std: Standard error of the rotation vector, (3,) [rad].
        shift: Vector from the declared to the estimated position in world coordinates, (3,) [m].
        shift_std: Standard error of the shift, (3,) [m].
        before: Fraction of the received power along the line of sight without the calibration, mean over held-out positions.
        after: The fraction with the calibration.
        clear: Number of positions with a clear line of sight.

    Example:
        >>> zero, step = torch.zeros(3), torch.tensor([0.0, 0.0, 0.1])
        >>> found = Calibration(torch.zeros(4), torch.zeros(4), step, zero, zero, zero, before=0.4, after=0.9, clear=50)
        >>> found.after > found.before
        True
    """

    phase: Tensor
    phase_std: Tensor
    turn: Tensor
    turn_std: Tensor
    shift: Tensor
    shift_std: Tensor
    before: float
    after: float
    clear: int

    def apply(self, snapshots: Snapshots) -> Snapshots:
        """Return the snapshots with corrected phases of the elements, orientation and position of the array."""
        correction = unit_phasor(-self.phase).to(torch.complex64)
        return replace(
            snapshots,
            channel=snapshots.channel * correction,
            rotation=snapshots.rotation @ rotation_matrix(self.turn),
            fixed_position=snapshots.fixed_position + self.shift,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values, angles in degrees and lengths in metres."""
        angles = {name: getattr(self, name).rad2deg().tolist() for name in ("phase", "phase_std", "turn", "turn_std")}
        return {f"{name}_deg": values for name, values in angles.items()} | {
            "shift_m": self.shift.tolist(),
            "shift_std_m": self.shift_std.tolist(),
            "line_of_sight_share_before": self.before,
            "line_of_sight_share_after": self.after,
            "clear_positions": self.clear,
        }


@single_thread()
@checked
def calibrate(train: Snapshots, estimate: Sequence[CalibrationPart] = PHASES_AND_ORIENTATION) -> Calibration:
    """Estimate the phases of the elements, the orientation and the position of the array, or some of these.

    Args:
        train: Snapshots of training positions. Those without line of sight are omitted.
        estimate: Parts to estimate, of "phases", "orientation" and "position". The others are taken as declared. A
            position is estimated within 0.5 m of the declared one, an orientation within 45 degrees.

    Raises:
        InputError: No part, fewer than 20 positions with line of sight, or fewer than 10 where the direct path dominates.
            Phases that do not depend on the position, and an array too far from its declared pose. A part that the data do
            not determine, such as the orientation of a linear array.

    Example:
        >>> array = PlanarArray.square(3, 2.4e9)
        >>> position = torch.tensor([1.0, 0.5, 0.5]) + torch.tensor([4.0, 4.0, 2.0]) * torch.rand(60, 3)
        >>> direction = position / position.norm(dim=1, keepdim=True)
        >>> wrong = torch.linspace(0, 2, 9)  # phase of each element [rad]
        >>> channel = torch.polar(torch.ones(60, 9), array.phase(direction.double()).float() + wrong)
        >>> fixed, rotation = torch.zeros(3), torch.eye(3)
        >>> data = Snapshots(channel, position, array=array, fixed_position=fixed, rotation=rotation)
        >>> bool((calibrate(data).phase - wrong).abs().max() < 0.01)
        True
        >>> calibrate(data, ["phases"]).turn.tolist()
        [0.0, 0.0, 0.0]
    """
    if not estimate:
        raise InputError(f"a calibration estimates one part or more of {', '.join(get_args(CalibrationPart))}")
    seen = train.subset(train.line_of_sight.nonzero()[:, 0])
    if len(seen) < 2 * MIN_TRAINING:
        raise InputError(
            f"{train.name} has {len(seen)} training positions with line of sight; a calibration needs at least "
            f"{2 * MIN_TRAINING}"
        )
    if train.array.axis is not None and "orientation" in estimate:
        raise InputError(
            f"the elements of {train.name} lie on a line, which receives the angle to its axis only, so the array's "
            "orientation cannot be estimated; estimate the phases alone, with a known orientation"
        )
    if bool(elements.constant_phases(seen).any()):
        raise InputError(
            f"the phases between the elements of {train.name} hardly depend on the position, so they do not contain the "
            "direction of the line of sight"
        )
    received = of_unit_power(unit(seen.channel))
    strongest = torch.linalg.eigh(received).eigenvectors[..., -1]
    k, pose = len(seen.array.element), (seen.fixed_position, seen.rotation)
    free = torch.tensor(
        [False, *["phases" in estimate] * (k - 1), *["orientation" in estimate] * 3, *["position" in estimate] * 3]
    )
    # in the simulated office, weights that are not sharp lower the errors of single parts and of positions by 3 to 33 %
    sharp = {*estimate} == {*PHASES_AND_ORIENTATION}
    problem = _Problem(seen.array, *pose, free, seen.position, received, strongest, sharp)
    start, near = problem.scan(), float(seen.away.norm(dim=1).min()) < seen.array.far_field_m
    waves = [problem, replace(problem, curved=True)] if near else [problem]
    fits = [(each, each.descend(start)) for each in waves]
    problem, found = max(fits, key=lambda fit: float(fit[0].shares(fit[1]).mean()))
    if (turn := float(found.turn.norm())) > MAX_TURN:
        raise InputError(
            f"the phases of {train.name} fit best with the array turned by {math.degrees(turn):.0f} degrees; beyond "
            f"{math.degrees(MAX_TURN):.0f} degrees that is an error of frames, not of mounting, so nothing is calibrated"
        )
    clear = int((problem.shares(found) >= CLEAR_SHARE).sum())
    if clear < MIN_TRAINING:
        limits = {
            "phases": "any phases",
            "orientation": f"a turn up to {math.degrees(MAX_TURN):.0f} degrees",
            "position": f"a shift up to {MAX_SHIFT_M} m",
        }
        raise InputError(
            f"{train.name} has {clear} positions where a direct path stands out, with "
            f"{' and '.join(limits[part] for part in estimate)}; a calibration needs at least {MIN_TRAINING} (is the frame "
            "right?)"
        )
    std = problem.standard_errors(found)
    if unknown := _not_determined(std):
        direction = functional.normalize(seen.away, dim=1)
        cone = float(angular_distance(direction, direction.mean(dim=0).expand_as(direction)).median())
        reason = "phases change from position to position as no direct path explains"
        if noise := elements.noisy_elements(seen, seen.away @ rotation_matrix(found.turn)):
            reason = elements.in_noise(noise)
        elif "position" in estimate:
            reason = "measure positions near the array and in many directions from it"
        elif cone < math.radians(20) and clear >= len(seen) / 2:
            reason = "measure positions in more directions from the array"
        raise InputError(f"{train.name} does not determine {' and '.join(unknown)}; {reason}")
    if (shift := float(found.shift.norm())) > MAX_SHIFT_M:
        raise InputError(
            f"the phases of {train.name} fit best with the array {shift:.1f} m from its declared position; beyond "
            f"{MAX_SHIFT_M} m that is an error of frames, not of mounting, so nothing is calibrated"
        )
    before, after = problem.held_out(found, slabs(seen.position, FOLDS))
    if after < before - 0.02:
        raise InputError(
            f"a calibration of {train.name} does harm at held-out positions: {before:.0%} of the received power arrives "
            f"along the line of sight without, {after:.0%} with it"
        )
    phase = wrap(found.phase - found.phase[0])
    return Calibration(phase, std.phase, found.turn, std.turn, found.shift, std.shift, before, after, clear)


def _not_determined(std: _Found) -> list[str]:
    """Return what has standard errors above 3 degrees of turn, 0.1 m of shift or 30 degrees of phase, in words."""
    unknown = []
    if float(std.turn.max()) > math.radians(3):
        axis, error = "xyz"[int(std.turn.argmax())], math.degrees(float(std.turn.max()))
        unknown.append(f"the rotation about its {axis} axis (standard error {error:.1f} degrees)")
    if float(std.shift.max()) > 0.1:
        axis, error = "xyz"[int(std.shift.argmax())], float(std.shift.max())
        unknown.append(f"the position of the array along {axis} (standard error {error:.2g} m)")
    if numbers := (std.phase > math.radians(30)).nonzero()[:, 0].tolist():
        error = math.degrees(float(std.phase.max()))
        unknown.append(f"the phases of elements {ranges(numbers)}, counted from 0 (standard error {error:.1f} degrees)")
    return unknown


class _Found(NamedTuple):
    """Phases (K,) [rad], a rotation vector (3,) [rad] and a shift (3,) [m], or standard errors of these."""

    phase: Tensor
    turn: Tensor
    shift: Tensor

    @classmethod
    def of(cls, values: Tensor) -> _Found:
        """Return the parts of a vector (K + 6,)."""
        return cls(values[:-6], values[-6:-3], values[-3:])

    def changed(self, step: Tensor) -> _Found:
        """Return these values after a change (K + 6,)."""
        by = _Found.of(step)
        turn = Rotation.from_rotvec(self.turn.numpy()) * Rotation.from_rotvec(by.turn.numpy())
        return _Found(self.phase + by.phase, torch.from_numpy(turn.as_rotvec()), self.shift + by.shift)

    def change_to(self, other: _Found) -> Tensor:
        """Return the change (K + 6,) that leads to other values."""
        turn = Rotation.from_rotvec(self.turn.numpy()).inv() * Rotation.from_rotvec(other.turn.numpy())
        parts = wrap(other.phase - self.phase), torch.from_numpy(turn.as_rotvec()), other.shift - self.shift
        return torch.cat(parts)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Covariances of the phases at positions (n, 3) of the transmitter, and the declared pose of the array.

    Covariances (n, K, K) have the principal eigenvectors (n, K). Of K phases, a rotation vector and a shift, `free` (K + 6,)
    are estimated. Waves are plane, or spheres if `curved`. Sharp weights fall with the power of reflections. They are better
    against noise, but reflections in phase with the direct path bias them.
    """

    array: PlanarArray
    fixed_position: Tensor
    rotation: Tensor
    free: Tensor
    position: Tensor
    covariance: Tensor
    strongest: Tensor
    sharp: bool
    curved: bool = False

    def subset(self, rows: Tensor) -> _Problem:
        values = {name: getattr(self, name)[rows] for name in ("position", "covariance", "strongest")}
        return replace(self, **values)

    @property
    def nothing(self) -> _Found:
        """The declared values."""
        return _Found.of(torch.zeros(len(self.free), dtype=torch.float64))

    def scan(self) -> _Found:
        """Return the best of the scanned rotations or shifts, with its phases."""
        sample = self.subset(some_rows(len(self.position), 150))
        phases, turned, shifted = (bool(part.any()) for part in _Found.of(self.free))
        starts = [self.nothing]
        if turned:  # a cubic grid of a third of the beam of a 4 x 4 array; it absorbs the mean of a shift
            starts = [self.nothing._replace(turn=turn) for turn in _ball(MAX_TURN, math.radians(9))]
        elif shifted:
            starts = [self.nothing._replace(shift=shift) for shift in _ball(MAX_SHIFT_M, MAX_SHIFT_M / 3)]
        steering = (sample._steering(start) for start in starts)
        totals = torch.stack([torch.einsum("nab,na,nb->ab", sample.covariance, a.conj(), a) for a in steering])
        if not phases:
            return starts[int(totals.sum(dim=(1, 2)).real.argmax())]
        power, vector = torch.linalg.eigh(totals)  # the phases that maximise the power along the line of sight
        best = int(power[:, -1].argmax())
        return starts[best]._replace(phase=vector[best, :, -1].angle())

    def descend(self, found: _Found) -> _Found:
        """Minimise the residual phases by Gauss-Newton steps, reweighted in each."""
        for _ in range(40):
            normal, score = self._system(found)
            step = torch.zeros(len(self.free), dtype=torch.float64)
            step[self.free] = torch.linalg.pinv(normal, rtol=SINGULAR, hermitian=True) @ score
            found = found.changed(step)
            if float(step.abs().max()) < 1e-6:
                break
        return found

    def _system(self, found: _Found) -> tuple[Tensor, Tensor]:
        """Return the normal equations (p, p), (p,) of residual phases for changes of what is free."""
        residual = self.strongest * self._response(found).conj()
        residual = (residual * residual.sum(1, keepdim=True).conj()).angle()
        n, k = residual.shape
        away, turn = self._away(found), rotation_matrix(found.turn)
        axes = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
        by_turn = torch.linalg.cross(away[:, None].expand(n, 3, 3), axes, dim=-1)  # of exp(-[t]) v at t = 0: v x t
        by_shift = -(self.rotation @ turn).expand(n, 3, 3)  # one row for each axis of the world
        by_pose = torch.cat([by_turn, by_shift], dim=1) @ self._slope(away).mT
        by_phase = torch.eye(k, dtype=torch.float64).expand(n, k, k)
        jacobian = torch.cat([by_phase, by_pose.mT], dim=-1)[..., self.free]
        jacobian = jacobian - jacobian.mean(dim=1, keepdim=True)  # the phase of the whole is free
        residual = residual - residual.mean(dim=1, keepdim=True)
        share = self.shares(found)
        weight = (share / CLEAR_SHARE).clamp(0, 1) ** 4
        if self.sharp:
            # phases err in proportion to the fraction 1 - share of the power that does not arrive along the direct path
            weight = weight / (1.02 - share) ** 2
        weighted = weight[:, None, None] * jacobian
        return torch.einsum("nkp,nkq->pq", weighted, jacobian), torch.einsum("nkp,nk->p", weighted, residual)

    def shares(self, found: _Found) -> Tensor:
        """Return the fraction of the received power at each position that arrives along the line of sight, (n,)."""
        response = self._response(found)
        return torch.einsum("na,nab,nb->n", response.conj(), self.covariance, response).real / len(found.phase) ** 2

    def _response(self, found: _Found) -> Tensor:
        """Return the response to the direct path alone, (n, K)."""
        return self._steering(found) * unit_phasor(found.phase)

    def _away(self, found: _Found) -> Tensor:
        """Return the vectors from the array to the transmitter in array coordinates, (n, 3) [m]."""
        return (self.position - (self.fixed_position + found.shift)) @ self.rotation @ rotation_matrix(found.turn)

    def _steering(self, found: _Found) -> Tensor:
        away = self._away(found)
        return unit_phasor(
            self.array.phase_at(away) if self.curved else self.array.phase(functional.normalize(away, dim=1))
        )

    def _slope(self, away: Tensor) -> Tensor:
        """Return the gradient (n, K, 3) [rad/m] of the phase at each element for vectors to the transmitter (n, 3) [m]."""
        element = functional.pad(self.array.element, (0, 1)).double()
        distance = away.norm(dim=1)[:, None, None]
        direction = away[:, None] / distance
        if self.curved:
            slope = direction - functional.normalize(away[:, None] - element, dim=-1)
        else:
            slope = (element - direction * (direction @ element.T).mT) / distance
        gradient: Tensor = math.tau / self.array.wavelength * slope
        return gradient

    def standard_errors(self, found: _Found) -> _Found:
        """Return the jackknife standard errors, infinite where something is not identifiable."""
        normal, _ = self._system(found)
        if torch.linalg.matrix_rank(normal, rtol=SINGULAR, hermitian=True) < len(normal):
            return _Found.of(torch.where(self.free, math.inf, 0.0).double())
        group = slabs(self.position, min(20, len(self.position)))
        change = [found.change_to(self.subset(kept).descend(found)) for _, kept in each_fold(group)]
        spread, count = torch.stack(change), len(change)
        return _Found.of(((count - 1) / count * (spread - spread.mean(dim=0)).square().sum(dim=0)).sqrt())

    def held_out(self, found: _Found, fold: Tensor) -> tuple[float, float]:
        """Return the mean fraction along the line of sight at held-out positions, without and with a calibration."""
        after = torch.empty(len(fold), dtype=torch.float64)
        for out, kept in each_fold(fold):
            after[out] = self.subset(out).shares(self.subset(kept).descend(found))
        return float(self.shares(self.nothing).mean()), float(after.mean())


def _ball(radius: float, step: float) -> Tensor:
    """Return the points (m, 3) of a cubic grid around 0 within a radius."""
    line = torch.arange(-radius, radius + step / 2, step, dtype=torch.float64)
    points = torch.cartesian_prod(line, line, line)
    return points[points.norm(dim=1) <= radius + 1e-9]
