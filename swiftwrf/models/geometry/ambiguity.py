"""Phase ambiguity: rooms whose planes are whole and half phase periods away from those of a given room.

A plane that moves by half a wavelength / cosine of incidence changes the phase of its wave by a whole period. A plane that
moves by half of that has a wave of the same phase with a gain of the other sign. Observed from a small region such rooms are
nearly equal, and higher-order images keep a single plane from moving while others are wrong. Therefore all combinations are
tried, from the steering responses of single and double reflections: half periods nearby, whole periods farther away, and
half periods around the best of these.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from swiftwrf.models.geometry.batched import batched, batched_score
from swiftwrf.models.geometry.images import PhaseObservations, images
from swiftwrf.models.geometry.planes import PlaneSet, refined
from swiftwrf.models.geometry.responses import SteeringResponses

MAX_MOVING = 6  # planes, one for each side of a room
MAX_PERIODS = 4  # to either side
N_POSITIONS = 18  # that the best combinations are scored at
N_FIRST_POSITIONS = 6  # that all combinations are scored at
N_RESCORED = 8  # times as many combinations as are wanted are scored at more than the first positions
OFFSET_STEP_WAVELENGTHS = 0.125  # of the grid from which aliases are interpolated
N_WHOLE = 32  # combinations of whole periods around which half periods are tried
N_COARSE, N_FINE = 24, 8  # rooms that are refined with some positions, and with all
HalfPeriods = tuple[int, ...]  # by which each plane is moved


def phase_alternatives(scene: PhaseObservations, room: PlaneSet) -> list[PlaneSet]:
    """Return the best refined rooms of the same planes at other phase aliases, the best first.

    Of more than six planes the first six move.
    """
    planes = room.normal.shape[1]
    if not planes:
        return []
    few, table = scene.few(), _AlternativeTable(scene.few(N_POSITIONS), room)
    near = [[h for h in p if abs(h) <= MAX_PERIODS] for p in table.offsets]
    whole = [[h for h in p if h % 2 == 0] for p in table.offsets]
    tried = table.best(near, N_COARSE)
    for choice in table.best(whole, N_WHOLE):
        around = [[h for h in (c - 1, c, c + 1) if h in p] for c, p in zip(choice, table.offsets, strict=True)]
        tried |= table.best(around, N_COARSE)
    tried.pop((0,) * planes, None)
    rooms = refined([table.room(c) for c in sorted(tried, key=tried.__getitem__)[:N_COARSE]], few, 4)
    rooms.sort(key=lambda r: float(few.score(r.field(few))))
    rooms = refined(rooms[:N_FINE], scene, 12)
    return sorted(rooms, key=lambda r: float(scene.score(r.field(scene))))


def _alias_offsets(scene: PhaseObservations, room: PlaneSet, plane: int) -> dict[int, float]:
    """Return the offsets [m] at which the mean phase of a plane's wave differs by half periods, by their number."""
    here = float(room.offset[0, plane])
    if plane >= MAX_MOVING:
        return {0: here}
    normal = room.normal[0, plane]
    nearest = float((torch.cat([scene.transmitter, scene.receiver]) @ normal).max())
    wavelength = 2 * math.pi / scene.wavenumber
    farthest = MAX_PERIODS * wavelength  # twice as far as at normal incidence
    if nearest >= here + farthest:  # it lies among the positions, where no alias is outside of the region
        return {0: here}
    grid = torch.arange(
        max(nearest, here - farthest), here + farthest, OFFSET_STEP_WAVELENGTHS * wavelength, dtype=torch.float64
    )
    source = images(scene, normal.expand(len(grid), 1, 3), grid[:, None], [(0,)])[:, 0]
    now = images(scene, room.normal, room.offset, [(plane,)])[0, 0]
    longer = (source - scene.receiver).norm(dim=-1).mean(-1) - (now - scene.receiver).norm(dim=-1).mean()
    half_periods = longer / (wavelength / 2)
    offsets = {0: here}
    for number in range(-2 * MAX_PERIODS, 2 * MAX_PERIODS + 1):
        above = int(torch.searchsorted(half_periods, float(number)))
        if number and 0 < above < len(grid):
            share = (number - half_periods[above - 1]) / (half_periods[above] - half_periods[above - 1])
            offsets[number] = float(grid[above - 1] + share * (grid[above] - grid[above - 1]))
    return offsets


class _AlternativeTable:
    """Steering responses of single and double reflections at all aliases of the planes."""

    def __init__(self, scene: PhaseObservations, room: PlaneSet) -> None:
        self.before = room
        self.offsets = [_alias_offsets(scene, room, plane) for plane in range(room.normal.shape[1])]
        offset = [torch.tensor(list(p.values()), dtype=torch.float64) for p in self.offsets]
        gain = [g * (-1.0) ** torch.tensor(list(p)) for g, p in zip(room.gain[0], self.offsets, strict=True)]
        self.scenes = [scene.few(N_FIRST_POSITIONS), scene]
        self.direct = [batched(some.wave(some.transmitter)) for some in self.scenes]
        self.waves = [SteeringResponses.of(some, room.normal[0], offset, gain, room.order) for some in self.scenes]

    def room(self, choice: HalfPeriods) -> PlaneSet:
        """Return the room whose planes are moved by half periods."""
        offset = torch.tensor([[p[c] for c, p in zip(choice, self.offsets, strict=True)]], dtype=torch.float64)
        return replace(self.before, offset=offset, gain=self.before.gain * (-1.0) ** torch.tensor(choice))

    def best(self, half_periods: list[list[int]], most: int) -> dict[HalfPeriods, float]:
        """Return the best combinations of the given half periods of the planes, with their scores.

        All combinations are scored at few positions, and the best of them at more.
        """
        rows = [
            torch.tensor([list(p).index(h) for h in some]) for p, some in zip(self.offsets, half_periods, strict=True)
        ]
        (first, scene), (direct, base), (few, waves) = self.scenes, self.direct, self.waves
        score = few.at(rows).scores(first, direct)
        best = score.flatten().argsort()[: N_RESCORED * most].numpy()
        number = [torch.from_numpy(n) for n in np.unravel_index(best, score.shape)]  # torch's own loads its compiler
        score = batched_score(scene, base + waves.of_choices([r[n] for r, n in zip(rows, number, strict=True)]))
        kept = score.argsort()[:most]
        choices = torch.stack([n[kept] for n in number], dim=1).tolist()
        best_choices = [tuple(some[k] for some, k in zip(half_periods, choice, strict=True)) for choice in choices]
        return dict(zip(best_choices, score[kept].tolist(), strict=True))
