"""Calibration of an array: phases of its elements and its orientation, from positions with line of sight.

Cables and receivers add an unknown phase to each element, and arrays are mounted with an error of a few degrees. If the
transmitter's position is known, so is the direct path: a_k = exp(j phi_k + j 2 pi e_k . d / wavelength) at element k, with
direction d in array coordinates. The estimate maximises the received power along the direct paths,

    J(phi, turn) = sum_i w_i a_i^H C_i a_i / K^2,    C_i: covariance of the phases at position i.

It starts from a scan over rotations, for each of which phi is the principal eigenvector of the rotated covariances, and
continues by least squares of the residual phases. Positions without a clear direct path lose their weight.

Standard errors come from a block jackknife over neighbourhoods, because multipath errors of neighbouring positions are
correlated (J. W. Tukey, Ann. Math. Statist. 29, 1958). They do not include bias from a reflection common to all positions,
e.g. the floor, which can be one to two standard errors. An unidentifiable rotation is refused: that of a linear array about
its axis, or any rotation if all positions lie in a narrow cone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import angular_distance, rotation_matrix, wrap
from swiftwrf.array.beamforming import of_unit_power, unit, unit_phasor
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.diagnostics import elements
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.splits import FOLDS, MIN_TRAINING, each_fold, slabs, some_rows
from swiftwrf.errors import InputError, ranges
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import checked

MAX_TURN = math.radians(45)  # a larger one is an error of frames, not of mounting
SINGULAR = 1e-9  # relative eigenvalue below which a matrix is singular
CLEAR_SHARE = 0.5  # of the received power, along a clear line of sight


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`.

    Args:
        phase: Phase of each element relative to the first, float64 (K,) [rad] in [-pi, pi].
        phase_std: Standard error of the phases, (K,) [rad]; 0 for the first.
        turn: Rotation from the declared to the estimated orientation, a rotation vector in array coordinates, (3,) [rad].
        turn_std: Standard error of the rotation vector, (3,) [rad].
        before: Fraction of the received power along the line of sight without the calibration, mean over held-out positions.
        after: The fraction with the calibration.
        clear: Number of positions with a clear line of sight.

    Example:
        >>> zero, step = torch.zeros(3), torch.tensor([0.0, 0.0, 0.1])
        >>> found = Calibration(torch.zeros(4), torch.zeros(4), step, zero, before=0.4, after=0.9, clear=50)
        >>> found.after > found.before
        True
    """

    phase: Tensor
    phase_std: Tensor
    turn: Tensor
    turn_std: Tensor
    before: float
    after: float
    clear: int

    def apply(self, snapshots: Snapshots) -> Snapshots:
        """Return the snapshots with corrected phases of the elements and orientation of the array."""
        correction = unit_phasor(-self.phase).to(torch.complex64)
        return replace(
            snapshots, channel=snapshots.channel * correction, rotation=snapshots.rotation @ rotation_matrix(self.turn)
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values, angles in degrees."""
        angles = {name: getattr(self, name).rad2deg().tolist() for name in ("phase", "phase_std", "turn", "turn_std")}
        return {f"{name}_deg": values for name, values in angles.items()} | {
            "line_of_sight_share_before": self.before,
            "line_of_sight_share_after": self.after,
            "clear_positions": self.clear,
        }


@single_thread()
@checked
def calibrate(train: Snapshots) -> Calibration:
    """Estimate the phases of the elements and the orientation of the array.

    Args:
        train: Snapshots of training positions. Those without line of sight are omitted.

    Raises:
        InputError: Fewer than 20 positions with line of sight, fewer than 10 where the direct path dominates, a linear
            array, phases that do not depend on the position, a rotation beyond 45 degrees or one that is not identifiable.

    Example:
        >>> array = PlanarArray.square(3, 2.4e9)
        >>> position = torch.tensor([1.0, 0.5, 0.5]) + torch.tensor([4.0, 4.0, 2.0]) * torch.rand(60, 3)
        >>> direction = position / position.norm(dim=1, keepdim=True)
        >>> wrong = torch.linspace(0, 2, 9)  # phase of each element [rad]
        >>> channel = torch.polar(torch.ones(60, 9), array.phase(direction.double()).float() + wrong)
        >>> fixed, rotation = torch.zeros(3), torch.eye(3)
        >>> found = calibrate(Snapshots(channel, position, array=array, fixed_position=fixed, rotation=rotation))
        >>> bool((found.phase - wrong).abs().max() < 0.01)
        True
    """
    seen = train.subset(train.line_of_sight.nonzero()[:, 0])
    if len(seen) < 2 * MIN_TRAINING:
        raise InputError(
            f"{train.name} has {len(seen)} training positions with line of sight; a calibration needs at least "
            f"{2 * MIN_TRAINING}"
        )
    if train.array.axis is not None:
        raise InputError(
            f"the elements of {train.name} lie on a line, which receives the angle to its axis only, so the array's "
            "orientation cannot be estimated"
        )
    if bool(elements.constant_phases(seen).any()):
        raise InputError(
            f"the phases between the elements of {train.name} hardly depend on the position, so they do not contain the "
            "direction of the line of sight"
        )
    received = of_unit_power(unit(seen.channel))
    strongest = torch.linalg.eigh(received).eigenvectors[..., -1]
    problem = _Problem(seen.array, seen.position, seen.away, received, strongest)
    start, near = problem.scan(), float(problem.away.norm(dim=1).min()) < seen.array.far_field_m
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
        raise InputError(
            f"{train.name} has {clear} positions where a direct path stands out, with any phases and turn up to "
            f"{math.degrees(MAX_TURN):.0f} degrees; a calibration needs at least {MIN_TRAINING} (is the frame right?)"
        )
    phase_std, turn_std = problem.standard_errors(found)
    turn_deg, phase_deg = (math.degrees(float(std.max())) for std in (turn_std, phase_std))
    open_ones = []
    if turn_deg > 3:
        axis = "xyz"[int(turn_std.argmax())]
        open_ones.append(f"the rotation about its {axis} axis (standard error {turn_deg:.1f} degrees)")
    if loose := (phase_std > math.radians(30)).nonzero()[:, 0].tolist():
        error = f"standard error {phase_deg:.1f} degrees"
        open_ones.append(f"the phases of elements {ranges(loose)}, counted from 0 ({error})")
    if open_ones:
        mean = problem.direction.mean(dim=0).expand_as(problem.direction)
        cone = float(angular_distance(problem.direction, mean).median())
        reason = "phases change from position to position as no direct path explains"
        if noise := elements.noisy_elements(seen, problem.away @ rotation_matrix(found.turn)):
            reason = elements.in_noise(noise)
        elif cone < math.radians(20) and clear >= len(seen) / 2:
            reason = "measure positions in more directions from the array"
        raise InputError(f"{train.name} does not determine {' and '.join(open_ones)}; {reason}")
    before, after = problem.held_out(found, slabs(seen.position, FOLDS))
    if after < before - 0.02:
        raise InputError(
            f"a calibration of {train.name} does harm at held-out positions: {before:.0%} of the received power arrives "
            f"along the line of sight without, {after:.0%} with it"
        )
    return Calibration(wrap(found.phase - found.phase[0]), phase_std, found.turn, turn_std, before, after, clear)


class _Found(NamedTuple):
    phase: Tensor  # (K,)
    turn: Tensor  # (3,)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Covariances of the phases and directions of the line of sight.

    Covariances (n, K, K) have the principal eigenvectors (n, K). Vectors away from the array (n, 3) are in its declared
    coordinates. Waves are plane, or spheres if `curved`.
    """

    array: PlanarArray
    position: Tensor
    away: Tensor
    covariance: Tensor
    strongest: Tensor
    curved: bool = False

    @property
    def direction(self) -> Tensor:
        """Unit vectors of the line of sight, (n, 3)."""
        return functional.normalize(self.away, dim=1)

    def subset(self, rows: Tensor) -> _Problem:
        values = {name: getattr(self, name)[rows] for name in ("position", "away", "covariance", "strongest")}
        return replace(self, **values)

    def scan(self) -> _Found:
        """Return the best of the scanned rotations, with its phases."""
        few = self.subset(some_rows(len(self.away), 150))
        # a cubic grid of a third of the beam of a 4 x 4 array within the largest rotation
        step = math.radians(9)
        line = torch.arange(-MAX_TURN, MAX_TURN + step / 2, step, dtype=torch.float64)
        turns = torch.cartesian_prod(line, line, line)
        turns = turns[turns.norm(dim=1) <= MAX_TURN + 1e-9]
        steering = (few._steering(turn) for turn in turns)
        totals = torch.stack([torch.einsum("nab,na,nb->ab", few.covariance, a.conj(), a) for a in steering])
        power, vector = torch.linalg.eigh(totals)  # the phases that maximise the power along the line of sight
        best = int(power[:, -1].argmax())
        return _Found(vector[best, :, -1].angle(), turns[best])

    def descend(self, found: _Found) -> _Found:
        """Minimise the residual phases by Gauss-Newton steps, reweighted in each."""
        for _ in range(40):
            normal, score = self._system(found)
            step = torch.linalg.pinv(normal, rtol=SINGULAR, hermitian=True) @ score
            turned = Rotation.from_rotvec(found.turn.numpy()) * Rotation.from_rotvec(step[-3:].numpy())
            phase = found.phase + torch.cat([torch.zeros(1, dtype=torch.float64), step[:-3]])
            found = _Found(phase, torch.from_numpy(turned.as_rotvec()))
            if float(step.abs().max()) < 1e-6:
                break
        return found

    def _system(self, found: _Found) -> tuple[Tensor, Tensor]:
        """Return the normal equations (p, p), (p,) of residual phases for changes of all phases but one, and of rotation."""
        residual = self.strongest * self._response(found).conj()
        residual = (residual * residual.sum(1, keepdim=True).conj()).angle()
        n, k = residual.shape
        turned = self.direction @ rotation_matrix(found.turn)
        axes = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
        slope = torch.linalg.cross(turned[:, None].expand(n, 3, 3), axes, dim=-1)  # of exp(-[t]) d at t = 0: d x t
        by_phase = torch.eye(k, dtype=torch.float64)[:, 1:].expand(n, k, k - 1)
        jacobian = torch.cat([by_phase, self.array.phase(slope).mT], dim=-1)
        jacobian = jacobian - jacobian.mean(dim=1, keepdim=True)  # the phase of the whole is free
        residual = residual - residual.mean(dim=1, keepdim=True)
        share = self.shares(found)
        # phases err in proportion to the fraction 1 - share of the power that does not arrive along the direct path
        weight = (share / CLEAR_SHARE).clamp(0, 1) ** 4 / (1.02 - share) ** 2
        weighted = weight[:, None, None] * jacobian
        return torch.einsum("nkp,nkq->pq", weighted, jacobian), torch.einsum("nkp,nk->p", weighted, residual)

    def shares(self, found: _Found) -> Tensor:
        """Return the fraction of the received power at each position that arrives along the line of sight, (n,)."""
        response = self._response(found)
        return torch.einsum("na,nab,nb->n", response.conj(), self.covariance, response).real / len(found.phase) ** 2

    def _response(self, found: _Found) -> Tensor:
        """Return the response to the direct path alone, (n, K)."""
        return self._steering(found.turn) * unit_phasor(found.phase)

    def _steering(self, turn: Tensor) -> Tensor:
        away = self.away @ rotation_matrix(turn)
        return unit_phasor(
            self.array.phase_at(away) if self.curved else self.array.phase(functional.normalize(away, dim=1))
        )

    def standard_errors(self, found: _Found) -> tuple[Tensor, Tensor]:
        """Return the jackknife standard errors of the phases (K,) and of the rotation (3,), infinite if not identifiable."""
        normal, _ = self._system(found)
        if torch.linalg.matrix_rank(normal, rtol=SINGULAR, hermitian=True) < len(normal):
            return torch.full_like(found.phase, math.inf), torch.full_like(found.turn, math.inf)
        group = slabs(self.position, min(20, len(self.position)))
        away = []
        for _, kept in each_fold(group):
            other = self.subset(kept).descend(found)
            turn = Rotation.from_rotvec(found.turn.numpy()).inv() * Rotation.from_rotvec(other.turn.numpy())
            away.append(torch.cat([wrap(other.phase - found.phase), torch.from_numpy(turn.as_rotvec())]))
        spread, count = torch.stack(away), len(away)
        deviation = ((count - 1) / count * (spread - spread.mean(dim=0)).square().sum(dim=0)).sqrt()
        return deviation[:-3], deviation[-3:]

    def held_out(self, found: _Found, fold: Tensor) -> tuple[float, float]:
        """Return the mean fraction along the line of sight at held-out positions, without and with a calibration."""
        nothing = _Found(torch.zeros_like(found.phase), torch.zeros_like(found.turn))
        after = torch.empty(len(fold), dtype=torch.float64)
        for out, kept in each_fold(fold):
            after[out] = self.subset(out).shares(self.subset(kept).descend(found))
        return float(self.shares(nothing).mean()), float(after.mean())
