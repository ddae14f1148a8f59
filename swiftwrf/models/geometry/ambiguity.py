"""Rooms whose waves are in step with those of a given one: planes whole and half turns of phase away, several at once.

A plane that moves by half a wavelength / cosine of incidence turns its wave once around; by half of that, the wave is in
step with a gain of the other sign. Seen from a small region such rooms look alike, and what several planes reflect one
after another keeps a single plane from moving while others are as wrong. Hence all combinations are tried, from tables of
the waves of single and double reflections: half turns close by, whole ones further away, and half ones around the best.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from swiftwrf.models.geometry.images import Scene, images
from swiftwrf.models.geometry.planes import Planes
from swiftwrf.models.geometry.responses import Waves

SIX = 6  # planes that may move: one for each side of a room
TURNS = 4  # whole ones, to either side
FEW = 18  # positions that all combinations are scored at
GRID = 0.125  # wavelengths between the places that half turns are interpolated from
WIDTH = 32  # combinations of whole turns around which half turns are tried
REFINED = 24  # rooms that are refined a little
KEPT = 8  # and fully
Choice = tuple[int, ...]  # of half turns, for each plane


def turned(scene: Scene, room: Planes) -> list[Planes]:
    """Other rooms of the same planes that explain the spectra best, refined, the best first; of more than six planes the
    first six move."""
    planes = room.normal.shape[1]
    if not planes:
        return []
    few, table = scene.few(), _Table(scene.few(FEW), room)
    near = [[h for h in p if abs(h) <= TURNS] for p in table.places]
    whole = [[h for h in p if h % 2 == 0] for p in table.places]
    tried = table.best(near, REFINED)
    for choice in table.best(whole, WIDTH):
        around = [[h for h in (c - 1, c, c + 1) if h in p] for c, p in zip(choice, table.places, strict=True)]
        tried |= table.best(around, REFINED)
    tried.pop((0,) * planes, None)
    rooms = [table.room(c).refined(few, 4) for c in sorted(tried, key=tried.__getitem__)[:REFINED]]
    rooms.sort(key=lambda r: float(few.score(r.field(few))))
    rooms = [r.refined(scene, 12) for r in rooms[:KEPT]]
    return sorted(rooms, key=lambda r: float(scene.score(r.field(scene))))


def _places(scene: Scene, room: Planes, plane: int) -> dict[int, float]:
    """Offsets at which a plane's wave is whole and half turns from where it is, by the number of half turns."""
    here = float(room.offset[0, plane])
    if plane >= SIX:
        return {0: here}
    normal = room.normal[0, plane]
    nearest = float((torch.cat([scene.transmitter, scene.receiver]) @ normal).max())
    wavelength = 2 * math.pi / scene.wavenumber
    farthest = TURNS * wavelength  # twice as far as at normal incidence
    if nearest >= here + farthest:  # it stands among the positions, where no turn leads to a place for it
        return {0: here}
    grid = torch.arange(max(nearest, here - farthest), here + farthest, GRID * wavelength, dtype=torch.float64)
    source = images(scene, normal.expand(len(grid), 1, 3), grid[:, None], [(0,)])[:, 0]
    now = images(scene, room.normal, room.offset, [(plane,)])[0, 0]
    longer = (source - scene.receiver).norm(dim=-1).mean(-1) - (now - scene.receiver).norm(dim=-1).mean()
    half_turns = longer / (wavelength / 2)
    places = {0: here}
    for number in range(-2 * TURNS, 2 * TURNS + 1):
        above = int(torch.searchsorted(half_turns, float(number)))
        if number and 0 < above < len(grid):
            share = (number - half_turns[above - 1]) / (half_turns[above] - half_turns[above - 1])
            places[number] = float(grid[above - 1] + share * (grid[above] - grid[above - 1]))
    return places


class _Table:
    """Waves of single and double reflections at all places of the planes."""

    def __init__(self, scene: Scene, room: Planes) -> None:
        self.scene, self.before, self.direct = scene, room, scene.wave(scene.transmitter)
        self.places = [_places(scene, room, plane) for plane in range(room.normal.shape[1])]
        offset = [torch.tensor(list(p.values()), dtype=torch.float64) for p in self.places]
        gain = [g * (-1.0) ** torch.tensor(list(p)) for g, p in zip(room.gain[0], self.places, strict=True)]
        self.waves = Waves.of(scene, room.normal[0], offset, gain, room.order)

    def room(self, choice: Choice) -> Planes:
        """The room of a choice."""
        offset = torch.tensor([[p[c] for c, p in zip(choice, self.places, strict=True)]], dtype=torch.float64)
        return replace(self.before, offset=offset, gain=self.before.gain * (-1.0) ** torch.tensor(choice))

    def best(self, half_turns: list[list[int]], most: int) -> dict[Choice, float]:
        """The best of all combinations of the given half turns of the planes, and their scores."""
        rows = [torch.tensor([list(p).index(h) for h in some]) for p, some in zip(self.places, half_turns, strict=True)]
        score = self.waves.at(rows).scores(self.scene, self.direct)
        best = score.flatten().argsort()[:most].numpy()
        choices = np.stack(np.unravel_index(best, score.shape), axis=1).tolist()  # torch's own loads its compiler
        kept = [tuple(some[k] for some, k in zip(half_turns, choice, strict=True)) for choice in choices]
        return dict(zip(kept, score.flatten()[best].tolist(), strict=True))
