"""Search for a room without a start: at most one plane on each of the six sides of a region.

The score of a plane has many minima, about half a wavelength / cosine of incidence apart, and planes at wrong minima hold
each other in place. Therefore several planes move at once. Each side has a list of alternatives: the minima of its scans,
and no plane. The best combination of two to four sides' alternatives is taken, from the steering responses of all single and
double reflections, until none is better. All six sides move together by whole phase periods.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from dataclasses import field as of
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from swiftwrf.models.geometry.batched import batched, batched_field, batched_score
from swiftwrf.models.geometry.images import PhaseObservations, phase_period_m, sequences
from swiftwrf.models.geometry.refine import refine
from swiftwrf.models.geometry.responses import SteeringResponses
from swiftwrf.runtime.threads import parallel_map

SIDES = torch.tensor(
    [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], dtype=torch.float64
)  # outward normals
SIGNS = torch.tensor(
    [[-1, -1, -1, -1, -1, -1], [-1, -1, -1, -1, 1, 1], [1, 1, 1, 1, 1, 1]]
)  # of the gains: one material, vertical fields (walls turn them round, floor and ceiling do not), anything else
USUAL_GAIN, WEAK_GAIN = 0.7, 0.3  # modulus of a gain that is not known yet, and of a plane that is hidden at times
MAX_SCORE_RATIO = 0.997  # of the scores after and before a move that counts
PERFECT_SCORE = 2e-6  # needs no further moves
N_STARTS = 2 * len(SIGNS)  # of a search
MAX_START_RATIO = 1.4  # of a start's score and the best one, beyond which the start is given up
Alternatives = list[list[tuple[float, float]]]  # offset [m] and gain, for each side
MAX_ALTERNATIVES = {2: 99, 3: 7, 4: 4}  # of each side, by the number of sides that move at once
SEARCH_ORDER = 2  # reflections of an image while planes move together
N_MINIMA = 8  # of a scan, for each side
N_REFINED = 8  # combinations of each kind of move
N_SCANNED = 64  # positions that scans score planes at
N_SCREENED = 24  # positions at which all combinations of a kind of move are scored
N_RESCORED = 8  # times as many combinations as are wanted are scored at all positions
MAX_MOVES = 20
BEAM_STEPS = 3  # Levenberg-Marquardt steps after each plane of a beam; moves refine its rooms further


@dataclass
class CandidateRoom:
    """A candidate with at most one plane on each side: offset [m] and gain by the number of the side, and the score."""

    score: float
    offset: dict[int, float] = of(default_factory=dict)
    gain: dict[int, float] = of(default_factory=dict)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return normals (1, P, 3), offsets and gains (1, P), by ascending side."""
        sides = sorted(self.offset)
        offset = torch.tensor([[self.offset[i] for i in sides]], dtype=torch.float64)
        return SIDES[sides][None], offset, torch.tensor([[self.gain[i] for i in sides]])

    def key(self, step: float) -> tuple[tuple[int, int], ...]:
        """Return a key that is equal for rooms with offsets in the same steps [m]."""
        return tuple((i, round(o / step)) for i, o in sorted(self.offset.items()))


class Search:
    """Scans and moves of planes.

    Args:
        scene: Observed phases at the positions of the search.
        reach: Distance beyond the region of both ends up to which planes are searched [m].
        signs: Signs of the gains on the six sides (6,).
        usual: Modulus of a gain that is not known yet.
    """

    def __init__(self, scene: PhaseObservations, reach: float, signs: Tensor, usual: float = USUAL_GAIN) -> None:
        self.scene, self.reach, self.signs = scene, reach, signs
        self.usual: list[float] = (usual * signs).tolist()
        both = torch.cat([scene.transmitter, scene.receiver])
        self.near: list[float] = (both @ SIDES.T).amax(0).tolist()  # least offset of each side
        self.step = 0.5 / scene.wavenumber
        self.offsets = [
            n + torch.arange(self.step, max(reach, self.step), self.step, dtype=torch.float64) for n in self.near
        ]
        self.direct = batched(scene.wave(scene.transmitter))
        self._scanned, self._screened = scene.few(N_SCANNED), scene.few_rows(N_SCREENED)
        self._scanned_direct = batched(self._scanned.wave(self._scanned.transmitter))

    @cached_property
    def single(self) -> list[Tensor]:
        """Waves of a plane on each side at all its offsets."""
        return [self._waves(SIDES[i : i + 1], o[:, None]) for i, o in enumerate(self.offsets)]

    def _waves(self, normal: Tensor, offset: Tensor) -> Tensor:
        """Return the waves of single reflections with gain 1, (n, 2 K, C), at offsets (C, 1)."""
        one = torch.ones(len(offset), 1)
        return batched_field(self._scanned, normal.expand(len(offset), 1, 3), offset, one, [(0,)])

    def total(self, room: CandidateRoom, order: int) -> Tensor:
        """Return the field of a room with images up to an order, (n, 2 K, 1)."""
        if not room.offset:
            return self._scanned_direct
        normal, offset, gain = room.tensors()
        return self._scanned_direct + batched_field(self._scanned, normal, offset, gain, sequences(normal[0], order))

    def scan(self, room: CandidateRoom, side: int, order: int) -> Tensor:
        """Return the scores (C,) over the offsets of a side, without the plane that the room has there."""
        rest = CandidateRoom(0.0, {i: o for i, o in room.offset.items() if i != side}, room.gain)
        gain, offsets = room.gain.get(side, self.usual[side]), self.offsets[side]
        total = self.total(rest, order) + gain * self.single[side]
        sides = sorted([*rest.offset, side])
        own = sides.index(side)
        if chain := [s for s in sequences(SIDES[sides], order) if own in s and len(s) > 1]:
            offset = torch.tensor([rest.offset.get(i, 0.0) for i in sides], dtype=torch.float64)
            offset = offset.repeat(len(offsets), 1)
            offset[:, own] = offsets
            gains = torch.tensor([gain if i == side else rest.gain[i] for i in sides]).expand(len(offsets), -1)
            normal = SIDES[sides].expand(len(offsets), -1, -1)
            total += batched_field(self._scanned, normal, offset, gains, chain)
        return batched_score(self._scanned, total)

    def minima(self, room: CandidateRoom, side: int, order: int, top: int) -> list[tuple[float, float]]:
        """Return score and offset of the lowest local minima over the offsets of a side."""
        v = self.scan(room, side, order)
        low = ((v[1:-1] <= v[:-2]) & (v[1:-1] < v[2:])).nonzero()[:, 0] + 1
        low = low[v[low].argsort()[:top]]
        return list(zip(v[low].tolist(), self.offsets[side][low].tolist(), strict=True))

    def refined(self, rooms: list[CandidateRoom], order: int, steps: int = 6) -> list[CandidateRoom]:
        """Return the rooms after Levenberg-Marquardt steps, the best first; equal sides are computed together."""
        done = []
        by_sides: dict[tuple[int, ...], list[CandidateRoom]] = {}
        for room in rooms:
            by_sides.setdefault(tuple(sorted(room.offset)), []).append(room)
        for sides, group in by_sides.items():
            if not sides:
                done += [CandidateRoom(float(batched_score(self.scene, self.direct)))]
                continue
            normal, offset, gain = (torch.cat(t) for t in zip(*[r.tensors() for r in group], strict=True))
            chain = sequences(SIDES[list(sides)], order)
            score, _, offset, gain = refine(
                self.scene, normal, offset, gain, chain, steps=steps, signs=self.signs[list(sides)], limit=2 * self.step
            )
            for v, o, g in zip(score.tolist(), offset.tolist(), gain.tolist(), strict=True):
                done.append(CandidateRoom(v, dict(zip(sides, o, strict=True)), dict(zip(sides, g, strict=True))))
        return sorted(done, key=lambda r: r.score)

    def beam(self, width: int, order: int) -> list[CandidateRoom]:
        """Return the best rooms of a beam search that adds one plane at a time."""
        rooms = [CandidateRoom(float(batched_score(self.scene, self.direct)))]
        for _ in SIDES:
            pool: dict[tuple[tuple[int, int], ...], CandidateRoom] = {}
            for room in rooms:
                for side in set(range(6)) - set(room.offset):
                    for v, o in self.minima(room, side, order, 4):
                        new = CandidateRoom(v, {**room.offset, side: o}, {**room.gain, side: self.usual[side]})
                        pool.setdefault(new.key(2 * self.step), new)
            if not pool:  # no side left has a minimum within reach
                break
            best = sorted(pool.values(), key=lambda r: r.score)[: 3 * width]
            distinct: dict[tuple[tuple[int, int], ...], CandidateRoom] = {}
            for r in self.refined(best, order, BEAM_STEPS):
                distinct.setdefault(r.key(2 * self.step), r)
            rooms = list(distinct.values())[:width]
        return rooms

    def alternatives(self, room: CandidateRoom, top: int) -> Alternatives:
        """Return (offset, gain) of each side's alternatives.

        These are the present plane, no plane (gain 0), and the minima of scans with and without second-order images.
        """

        def of_side(side: int) -> list[tuple[float, float]]:
            gain = room.gain[side] if side in room.offset else self.usual[side]
            own = [(room.offset[side], gain), (room.offset[side], 0.0)] if side in room.offset else [(0.0, 0.0)]
            far: list[float] = []
            for o in (o for order in (1, SEARCH_ORDER) for _, o in self.minima(room, side, order, top)):
                if all(abs(o - p) > 2 * self.step for p in far):
                    far.append(o)
            return own + [(o, gain) for o in far]

        return parallel_map(of_side, range(6))

    def responses(self, alternatives: Alternatives) -> SteeringResponses:
        """Return the steering responses of all alternatives."""
        offset = [torch.tensor([o for o, _ in a], dtype=torch.float64) for a in alternatives]
        gain = [torch.tensor([g for _, g in a]) for a in alternatives]
        return SteeringResponses.of(self.scene, SIDES, offset, gain, SEARCH_ORDER)

    def moves(self, alternatives: Alternatives, responses: SteeringResponses, k: int, keep: int) -> list[CandidateRoom]:
        """Return the best rooms in which k sides take other alternatives, of which `MAX_ALTERNATIVES` are tried.

        All combinations are scored at few positions, and the best of them at all.
        """
        few, few_responses = self.scene.subset(self._screened), responses.subset(self._screened)
        pool: list[tuple[float, tuple[int, ...]]] = []
        for which in itertools.combinations(range(6), k):
            base, moving = few_responses.moved(self.direct[self._screened], which)
            screened = moving.first(MAX_ALTERNATIVES.get(k)).scores(few, base)
            best = screened.flatten().argsort()[: N_RESCORED * keep].numpy()
            number = np.unravel_index(best, screened.shape)
            base, moving = responses.moved(self.direct, which)
            value = batched_score(self.scene, base + moving.of_choices([torch.from_numpy(n) for n in number]))
            for index in value.argsort()[:keep].tolist():
                choice = [0] * 6
                for i, at in zip(which, number, strict=True):
                    choice[i] = int(at[index])
                pool.append((float(value[index]), tuple(choice)))
        rooms = []
        for value_, choice_ in sorted(set(pool))[:keep]:
            picked = {i: alternatives[i][c] for i, c in enumerate(choice_) if alternatives[i][c][1] != 0}
            rooms.append(
                CandidateRoom(value_, {i: p[0] for i, p in picked.items()}, {i: p[1] for i, p in picked.items()})
            )
        return rooms

    def aliases(self, room: CandidateRoom) -> Alternatives:
        """Return (offset, gain) of each side's present plane, wherever it is, and of its aliases up to two periods away."""
        found = []
        for side in range(6):
            if side not in room.offset:
                found.append([(0.0, 0.0)])
                continue
            one = CandidateRoom(0.0, {side: room.offset[side]}, room.gain)
            normal, offset, _ = one.tensors()
            period = phase_period_m(self.scene, normal, offset, 0)
            steps = [room.offset[side] + m * period for m in (0, -1, 1, -2, 2)]
            found.append([(o, room.gain[side]) for o in steps if o == steps[0] or o >= self.near[side]])
        return found

    def improve(self, room: CandidateRoom) -> CandidateRoom:
        """Return the room after moves of several planes at a time, with second-order images, until no move is better."""
        best = self.refined([room], SEARCH_ORDER)[0]
        for _ in range(MAX_MOVES):
            for tried in self._trials(best):
                if tried.score < MAX_SCORE_RATIO * best.score:
                    best = tried
                    break
            else:
                break
        return best

    def _trials(self, room: CandidateRoom) -> Iterator[CandidateRoom]:
        """Yield the best room of each kind of move, cheap kinds first."""
        if room.score < PERFECT_SCORE:
            return
        alternatives = self.alternatives(room, N_MINIMA)
        responses = self.responses(alternatives)
        for k in MAX_ALTERNATIVES:
            yield self.refined(self.moves(alternatives, responses, k, N_REFINED), SEARCH_ORDER)[0]
        few, aliases = Search(self.scene.few(), self.reach, self.signs), self.aliases(room)
        yield self.refined(few.moves(aliases, few.responses(aliases), 6, N_REFINED), SEARCH_ORDER)[0]


def find_rooms(
    scene: PhaseObservations, reach: float, width: int = 8, tick: Callable[[], None] | None = None
) -> list[tuple[Tensor, CandidateRoom]]:
    """Return the best room of each of SIGNS with the signs of its gains, the best first.

    Rooms come from beams with and without second-order images. Those that start far behind the best one are left out.

    Args:
        scene: Observed phases at the positions of the search, preferably at most 100.
        reach: Distance beyond the region of both ends up to which planes are searched [m].
        width: Width of the beam search.
        tick: Called after each of the N_STARTS starts.
    """
    nothing = CandidateRoom(float(scene.score(scene.wave(scene.transmitter))))
    if nothing.score < PERFECT_SCORE:
        return [(SIGNS[0], nothing)]
    searches = [Search(scene, reach, signs) for signs in SIGNS]
    searched = list(itertools.product((SEARCH_ORDER, 1), searches))
    rooms = parallel_map(lambda item: item[1].beam(width, item[0])[0], searched)
    starts = [(room, search) for room, (_, search) in zip(rooms, searched, strict=True)]
    found: dict[Search, CandidateRoom] = {}
    for start, search in sorted(starts, key=lambda s: s[0].score):
        lowest = min((room.score for room in found.values()), default=math.inf)
        if not found or PERFECT_SCORE < start.score < MAX_START_RATIO * lowest:
            room = search.improve(start)
            if search not in found or room.score < found[search].score:
                found[search] = room
        if tick:
            tick()
    best = sorted(found.items(), key=lambda item: item[1].score)
    return [
        (search.signs, room)
        for search, room in best
        if room.score < max(PERFECT_SCORE, MAX_START_RATIO * best[0][1].score)
    ]
