"""Uncertainty of estimated planes: standard deviations, and rooms that explain the spectra nearly as well.

Phase ambiguity: a plane that moves by half a wavelength / cosine of incidence changes the phase of its wave by a whole
period. A plane that moves by half of that has a wave of the same phase with a gain of the other sign. Observed from a small
region such rooms are nearly equal, and higher-order images keep a single plane from moving while others are wrong. Therefore
all combinations are tried, from the steering responses of single and double reflections: half periods nearby, whole periods
farther away, and half periods around the best of these.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.models.geometry.images import LinkAt, PhaseObservations, PlaneSet, field, images, phase_period_m
from swiftwrf.models.geometry.planes import (
    Plane,
    RoomEstimate,
    advantage,
    correlation_score,
    log_explained,
    offset_covariance,
    refine,
    refine_all,
    sign_alternatives,
)
from swiftwrf.models.geometry.search import SIGNS, SteeringResponses, best_combinations
from swiftwrf.runtime.threads import parallel_map

MIN_PROBABILITY = 1e-6  # of a plane
MIN_RIVAL = 0.01  # of an alternative that is named
MAX_PERIODS = 4  # to either side
N_FIRST, N_NEXT = 6, 18  # positions that all combinations of aliases are scored at, and the best of them
N_WHOLE = 32  # combinations of whole periods around which half periods are tried
N_COARSE, N_FINE = 24, 8  # rooms that are refined with some positions, and with all
HalfPeriods = tuple[int, ...]  # by which each plane is moved


def assess(
    train: Spectra,
    scene: PhaseObservations,
    room: PlaneSet,
    score: float,
    searched: bool,
    *,
    systematic_wavelengths: float = 0.02,
) -> RoomEstimate:
    """Return the planes of a room with their standard deviations, probabilities and strongest alternatives.

    Args:
        train: Training spectra, for the array.
        scene: Observed phases.
        room: Refined planes in world coordinates.
        score: Score at held-out positions.
        searched: True to take the most probable room, also of those in which several planes move. False for planes that
            stay, compared with rooms in which one of them moves.
        systematic_wavelengths: Standard deviation of an offset by paths that the room lacks, if no power is explained. Not
            studied.
    """
    assert train.array is not None
    n_planes = room.normal.shape[1]
    if n_planes:
        period = torch.tensor([phase_period_m(scene, room, plane) for plane in range(n_planes)], dtype=torch.float64)
        beside = parallel_map(lambda plane: _beside(scene, room, plane), range(n_planes))
        others = phase_alternatives(scene, room) if searched else []
        modes, mode_probability = _modes(scene, [room, *others, *itertools.chain(*beside)], period)
        offset = torch.cat([mode.offset for mode in modes])  # (J, P)
        own = int(mode_probability.argmax() if searched else ((offset - room.offset).abs() / period).amax(1).argmin())
        room = refine(scene, modes[own])
    unexplained = 1 - (1 - correlation_score(scene, room, train.array)) ** 2
    if not n_planes:
        nothing = torch.zeros(0, 0, dtype=torch.float64)
        return RoomEstimate([], room.order, score, unexplained, "no plane explains the spectra", nothing)
    covariance = offset_covariance(scene, room)
    # paths that the room lacks are no noise
    systematic = systematic_wavelengths * train.array.wavelength * math.sqrt(max(unexplained, 0))
    covariance = covariance + systematic**2 * torch.eye(n_planes, dtype=torch.float64)
    std = covariance.diagonal().clamp_min(0).sqrt()
    reason = _flat(scene) or _other_carrier(scene, room)
    same = ((offset[:, None] - offset).abs() <= period / 4).double()  # (J, J, P)
    # with a reason against the room, rooms that were not compared count as much as all that were
    inside = torch.erf(period / 4 / (math.sqrt(2) * std)) * (0.5 if reason else 1.0)
    probability = (mode_probability @ same[own] * inside).clamp(MIN_PROBABILITY, 1.0).tolist()
    away = mode_probability[:, None] * (1 - same[own])
    rival, planes = (torch.einsum("kp,jkp->jp", away, same) * (1 - same[own])).max(0), []
    for i in range(n_planes):
        x, y, z = room.normal[0, i].tolist()
        planes.append(
            Plane(
                normal=(x, y, z),
                offset_m=float(room.offset[0, i]),
                gain=float(room.gain[0, i]),
                std_mm=1000 * float(std[i]),
                probability=probability[i],
                rival_m=float(offset[rival.indices[i], i]) if rival.values[i] > MIN_RIVAL else None,
                dielectric=room.dielectric is not None and bool(room.dielectric[i]),
            )
        )
    return RoomEstimate(planes, room.order, score, unexplained, conclusion(planes) + reason, covariance)


def conclusion(planes: list[Plane]) -> str:
    """Return how many planes are identifiable, in words."""
    return f"{len(planes)} planes, {sum(plane.certain for plane in planes)} of them identifiable"


def _modes(
    scene: PhaseObservations, rooms: list[PlaneSet], period: Tensor, *, sign_odds: float = 0.6
) -> tuple[list[PlaneSet], Tensor]:
    """Return the rooms that differ by more than a quarter period (P,) [m] in any plane, and their probabilities (J,).

    Of rooms that differ by less, the one that explains the spectra best counts. Each gain with a sign other than usual
    multiplies the prior probability by `sign_odds`, by the study in docs/development/architecture.md.
    """
    modes: list[PlaneSet] = []
    for room in sorted(rooms, key=lambda room: -float(log_explained(room.coherence(scene)).mean())):
        if all(bool(((room.offset - mode.offset).abs() > period / 4).any()) for mode in modes):
            modes.append(room)
    deviating = [int((r.gain.sign() != SIGNS[:, r.side[0]]).sum(1).min()) for r in modes]
    explained = torch.stack([log_explained(room.coherence(scene)) for room in modes])
    return modes, mode_probabilities(explained, math.log(sign_odds) * torch.tensor(deviating, dtype=torch.float64))


def mode_probabilities(explained: Tensor, log_prior: Tensor) -> Tensor:
    """Return the probabilities of rooms (J,) from how well they explain the spectra at all positions.

    The lead z of one room over another is the mean difference of `log_explained` in standard errors. The log likelihood
    ratio is z |z|, because a Gaussian ratio that is calibrated has a mean in proportion to its variance.

    Args:
        explained: `log_explained` of the rooms, the best one first, (J, n).
        log_prior: Logarithms of the prior probabilities, up to a constant, (J,).

    Example:
        >>> even = torch.tensor([[1.0, 2.0, 1.5, 1.5], [2.0, 1.0, 1.5, 1.5]])
        >>> mode_probabilities(even, torch.zeros(2))
        tensor([0.5000, 0.5000])
    """
    lead = torch.tensor([advantage(explained[0], other) for other in explained], dtype=log_prior.dtype)
    return torch.softmax(log_prior - lead * lead.abs(), dim=0)


def _beside(scene: PhaseObservations, room: PlaneSet, plane: int) -> list[PlaneSet]:
    """Return refined rooms in which one plane is elsewhere.

    It is at the best offset of a scan around it, and at the offsets at which a wave of the other sign has the same phase.
    """
    period = phase_period_m(scene, room, plane)
    step = torch.arange(period / 2, 3.5 * period, 0.4 / scene.wavenumber, dtype=torch.float64)
    beside = torch.cat([-step.flip(0), step])
    offset = room.offset.repeat(len(beside), 1)
    offset[:, plane] += beside
    rest, own = ([s for s in room.sequence if (plane in s) == of_plane] for of_plane in (False, True))
    normal, gain = room.normal.expand(len(offset), -1, -1), room.gain.expand(len(offset), -1)
    scanned = replace(room, normal=normal, offset=offset, gain=gain, only=tuple(own))
    value = scene.score(replace(room, only=tuple(rest)).field(scene) + field(scene, scanned))
    moved = room.offset.clone()
    moved[:, plane] += beside[value.argmin()]
    return refine_all(scene, [replace(room, offset=moved), *sign_alternatives(scene, room, plane)], 5)


def _flat(scene: LinkAt, *, min_spread_rad: float = 0.8) -> str:
    """Return the reason if the positions lie on a line or in a plane, which leaves the room ambiguous, else nothing.

    Positions are flat in a direction along which their phase spreads by less than `min_spread_rad` (not studied).
    """
    extent = torch.linalg.svdvals(scene.moving - scene.moving.mean(0)) / math.sqrt(len(scene))
    if float(extent[2]) * scene.wavenumber > min_spread_rad:
        return ""
    shape = "a line" if float(extent[1]) * scene.wavenumber <= min_spread_rad else "a plane"
    return f"; the positions lie on {shape}, from where many rooms look alike"


def _other_carrier(
    scene: PhaseObservations,
    room: PlaneSet,
    *,
    significance: float = 3.0,
    scales: Sequence[float] = (0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05),
) -> str:
    """Return the reason if another carrier explains the spectra significantly better, else nothing (values not studied)."""
    here = room.coherence(scene)

    def lead(scale: float) -> float:
        other = replace(scene, wavenumber=scale * scene.wavenumber)
        return advantage(refine(other, room, 6).coherence(other), here)

    for scale, ahead in zip(scales, parallel_map(lead, scales), strict=True):
        if ahead > significance:
            return f"; a carrier {100 * (scale - 1):+.0f} % from the given one explains the spectra better"
    return ""


def phase_alternatives(scene: PhaseObservations, room: PlaneSet) -> list[PlaneSet]:
    """Return the best refined rooms of the same planes at other phase aliases, the best first.

    Of more than six planes the first six move.
    """
    planes = room.normal.shape[1]
    if not planes:
        return []
    few, table = scene.few(), _AlternativeTable(scene.few(N_NEXT), room)
    near = [[h for h in p if abs(h) <= MAX_PERIODS] for p in table.offsets]
    whole = [[h for h in p if h % 2 == 0] for p in table.offsets]
    tried = table.best(near, N_COARSE)
    for choice in table.best(whole, N_WHOLE):
        around = [[h for h in (c - 1, c, c + 1) if h in p] for c, p in zip(choice, table.offsets, strict=True)]
        tried |= table.best(around, N_COARSE)
    tried.pop((0,) * planes, None)
    rooms = refine_all(few, [table.room(c) for c in sorted(tried, key=tried.__getitem__)[:N_COARSE]], 4)
    rooms.sort(key=lambda r: float(r.score))
    return sorted(refine_all(scene, rooms[:N_FINE], 12), key=lambda r: float(r.score))


def _alias_offsets(scene: LinkAt, room: PlaneSet, plane: int) -> dict[int, float]:
    """Return the offsets [m] at which the mean phase of a plane's wave differs by half periods, by their number."""
    here = float(room.offset[0, plane])
    if plane >= 6:  # a plane for each side of a room
        return {0: here}
    normal = room.normal[0, plane]
    nearest = float((torch.cat([scene.transmitter, scene.receiver]) @ normal).max())
    wavelength = 2 * math.pi / scene.wavenumber
    farthest = MAX_PERIODS * wavelength  # twice as far as at normal incidence
    if nearest >= here + farthest:  # it lies among the positions, where no alias is outside of the region
        return {0: here}
    grid = torch.arange(max(nearest, here - farthest), here + farthest, 0.125 * wavelength, dtype=torch.float64)
    scanned = PlaneSet(normal.expand(len(grid), 1, 3), grid[:, None], torch.ones(len(grid), 1), only=((0,),))
    source = images(scene, scanned)[:, 0]
    now = images(scene, replace(room, only=((plane,),)))[0, 0]
    longer = (source - scene.receiver).norm(dim=-1).mean(-1) - (now - scene.receiver).norm(dim=-1).mean()
    half_periods = longer / (wavelength / 2)
    offsets = {0: here}
    for number in range(-2 * MAX_PERIODS, 2 * MAX_PERIODS + 1):
        above = int(torch.searchsorted(half_periods, float(number)))
        if number and 0 < above < len(grid):
            fraction = (number - half_periods[above - 1]) / (half_periods[above] - half_periods[above - 1])
            offsets[number] = float(grid[above - 1] + fraction * (grid[above] - grid[above - 1]))
    return offsets


class _AlternativeTable:
    """Steering responses of single and double reflections at all aliases of the planes."""

    def __init__(self, scene: PhaseObservations, room: PlaneSet) -> None:
        self.before = room
        self.offsets = [_alias_offsets(scene, room, plane) for plane in range(room.normal.shape[1])]
        offset = [torch.tensor(list(p.values()), dtype=torch.float64) for p in self.offsets]
        gain = [g * (-1.0) ** torch.tensor(list(p)) for g, p in zip(room.gain[0], self.offsets, strict=True)]
        self.scenes = [scene.few(N_FIRST), scene]
        self.waves = [SteeringResponses.of(some, room.normal[0], offset, gain, room.order) for some in self.scenes]

    def room(self, choice: HalfPeriods) -> PlaneSet:
        """Return the room whose planes are moved by half periods."""
        offset = torch.tensor([[p[c] for c, p in zip(choice, self.offsets, strict=True)]], dtype=torch.float64)
        return replace(self.before, offset=offset, gain=self.before.gain * (-1.0) ** torch.tensor(choice))

    def best(self, half_periods: list[list[int]], most: int) -> dict[HalfPeriods, float]:
        """Return the best combinations of the given half periods of the planes, with their scores."""
        rows = [
            torch.tensor([list(p).index(h) for h in some]) for p, some in zip(self.offsets, half_periods, strict=True)
        ]
        few, more = (
            (scene, scene.direct, waves.at(rows)) for scene, waves in zip(self.scenes, self.waves, strict=True)
        )
        return {
            tuple(some[n] for some, n in zip(half_periods, number, strict=True)): score
            for score, number in best_combinations(few, more, most)
        }
