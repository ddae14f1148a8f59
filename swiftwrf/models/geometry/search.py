"""Which planes: at most one on each of the six sides of a region, found from nothing.

The score of a plane has many minima, about half a wavelength / cosine of incidence apart, and planes at wrong ones hold
each other in place. Hence several planes move at once: each side keeps a list of alternatives, the minima of its own scans
and "no plane", and the best of all combinations of two to four sides' alternatives is taken, from tables of the waves of
all single and double reflections, until none is better; all six sides move at once by whole turns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from dataclasses import field as of
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from swiftwrf.models.geometry.images import Scene, field, sequences, turn_of
from swiftwrf.models.geometry.refine import refine
from swiftwrf.models.geometry.responses import Waves

SIDES = torch.tensor(
    [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], dtype=torch.float64
)  # outward normals
SIGNS = torch.tensor(
    [[-1, -1, -1, -1, -1, -1], [-1, -1, -1, -1, 1, 1], [1, 1, 1, 1, 1, 1]]
)  # of the gains: one material, vertical fields (walls turn them round, floor and ceiling do not), anything else
USUAL, WEAK = 0.7, 0.3  # modulus of a gain that is not known yet, and of a plane that is hidden at times
BETTER = 0.997  # of the score, for a move to count
PERFECT = 2e-6  # a score that needs no further moves
STARTS = 2 * len(SIGNS)  # of a search
HOPELESS = 1.4  # a start with so many times the best score is given up
Alternatives = list[list[tuple[float, float]]]  # offset [m] and gain, for each side
CHUNK = 256  # candidates at a time
MOVES = {2: 99, 3: 7, 4: 4}  # so many sides move at once, each to so many alternatives
ORDER = 2  # of the images while planes move together
TOP = 8  # alternatives of a side
KEEP = 8  # combinations that are refined
SWEEPS = 20  # moves at most


@dataclass
class Room:
    """At most one plane a side: offset [m] and gain by the number of the side, and the score."""

    score: float
    offset: dict[int, float] = of(default_factory=dict)
    gain: dict[int, float] = of(default_factory=dict)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Normals (1, P, 3), offsets and gains (1, P), by ascending side."""
        sides = sorted(self.offset)
        offset = torch.tensor([[self.offset[i] for i in sides]], dtype=torch.float64)
        return SIDES[sides][None], offset, torch.tensor([[self.gain[i] for i in sides]])

    def key(self, step: float) -> tuple[tuple[int, int], ...]:
        """The same for rooms that are alike."""
        return tuple((i, round(o / step)) for i, o in sorted(self.offset.items()))


class Search:
    """Scans and moves on the planes of a scene.

    Args:
        scene: with the positions to search with.
        reach: how far beyond the region planes are looked for [m].
        signs: of the gains on the six sides, -1 or 1 each, (6,).
        usual: modulus of a gain that is not known yet.
    """

    def __init__(self, scene: Scene, reach: float, signs: Tensor, usual: float = USUAL) -> None:
        self.scene, self.reach, self.signs = scene, reach, signs
        self.usual: list[float] = (usual * signs).tolist()
        both = torch.cat([scene.transmitter, scene.receiver])
        near = (both @ SIDES.T).amax(0)
        self.step = 0.5 / scene.wavenumber
        self.offsets = [n + torch.arange(self.step, reach, self.step, dtype=torch.float64) for n in near]
        self.direct = scene.wave(scene.transmitter)

    @cached_property
    def single(self) -> list[Tensor]:
        """Waves of a plane on each side, at all its offsets."""
        return [self._waves(SIDES[i : i + 1], o[:, None]) for i, o in enumerate(self.offsets)]

    def _waves(self, normal: Tensor, offset: Tensor) -> Tensor:
        """Unscaled waves of single reflections (C, n, K) at offsets (C, 1)."""
        one = torch.ones(len(offset), 1)
        return field(self.scene, normal.expand(len(offset), 1, 3), offset, one, [(0,)])

    def total(self, room: Room, order: int) -> Tensor:
        """The field of a room, (n, K)."""
        if not room.offset:
            return self.direct
        normal, offset, gain = room.tensors()
        return self.direct + field(self.scene, normal, offset, gain, sequences(normal[0], order))[0]

    def landscape(self, room: Room, side: int, order: int) -> Tensor:
        """The score over the offsets of a side, its own plane taken away, (C,)."""
        rest = Room(0.0, {i: o for i, o in room.offset.items() if i != side}, room.gain)
        base, gain = self.total(rest, order), room.gain.get(side, self.usual[side])
        sides = sorted([*rest.offset, side])
        own = sides.index(side)
        chain = [s for s in sequences(SIDES[sides], order) if own in s and len(s) > 1]
        gains = torch.tensor([[gain if i == side else rest.gain[i] for i in sides]])
        values = []
        for waves, offsets in zip(self.single[side].split(CHUNK), self.offsets[side].split(CHUNK), strict=True):
            h = base + gain * waves
            if chain:
                offset = torch.tensor([rest.offset.get(i, 0.0) for i in sides], dtype=torch.float64)
                offset = offset.repeat(len(offsets), 1)
                offset[:, own] = offsets
                normal = SIDES[sides].expand(len(offsets), -1, -1)
                h = h + field(self.scene, normal, offset, gains.expand(len(offsets), -1), chain)
            values.append(self.scene.score(h))
        return torch.cat(values)

    def minima(self, room: Room, side: int, order: int, top: int) -> list[tuple[float, float]]:
        """The lowest local minima of a side's landscape: score and offset."""
        v = self.landscape(room, side, order)
        low = ((v[1:-1] <= v[:-2]) & (v[1:-1] < v[2:])).nonzero()[:, 0] + 1
        low = low[v[low].argsort()[:top]]
        return list(zip(v[low].tolist(), self.offsets[side][low].tolist(), strict=True))

    def refined(self, rooms: list[Room], order: int, steps: int = 6) -> list[Room]:
        """The rooms after some Levenberg-Marquardt steps; those with equally many planes on the same sides together."""
        done = []
        by_sides: dict[tuple[int, ...], list[Room]] = {}
        for room in rooms:
            by_sides.setdefault(tuple(sorted(room.offset)), []).append(room)
        for sides, group in by_sides.items():
            if not sides:
                done += [Room(float(self.scene.score(self.direct)))]
                continue
            normal, offset, gain = (torch.cat(t) for t in zip(*[r.tensors() for r in group], strict=True))
            chain = sequences(SIDES[list(sides)], order)
            score, _, offset, gain = refine(
                self.scene, normal, offset, gain, chain, steps=steps, signs=self.signs[list(sides)], limit=2 * self.step
            )
            for v, o, g in zip(score.tolist(), offset.tolist(), gain.tolist(), strict=True):
                done.append(Room(v, dict(zip(sides, o, strict=True)), dict(zip(sides, g, strict=True))))
        return sorted(done, key=lambda r: r.score)

    def beam(self, width: int, order: int) -> list[Room]:
        """Partial rooms of growing number of planes, the best few of each number kept."""
        rooms = [Room(float(self.scene.score(self.direct)))]
        for _ in SIDES:
            pool: dict[tuple[tuple[int, int], ...], Room] = {}
            for room in rooms:
                for side in set(range(6)) - set(room.offset):
                    for v, o in self.minima(room, side, order, 4):
                        new = Room(v, {**room.offset, side: o}, {**room.gain, side: self.usual[side]})
                        pool.setdefault(new.key(2 * self.step), new)
            if not pool:  # no side left has a minimum within reach
                break
            best = sorted(pool.values(), key=lambda r: r.score)[: 3 * width]
            distinct: dict[tuple[tuple[int, int], ...], Room] = {}
            for r in self.refined(best, order):
                distinct.setdefault(r.key(2 * self.step), r)
            rooms = list(distinct.values())[:width]
        return rooms

    def alternatives(self, room: Room, top: int) -> Alternatives:
        """For each side (offset, gain): where it is, nothing (gain 0), and the minima of scans with and without
        second-order images."""
        found = []
        for side in range(6):
            gain = room.gain[side] if side in room.offset else self.usual[side]
            own = [(room.offset[side], gain), (room.offset[side], 0.0)] if side in room.offset else [(0.0, 0.0)]
            offsets = [o for order in (1, ORDER) for _, o in self.minima(room, side, order, top)]
            far: list[float] = []
            for o in offsets:
                if all(abs(o - p) > 2 * self.step for p in far):
                    far.append(o)
            found.append(own + [(o, gain) for o in far])
        return found

    def table(self, alternatives: Alternatives) -> Waves:
        """The waves of all alternatives."""
        offset = [torch.tensor([o for o, _ in a], dtype=torch.float64) for a in alternatives]
        gain = [torch.tensor([g for _, g in a]) for a in alternatives]
        return Waves.of(self.scene, SIDES, offset, gain, ORDER)

    def moves(self, alternatives: Alternatives, waves: Waves, k: int, keep: int) -> list[Room]:
        """The best rooms in which k sides take other alternatives, of which the more are tried the fewer sides move."""
        pool: list[tuple[float, tuple[int, ...]]] = []
        for which in itertools.combinations(range(6), k):
            base, moving = waves.moved(self.direct, which)
            tried = [torch.arange(len(alternatives[i]))[: MOVES.get(k)] for i in which]
            value = moving.at(tried).scores(self.scene, base)
            for index in value.flatten().argsort()[:keep]:
                choice = [0] * 6
                for i, at in zip(which, np.unravel_index(int(index), value.shape), strict=True):
                    choice[i] = int(at)
                pool.append((float(value.flatten()[index]), tuple(choice)))
        rooms = []
        for value_, choice_ in sorted(set(pool))[:keep]:
            picked = {i: alternatives[i][c] for i, c in enumerate(choice_) if alternatives[i][c][1] != 0}
            rooms.append(Room(value_, {i: p[0] for i, p in picked.items()}, {i: p[1] for i, p in picked.items()}))
        return rooms

    def wraps(self, room: Room) -> Alternatives:
        """For each side (offset, gain): where it is and where its wave has the same phase up to one or two turns."""
        found = []
        for side in range(6):
            if side not in room.offset:
                found.append([(0.0, 0.0)])
                continue
            one = Room(0.0, {side: room.offset[side]}, room.gain)
            normal, offset, _ = one.tensors()
            turn = turn_of(self.scene, normal, offset, 0)
            low = float(self.offsets[side][0])
            steps = [room.offset[side] + m * turn for m in (0, -1, 1, -2, 2)]
            found.append([(o, room.gain[side]) for o in steps if o >= low - self.step])
        return found

    def improve(self, room: Room) -> Room:
        """Moves several planes at a time, with second-order images, until nothing is better."""
        best = self.refined([room], ORDER)[0]
        for _ in range(SWEEPS):
            for tried in self._trials(best):
                if tried.score < BETTER * best.score:
                    best = tried
                    break
            else:
                break
        return best

    def _trials(self, room: Room) -> Iterator[Room]:
        """The best of each kind of move, the cheap ones first."""
        if room.score < PERFECT:
            return
        alternatives = self.alternatives(room, TOP)
        waves = self.table(alternatives)
        for k in MOVES:
            yield self.refined(self.moves(alternatives, waves, k, KEEP), ORDER)[0]
        few, wraps = Search(self.scene.few(), self.reach, self.signs), self.wraps(room)
        yield self.refined(few.moves(wraps, few.table(wraps), 6, KEEP), ORDER)[0]


def find_room(
    scene: Scene, reach: float, width: int = 8, tick: Callable[[], None] | None = None
) -> tuple[Tensor, Room]:
    """The signs of the gains and the best room over all SIGNS, from beams with and without second-order images.

    Args:
        scene: with the positions to search with, best no more than a hundred.
        reach: how far beyond the region of both ends planes are looked for [m].
        width: of the beam.
        tick: called after each of the STARTS starts.
    """
    starts = []
    nothing = Room(float(scene.score(scene.wave(scene.transmitter))))
    if nothing.score < PERFECT:
        return SIGNS[0], nothing
    for signs in SIGNS:
        search = Search(scene, reach, signs)
        starts += [(search.beam(width, order)[0], search) for order in (ORDER, 1)]
    best: tuple[Tensor, Room] | None = None
    for start, search in sorted(starts, key=lambda s: s[0].score):
        if best is None or PERFECT < start.score < HOPELESS * best[1].score:
            room = search.improve(start)
            if best is None or room.score < best[1].score:
                best = search.signs, room
        if tick:
            tick()
    assert best is not None
    return best
