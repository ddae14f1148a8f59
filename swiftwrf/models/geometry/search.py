"""Search for a room without a start: planes on the six sides of a region, then planes of any orientation.

The score of a plane has many minima, about half a wavelength / cosine of incidence apart, and planes at wrong minima hold
each other in place. Therefore several planes move at once. Each side has a list of alternatives: the minima of its scans,
and no plane. The best combination of two to four sides' alternatives is taken, from the steering responses of all single and
double reflections, until none is better. All six sides move together by whole phase periods.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.models.geometry.images import SIDES, LinkAt, PhaseObservations, PlaneSet, field, phase_period_m, sequences
from swiftwrf.models.geometry.planes import refine_all
from swiftwrf.runtime.threads import parallel_map

SIGNS = torch.tensor(
    [[-1, -1, -1, -1, -1, -1], [-1, -1, -1, -1, 1, 1], [1, 1, 1, 1, 1, 1]]
)  # of the gains: one material, vertical fields (walls turn them round, floor and ceiling do not), anything else
PERFECT_SCORE = 2e-6  # needs no further moves
N_STARTS = 2 * len(SIGNS)  # of a search
Alternatives = list[list[tuple[float, float]]]  # offset [m] and gain, for each side
MAX_ALTERNATIVES = {2: 99, 3: 7, 4: 4}  # of each side, by the number of sides that move at once
SEARCH_ORDER = 2  # reflections of an image while planes move together
N_REFINED = 8  # combinations of each kind of move
N_RESCORED = 8  # times as many combinations as are wanted are scored again at more positions
MAX_MOVES = 20
N_HORIZONTAL_NORMALS = 90  # of upright walls
N_SPHERE_NORMALS = 1200  # in all directions


@dataclass(frozen=True)
class SteeringResponses:
    """Fields of single and double reflections in P planes at many alternative offsets, and scores of all combinations.

    Args:
        single: Waves of each plane at each of its A offsets, float32 (n, 2 K, A).
        double: Waves of each pair i < j of planes at all their offsets, both orders of reflection together,
            (n, 2 K, A, B).
    """

    single: list[Tensor]
    double: dict[tuple[int, int], Tensor]

    @classmethod
    def of(
        cls, scene: LinkAt, normal: Tensor, offset: list[Tensor], gain: list[Tensor], order: int = 2
    ) -> SteeringResponses:
        """Return the waves of planes with normals (P, 3) at offsets (A,) [m] with gains (A,); none are double at order 1."""
        single = [
            field(scene, PlaneSet(normal[i].expand(len(o), 1, 3), o[:, None], g[:, None], only=((0,),)))
            for i, (o, g) in enumerate(zip(offset, gain, strict=True))
        ]
        double = {}
        for i, j in itertools.combinations(range(len(normal)), 2):
            both, pair = normal[[i, j]], torch.cartesian_prod(offset[i], offset[j])
            if chain := tuple(s for s in sequences(both, min(order, 2)) if len(s) > 1):
                gains = torch.cartesian_prod(gain[i], gain[j])
                waves = field(scene, PlaneSet(both.expand(len(pair), 2, 3), pair, gains, only=chain))
                double[i, j] = waves.unflatten(-1, (len(offset[i]), len(offset[j])))
        return cls(single, double)

    def first(self, most: int | None) -> SteeringResponses:
        """Return the waves at no more than the first offsets of each plane."""
        double = {pair: waves[:, :, :most, :most] for pair, waves in self.double.items()}
        return SteeringResponses([waves[:, :, :most] for waves in self.single], double)

    def subset(self, rows: Tensor) -> SteeringResponses:
        """Return the waves at some of the positions."""
        return SteeringResponses([w[rows] for w in self.single], {pair: w[rows] for pair, w in self.double.items()})

    def at(self, rows: list[Tensor]) -> SteeringResponses:
        """Return the waves at the given offset numbers (A,) of each plane."""
        double = {(i, j): w.index_select(2, rows[i]).index_select(3, rows[j]) for (i, j), w in self.double.items()}
        return SteeringResponses([w.index_select(2, r) for w, r in zip(self.single, rows, strict=True)], double)

    def of_choices(self, rows: list[Tensor]) -> Tensor:
        """Return the fields (n, 2 K, C) of C combinations with these offset numbers (C,) of each plane."""
        total = torch.zeros(())
        for waves, r in zip(self.single, rows, strict=True):
            total = total + waves.index_select(-1, r)
        for (i, j), waves in self.double.items():
            total += waves.flatten(2).index_select(-1, rows[i] * waves.shape[-1] + rows[j])
        return total

    def moved(self, direct: Tensor, moving: tuple[int, ...]) -> tuple[Tensor, SteeringResponses]:
        """Return the field (n, 2 K, 1) of the planes that stay at their first offsets, with the direct wave.

        Also return the waves that the moving planes add to it.
        """
        stay = [i for i in range(len(self.single)) if i not in moving]
        base = sum((self.single[i][..., :1] for i in stay), start=direct)
        base = sum((d[..., 0, :1] for (i, j), d in self.double.items() if {i, j} <= {*stay}), start=base)
        single = []
        for i in moving:
            before = [self.double[j, i][..., 0, :] for j in stay if (j, i) in self.double]
            after = [self.double[i, j][..., 0] for j in stay if (i, j) in self.double]
            single.append(sum([*before, *after], start=self.single[i]))
        pairs = itertools.combinations(enumerate(moving), 2)
        double = {(p, q): self.double[i, j] for (p, i), (q, j) in pairs if (i, j) in self.double}
        return base, SteeringResponses(single, double)

    def scores(self, scene: PhaseObservations, base: Tensor) -> Tensor:
        """Return the scores (A, B, ...) of all combinations of the planes' offsets, added to a field (n, 2 K, 1).

        The planes are divided into two halves. Double reflections between them are a product with a matrix that selects the
        offsets of the second half.
        """
        size = [waves.shape[-1] for waves in self.single]
        half = len(size) // 2
        first, second = range(half), range(half, len(size))
        left, right = _combinations(size[:half]), _combinations(size[half:])
        stay, move = base + self._among(first, left), self._among(second, right)
        pairs = {j: [i for i in first if (i, j) in self.double] for j in second}
        crossed = [j for j, some in pairs.items() if some]
        if crossed:
            rows_of = ([self.double[i, j].index_select(2, left[i]) for i in pairs[j]] for j in crossed)
            between = torch.cat([torch.stack(waves).sum(0) for waves in rows_of], dim=-1)
            chosen = torch.cat([functional.one_hot(right[j - half], size[j]).T for j in crossed]).float()
        scores = []
        for rows in torch.arange(left.shape[1]).split(max(1, 1000 // right.shape[1])):
            total = stay.expand(-1, -1, left.shape[1])[:, :, rows, None] + move[:, :, None]
            if crossed:
                total += between[:, :, rows] @ chosen
            scores.append(scene.score(total.flatten(2)))
        return torch.cat(scores).reshape(size)

    def _among(self, planes: range, rows: Tensor) -> Tensor:
        """Return the fields (n, 2 K, C) of some neighbouring planes alone, at the offset numbers (P, C)."""
        double = {
            (i - planes.start, j - planes.start): waves
            for (i, j), waves in self.double.items()
            if i in planes and j in planes
        }
        return SteeringResponses(self.single[planes.start : planes.stop], double).of_choices(list(rows))


Scored = tuple[
    PhaseObservations, Tensor, SteeringResponses
]  # positions, field of what stays there, and what is combined


def best_combinations(few: Scored, more: Scored, most: int) -> list[tuple[float, tuple[int, ...]]]:
    """Return the scores of the best combinations of offsets, the best first, and their numbers for each plane.

    All combinations are scored at few positions, and the best `N_RESCORED` times `most` of them at more positions.
    """
    scene, base, responses = few
    score = responses.scores(scene, base)
    best = score.flatten().argsort()[: N_RESCORED * most].numpy()
    number = [torch.from_numpy(n) for n in np.unravel_index(best, score.shape)]  # torch's own loads its compiler
    scene, base, responses = more
    score = scene.score(base + responses.of_choices(number))
    kept = score.argsort()[:most]
    rows = torch.stack([n[kept] for n in number], dim=1).tolist()
    return list(zip(score[kept].tolist(), map(tuple, rows), strict=True))


def _combinations(size: list[int]) -> Tensor:
    """Return the numbers (P, C) of all combinations of P choices, each from size[p] numbers."""
    grids = torch.meshgrid(*map(torch.arange, size), indexing="ij") if size else ()
    return torch.stack([grid.flatten() for grid in grids]) if size else torch.zeros(0, 1, dtype=torch.int64)


class Search:
    """Scans and moves of planes.

    Args:
        scene: Observed phases at the positions of the search.
        reach: Distance beyond the region of both ends up to which planes are searched [m].
        signs: Signs of the gains on the six sides (6,).
        usual: Modulus of a gain that is not known yet. Not studied.
    """

    def __init__(self, scene: PhaseObservations, reach: float, signs: Tensor, usual: float = 0.7) -> None:
        self.scene, self.reach, self.signs = scene, reach, signs
        self.usual: list[float] = (usual * signs).tolist()
        both = torch.cat([scene.transmitter, scene.receiver])
        self.near: list[float] = (both @ SIDES.T).amax(0).tolist()  # least offset of each side
        self.step = 0.5 / scene.wavenumber
        self.offsets = [
            n + torch.arange(self.step, max(reach, self.step), self.step, dtype=torch.float64) for n in self.near
        ]
        # scans score planes at the former, combinations of moves at the latter
        self._scanned, self._screened = scene.few(64), scene.few_rows(24)

    @cached_property
    def single(self) -> list[Tensor]:
        """Waves of a plane of gain 1 on each side at all its offsets."""
        return [
            field(self._scanned, PlaneSet(n.expand(len(o), 1, 3), o[:, None], torch.ones(len(o), 1), only=((0,),)))
            for n, o in zip(SIDES, self.offsets, strict=True)
        ]

    def key(self, room: PlaneSet) -> tuple[tuple[int, int], ...]:
        """Return a key that is equal for rooms with offsets in the same steps."""
        return tuple((side, round(offset / (2 * self.step))) for side, (offset, _) in room.by_side().items())

    def scan(self, room: PlaneSet, side: int) -> Tensor:
        """Return the scores (C,) over the offsets of a side, without the plane that the room has there."""
        planes, offsets = room.by_side(), self.offsets[side]
        _, gain = planes.pop(side, (0.0, self.usual[side]))
        total = PlaneSet.on_sides(planes, room.order).field(self._scanned) + gain * self.single[side]
        whole = PlaneSet.on_sides({**planes, side: (0.0, gain)}, room.order)
        own = sorted([*planes, side]).index(side)
        if chain := tuple(s for s in whole.sequence if own in s and len(s) > 1):
            offset = whole.offset.repeat(len(offsets), 1)
            offset[:, own] = offsets
            normal, gains = (values.expand(len(offsets), *values.shape[1:]) for values in (whole.normal, whole.gain))
            total += field(self._scanned, PlaneSet(normal, offset, gains, only=chain))
        return self._scanned.score(total)

    def minima(self, room: PlaneSet, side: int, top: int) -> list[tuple[float, float]]:
        """Return score and offset of the lowest local minima over the offsets of a side."""
        v = self.scan(room, side)
        low = ((v[1:-1] <= v[:-2]) & (v[1:-1] < v[2:])).nonzero()[:, 0] + 1
        low = low[v[low].argsort()[:top]]
        return list(zip(v[low].tolist(), self.offsets[side][low].tolist(), strict=True))

    def refined(self, rooms: list[PlaneSet], steps: int = 6) -> list[PlaneSet]:
        """Return the rooms after Levenberg-Marquardt steps with gains of fixed signs, the best first."""
        moved = refine_all(self.scene, rooms, steps, signs=self.signs, limit=2 * self.step)
        return sorted(moved, key=lambda room: float(room.score))

    def beam(self, width: int, order: int) -> PlaneSet:
        """Return the best room of a beam search that adds one plane at a time."""
        rooms = [PlaneSet.on_sides({}, order, float(self.scene.score(self.scene.direct)))]
        for _ in SIDES:
            wider: dict[tuple[tuple[int, int], ...], PlaneSet] = {}
            for room in rooms:
                planes = room.by_side()
                for side in set(range(6)) - set(planes):
                    for score, offset in self.minima(room, side, 4):
                        new = PlaneSet.on_sides({**planes, side: (offset, self.usual[side])}, order, score)
                        wider.setdefault(self.key(new), new)
            if not wider:  # no side left has a minimum within reach
                break
            best = sorted(wider.values(), key=lambda room: float(room.score))[: 3 * width]
            distinct: dict[tuple[tuple[int, int], ...], PlaneSet] = {}
            for room in self.refined(best, 3):  # moves refine these rooms further
                distinct.setdefault(self.key(room), room)
            rooms = list(distinct.values())[:width]
        return rooms[0]

    def alternatives(self, room: PlaneSet, top: int) -> Alternatives:
        """Return (offset, gain) of each side's alternatives.

        These are the present plane, no plane (gain 0), and the minima of scans with and without second-order images.
        """
        planes = room.by_side()

        def of_side(side: int) -> list[tuple[float, float]]:
            offset, gain = planes.get(side, (0.0, self.usual[side]))
            own = [(offset, gain), (offset, 0.0)] if side in planes else [(0.0, 0.0)]
            far: list[float] = []
            for order in (1, SEARCH_ORDER):
                for _, o in self.minima(replace(room, order=order), side, top):
                    if all(abs(o - p) > 2 * self.step for p in far):
                        far.append(o)
            return own + [(o, gain) for o in far]

        return parallel_map(of_side, range(6))

    def responses(self, alternatives: Alternatives) -> SteeringResponses:
        """Return the steering responses of all alternatives."""
        offset = [torch.tensor([o for o, _ in a], dtype=torch.float64) for a in alternatives]
        gain = [torch.tensor([g for _, g in a]) for a in alternatives]
        return SteeringResponses.of(self.scene, SIDES, offset, gain, SEARCH_ORDER)

    def moves(self, alternatives: Alternatives, responses: SteeringResponses, k: int, keep: int) -> list[PlaneSet]:
        """Return the best rooms in which k sides take other alternatives, of which `MAX_ALTERNATIVES` are tried."""
        few, few_responses = self.scene.subset(self._screened), responses.subset(self._screened)
        choices: set[tuple[float, tuple[int, ...]]] = set()
        for which in itertools.combinations(range(6), k):
            base, moving = few_responses.moved(few.direct, which)
            at_few = few, base, moving.first(MAX_ALTERNATIVES.get(k))
            for score, number in best_combinations(
                at_few, (self.scene, *responses.moved(self.scene.direct, which)), keep
            ):
                choice = dict(zip(which, number, strict=True))
                choices.add((score, tuple(choice.get(side, 0) for side in range(6))))
        rooms = []
        for score, numbers in sorted(choices)[:keep]:
            picked = {i: alternatives[i][c] for i, c in enumerate(numbers) if alternatives[i][c][1] != 0}
            rooms.append(PlaneSet.on_sides(picked, SEARCH_ORDER, score))
        return rooms

    def aliases(self, room: PlaneSet) -> Alternatives:
        """Return (offset, gain) of each side's present plane, wherever it is, and of its aliases up to two periods away."""
        aliases, planes = [], room.by_side()
        for side in range(6):
            if side not in planes:
                aliases.append([(0.0, 0.0)])
                continue
            offset, gain = planes[side]
            period = phase_period_m(self.scene, PlaneSet.on_sides({side: (offset, gain)}), 0)
            steps = [offset + m * period for m in (0, -1, 1, -2, 2)]
            aliases.append([(o, gain) for o in steps if o == offset or o >= self.near[side]])
        return aliases

    def improve(self, room: PlaneSet, *, ratio: float = 0.997) -> PlaneSet:
        """Return the room after moves of several planes at a time, with second-order images, until no move is better.

        A move is better if it multiplies the score by less than `ratio` (not studied).
        """
        best = self.refined([replace(room, order=SEARCH_ORDER)])[0]
        for _ in range(MAX_MOVES):
            for tried in self._trials(best):
                if float(tried.score) < ratio * float(best.score):
                    best = tried
                    break
            else:
                break
        return best

    def _trials(self, room: PlaneSet) -> Iterator[PlaneSet]:
        """Yield the best room of each kind of move, cheap kinds first."""
        if float(room.score) < PERFECT_SCORE:
            return
        alternatives = self.alternatives(room, 8)  # for each side
        responses = self.responses(alternatives)
        for k in MAX_ALTERNATIVES:
            yield self.refined(self.moves(alternatives, responses, k, N_REFINED))[0]
        few, aliases = Search(self.scene.few(), self.reach, self.signs), self.aliases(room)
        yield self.refined(few.moves(aliases, few.responses(aliases), 6, N_REFINED))[0]


def find_rooms(
    scene: PhaseObservations, reach: float, width: int, tick: Callable[[], object], *, max_ratio: float = 1.4
) -> list[tuple[Tensor, PlaneSet]]:
    """Return the best room of each of SIGNS with the signs of its gains, the best first.

    Rooms come from beams with and without second-order images. Those that start far behind the best one are left out.

    Args:
        scene: Observed phases at the positions of the search, preferably at most 100.
        reach: Distance beyond the region of both ends up to which planes are searched [m].
        width: Width of the beam search.
        tick: Called after each of the N_STARTS starts.
        max_ratio: Ratio of the scores of a start and of the best room beyond which the start is given up. Not studied.
    """
    nothing = PlaneSet.on_sides({}, score=float(scene.score(scene.direct)))
    if float(nothing.score) < PERFECT_SCORE:
        return [(SIGNS[0], nothing)]
    searches = [Search(scene, reach, signs) for signs in SIGNS]
    searched = list(itertools.product((SEARCH_ORDER, 1), searches))
    rooms = parallel_map(lambda item: item[1].beam(width, item[0]), searched)
    starts = [(room, search) for room, (_, search) in zip(rooms, searched, strict=True)]
    improved: dict[Search, PlaneSet] = {}
    for start, search in sorted(starts, key=lambda s: float(s[0].score)):
        lowest = min((float(room.score) for room in improved.values()), default=math.inf)
        if not improved or PERFECT_SCORE < float(start.score) < max_ratio * lowest:
            room = search.improve(start)
            if search not in improved or room.score < improved[search].score:
                improved[search] = room
        tick()
    best = sorted(improved.items(), key=lambda item: float(item[1].score))
    return [
        (search.signs, room)
        for search, room in best
        if float(room.score) < max(PERFECT_SCORE, max_ratio * float(best[0][1].score))
    ]


def directions() -> Tensor:
    """Return normals to try, float64 (D, 3): all around the horizon, and a Fibonacci lattice on the sphere."""
    around = 2 * math.pi / N_HORIZONTAL_NORMALS * torch.arange(N_HORIZONTAL_NORMALS, dtype=torch.float64)
    upright = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], dim=1)
    number = torch.arange(N_SPHERE_NORMALS, dtype=torch.float64)
    z, turn = 1 - (2 * number + 1) / N_SPHERE_NORMALS, math.pi * (3 - math.sqrt(5)) * number
    flat = (1 - z * z).sqrt()
    return torch.cat([upright, torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)])


def oblique_planes(
    scene: PhaseObservations,
    base: Tensor,
    reach: float,
    top: int,
    *,
    usual: float = 0.7,
    nearest_rad: float = 0.5,
    step_rad: float = 0.6,
) -> list[PlaneSet]:
    """Return the best further planes of any orientation by single reflections, each as a room of its own, the best first.

    Args:
        scene: All positions, of which the 24 nearest to their centre are used.
        base: Field of the known planes (n, 2 K, 1).
        reach: Distance beyond the region of both ends up to which planes are scanned [m].
        top: Number of planes.
        usual: Modulus of the gain that planes are tried with, as in `Search`.
        nearest_rad: Smallest distance of the planes from both ends, in phase [rad]. Not studied.
        step_rad: Step of the scanned distances, in phase [rad]. Not studied.
    """
    both = torch.cat([scene.transmitter, scene.receiver])
    # positions close together, whose waves stay in phase over a few degrees of tilt
    rows = (scene.moving - scene.moving.mean(0)).norm(dim=1).argsort()[:24]
    near, base = scene.subset(rows), base[rows]
    farthest = max(reach * scene.wavenumber, nearest_rad)
    distance = torch.arange(nearest_rad, farthest, step_rad, dtype=torch.float64) / scene.wavenumber
    if not len(distance):
        return []

    def of_normals(normal: Tensor) -> list[PlaneSet]:
        candidates = []
        offset = (both @ normal.T).amax(0)[:, None] + distance
        planes = normal.repeat_interleave(len(distance), dim=0)[:, None], offset.reshape(-1, 1)
        wave = usual * field(near, PlaneSet(*planes, torch.ones(offset.numel(), 1), only=((0,),)))
        for sign in (-1.0, 1.0):
            best = near.score(base + sign * wave).view_as(offset).min(1)
            at, gain = offset.gather(1, best.indices[:, None]), torch.full((1, 1), usual * sign)
            candidates += [
                PlaneSet(n[None, None], o[None], gain, score=v[None])
                for v, n, o in zip(best.values, normal, at, strict=True)
            ]
        return candidates

    every = itertools.chain.from_iterable(parallel_map(of_normals, directions().split(4)))
    return sorted(every, key=lambda plane: float(plane.score))[:top]
