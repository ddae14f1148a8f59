"""Phases of an array's elements and its orientation, estimated from positions with a clear line of sight.

Cables and receivers add an unknown phase to each element, and arrays are mounted a few degrees off. Where the transmitter's
position is known, so is what the direct path should look like: a_k = exp(j phi_k + j 2 pi e_k . d / wavelength) at element
k, with d the direction turned into array coordinates. The phases phi and the turn that give the direct paths of all
positions the most of what was heard,

    J(phi, turn) = sum_i w_i a_i^H C_i a_i / K^2,    C_i: covariance of the phases at position i,

are found by a scan over turns, for each of which phi is the principal eigenvector of the turned covariances, and by least
squares of the residual phases from the best. Positions without a clear direct path lose their weight. Deviations are those
of the jackknife that leaves out a neighbourhood at a time, for multipath errs alike at neighbouring positions (J. W. Tukey,
Ann. Math. Statist. 29, 1958). They do not cover a reflection that is there at all positions, as from a floor, which shifts
the estimate by as much again or twice as much.

What cannot be told is refused: an array on a line does not see a turn about it, and positions in a narrow cone make a turn
look like phases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from swiftwrf.array.angles import wrap
from swiftwrf.array.beamforming import covariance
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.splits import FOLDS, MIN_TRAINING, slabs
from swiftwrf.errors import InputError
from swiftwrf.runtime.threads import single_thread

LARGEST = math.radians(45)  # turn that is looked for: a larger one is an error of frames, not of mounting
STEP = math.radians(9)  # of the scan: a third of the beam of a 4 x 4 array
SCANNED = 150  # positions of the scan
STEPS, SETTLED = 40, 1e-6  # of the descent, the last one [rad]
SINGULAR = 1e-9  # relative: smaller eigenvalues are nothing
CLEAR = 0.5  # of what is heard from the direct path counts as a clear line of sight
NEIGHBOURHOODS = 20
WORSE = 0.02  # in the share at positions held out, that is no chance
MOST_DEVIATION = math.radians(3), math.radians(30)  # of the turn and of a phase: beyond, the data cannot tell


@dataclass(frozen=True, eq=False)
class Calibration:
    """What `calibrate` found.

    Args:
        phase: of each element beyond that of the first, float64 (K,) [rad] in [-pi, pi].
        phase_std: its deviation, (K,) [rad]; 0 for the first.
        turn: from the declared to the estimated orientation, rotation vector in array coordinates, float64 (3,) [rad].
        turn_std: its deviation, (3,) [rad].
        before, after: share of what is heard that comes along the line of sight, mean over positions held out; without and
            with the calibration.
        clear: number of positions with a clear line of sight that were used.
    """

    phase: Tensor
    phase_std: Tensor
    turn: Tensor
    turn_std: Tensor
    before: float
    after: float
    clear: int

    def apply(self, snapshots: Snapshots) -> Snapshots:
        """The snapshots with the elements' phases taken out and the array turned."""
        correction = _unit(-self.phase).to(torch.complex64)
        return replace(
            snapshots,
            channel=snapshots.channel * correction,
            rotation=snapshots.rotation @ _matrix(self.turn),
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values, angles in degrees."""
        angles = {name: getattr(self, name).rad2deg().tolist() for name in ("phase", "phase_std", "turn", "turn_std")}
        return {f"{name}_deg": values for name, values in angles.items()} | {
            "line_of_sight_share_before": self.before,
            "line_of_sight_share_after": self.after,
            "clear_positions": self.clear,
        }


@single_thread()
def calibrate(train: Snapshots) -> Calibration:
    """Estimates the phases of the elements and the orientation of the array.

    Args:
        train: training positions; those known to be without line of sight are left out.

    Raises:
        InputError: too few positions with a clear line of sight, or data that cannot tell.
    """
    seen = train.subset(train.line_of_sight.nonzero()[:, 0])
    if len(seen) < 2 * MIN_TRAINING:
        raise InputError(
            f"{train.name} has {len(seen)} training positions with line of sight; a calibration needs at least "
            f"{2 * MIN_TRAINING}"
        )
    problem = _Problem.of(seen)
    found = problem.descend(problem.scan())
    clear = int((problem.shares(found) >= CLEAR).sum())
    if clear < MIN_TRAINING:
        raise InputError(
            f"{train.name} has {clear} positions where a direct path stands out, with any phases and turn up to "
            f"{math.degrees(LARGEST):.0f} degrees; a calibration needs at least {MIN_TRAINING} (is the frame right?)"
        )
    phase_std, turn_std = problem.deviations(found)
    if float(turn_std.max()) > MOST_DEVIATION[0] or float(phase_std.max()) > MOST_DEVIATION[1]:
        raise InputError(
            f"the positions of {train.name} cannot tell the array's orientation from its elements' phases (deviations "
            f"{math.degrees(float(turn_std.max())):.1f} and {math.degrees(float(phase_std.max())):.0f} degrees); measure "
            "positions in more directions from the array"
        )
    before, after = problem.held_out(found, slabs(seen.position, FOLDS))
    if after < before - WORSE:
        raise InputError(
            f"a calibration of {train.name} does harm at positions held out: {before:.0%} of what is heard comes along the "
            f"line of sight without, {after:.0%} with it"
        )
    return Calibration(wrap(found.phase - found.phase[0]), phase_std, found.turn, turn_std, before, after, clear)


@dataclass(frozen=True, eq=False)
class _Found:
    phase: Tensor  # (K,)
    turn: Tensor  # (3,)


class _System(NamedTuple):
    """Weighted least squares of the residual phases for a small change of the phases but the first, and of the turn."""

    normal: Tensor  # (p, p)
    score: Tensor  # (p,)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Covariances of the phases (n, K, K), their principal eigenvectors (n, K), and directions of the line of sight in
    declared array coordinates (n, 3)."""

    array: PlanarArray
    position: Tensor
    direction: Tensor
    covariance: Tensor
    strongest: Tensor

    @classmethod
    def of(cls, data: Snapshots) -> _Problem:
        heard = covariance(_unit(data.channel.angle().double()))
        return cls(data.array, data.position, data.direction, heard, torch.linalg.eigh(heard).eigenvectors[..., -1])

    def subset(self, rows: Tensor) -> _Problem:
        return _Problem(
            self.array, self.position[rows], self.direction[rows], self.covariance[rows], self.strongest[rows]
        )

    def scan(self) -> _Found:
        """The best of turns all over the ball, with its phases."""
        few = self.subset(torch.linspace(0, len(self.direction) - 1, min(SCANNED, len(self.direction))).round().long())
        _, phase, turn = max(((*few._phases(turn), turn) for turn in _turns()), key=lambda found: found[0])
        return _Found(phase, turn)

    def _phases(self, turn: Tensor) -> tuple[float, Tensor]:
        """The share along the line of sight at this turn, over all positions, and phases (K,) that give the most."""
        steering = self._steering(turn)
        total = torch.einsum("nab,na,nb->ab", self.covariance, steering.conj(), steering)
        value, vector = torch.linalg.eigh(total)
        return float(value[-1]), vector[:, -1].angle()

    def descend(self, found: _Found) -> _Found:
        """Gauss-Newton steps on the residual phases, their weights renewed in each."""
        for _ in range(STEPS):
            system = self._system(found)
            step = torch.linalg.pinv(system.normal, rtol=SINGULAR, hermitian=True) @ system.score
            turned = Rotation.from_rotvec(found.turn.numpy()) * Rotation.from_rotvec(step[-3:].numpy())
            phase = found.phase + torch.cat([torch.zeros(1, dtype=torch.float64), step[:-3]])
            found = _Found(phase, torch.from_numpy(turned.as_rotvec()))
            if float(step.abs().max()) < SETTLED:
                break
        return found

    def _system(self, found: _Found) -> _System:
        residual = self.strongest * self._response(found).conj()
        residual = (residual * residual.sum(1, keepdim=True).conj()).angle()
        n, k = residual.shape
        turned = self.direction @ _matrix(found.turn)
        axes = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
        slope = torch.linalg.cross(turned[:, None].expand(n, 3, 3), axes, dim=-1)  # of exp(-[t]) d at t = 0: d x t
        by_phase = torch.eye(k, dtype=torch.float64)[:, 1:].expand(n, k, k - 1)
        jacobian = torch.cat([by_phase, self.array.phase(slope).mT], dim=-1)
        jacobian = jacobian - jacobian.mean(dim=1, keepdim=True)  # the phase of the whole is free
        residual = residual - residual.mean(dim=1, keepdim=True)
        share = self.shares(found)
        # beside the direct path lies 1 - share of the power, whose phases err in proportion
        weight = (share / CLEAR).clamp(0, 1) ** 4 / (1.02 - share) ** 2
        weighted = weight[:, None, None] * jacobian
        return _System(
            normal=torch.einsum("nkp,nkq->pq", weighted, jacobian),
            score=torch.einsum("nkp,nk->p", weighted, residual),
        )

    def shares(self, found: _Found) -> Tensor:
        """Share of what is heard at each position that comes along the line of sight, (n,)."""
        response = self._response(found)
        return torch.einsum("na,nab,nb->n", response.conj(), self.covariance, response).real / len(found.phase) ** 2

    def _response(self, found: _Found) -> Tensor:
        """What the direct path alone would give, (n, K)."""
        return self._steering(found.turn) * _unit(found.phase)

    def _steering(self, turn: Tensor) -> Tensor:
        return _unit(self.array.phase(self.direction @ _matrix(turn)))

    def deviations(self, found: _Found) -> tuple[Tensor, Tensor]:
        """Of the phases (K,) beyond that of the first element, and of the turn (3,), by leaving out one neighbourhood after
        the other; infinite where nothing tells them."""
        normal = self._system(found).normal
        if torch.linalg.matrix_rank(normal, rtol=SINGULAR, hermitian=True) < len(normal):
            return torch.full_like(found.phase, math.inf), torch.full_like(found.turn, math.inf)
        group = slabs(self.position, min(NEIGHBOURHOODS, len(self.position)))
        count = int(group.max()) + 1
        away = []
        for number in range(count):
            other = self.subset(group != number).descend(found)
            turn = Rotation.from_rotvec(found.turn.numpy()).inv() * Rotation.from_rotvec(other.turn.numpy())
            away.append(torch.cat([wrap(other.phase - found.phase), torch.from_numpy(turn.as_rotvec())]))
        spread = torch.stack(away)
        deviation = ((count - 1) / count * (spread - spread.mean(dim=0)).square().sum(dim=0)).sqrt()
        return deviation[:-3], deviation[-3:]

    def held_out(self, found: _Found, fold: Tensor) -> tuple[float, float]:
        """Mean share along the line of sight at positions left out of the descent, without and with a calibration."""
        nothing = _Found(torch.zeros_like(found.phase), torch.zeros_like(found.turn))
        after = torch.empty(len(fold), dtype=torch.float64)
        for number in range(int(fold.max()) + 1):
            out = fold == number
            after[out] = self.subset(out).shares(self.subset(~out).descend(found))
        return float(self.shares(nothing).mean()), float(after.mean())


def _unit(phase: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(phase), phase)


def _matrix(turn: Tensor) -> Tensor:
    """Rotation matrix of a rotation vector (3,)."""
    return torch.from_numpy(Rotation.from_rotvec(turn.numpy()).as_matrix())


def _turns() -> list[Tensor]:
    """Rotation vectors of a cubic grid in the ball of the largest turn."""
    steps = torch.arange(-LARGEST, LARGEST + STEP / 2, STEP, dtype=torch.float64)
    grid = torch.cartesian_prod(steps, steps, steps)
    return list(grid[grid.norm(dim=1) <= LARGEST + 1e-9])
