"""Steering responses: the waves of planes at many alternative offsets, and the scores of all combinations of these."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.models.geometry.batched import batched_field, batched_score
from swiftwrf.models.geometry.images import PhaseObservations, sequences

MAX_COMBINATIONS = 1000  # that are scored at a time


@dataclass(frozen=True)
class SteeringResponses:
    """Waves of single and double reflections in P planes, in the order of `batched` fields.

    Args:
        single: Waves of each plane at each of its A offsets, float32 (n, 2 K, A).
        double: Waves of each pair i < j of planes at all their offsets, both orders of reflection together,
            (n, 2 K, A, B).
    """

    single: list[Tensor]
    double: dict[tuple[int, int], Tensor]

    @classmethod
    def of(
        cls, scene: PhaseObservations, normal: Tensor, offset: list[Tensor], gain: list[Tensor], order: int = 2
    ) -> SteeringResponses:
        """Return the waves of planes with normals (P, 3) at offsets (A,) [m] with gains (A,); none are double at order 1."""
        single = [
            batched_field(scene, normal[i].expand(len(o), 1, 3), o[:, None], g[:, None], [(0,)])
            for i, (o, g) in enumerate(zip(offset, gain, strict=True))
        ]
        double = {}
        for i, j in itertools.combinations(range(len(normal)), 2):
            both, pair = normal[[i, j]], torch.cartesian_prod(offset[i], offset[j])
            if chain := [s for s in sequences(both, min(order, 2)) if len(s) > 1]:
                gains = torch.cartesian_prod(gain[i], gain[j])
                waves = batched_field(scene, both.expand(len(pair), 2, 3), pair, gains, chain)
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
        chosen = [functional.one_hot(right[j - half], size[j]).T for j in crossed]
        found = []
        for rows in torch.arange(left.shape[1]).split(max(1, MAX_COMBINATIONS // right.shape[1])):
            total = stay.expand(-1, -1, left.shape[1])[:, :, rows, None] + move[:, :, None]
            between = [
                sum((self.double[i, j].index_select(2, left[i, rows]) for i in pairs[j]), start=torch.zeros(()))
                for j in crossed
            ]
            if len(second) > 1 and between:
                between = [torch.cat(between, dim=-1) @ torch.cat(chosen).float()]
            for waves in between:
                total += waves
            found.append(batched_score(scene, total.flatten(2)))
        return torch.cat(found).reshape(size)

    def _among(self, planes: range, rows: Tensor) -> Tensor:
        """Return the fields (n, 2 K, C) of some neighbouring planes alone, at the offset numbers (P, C)."""
        double = {
            (i - planes.start, j - planes.start): waves
            for (i, j), waves in self.double.items()
            if i in planes and j in planes
        }
        return SteeringResponses(self.single[planes.start : planes.stop], double).of_choices(list(rows))


def _combinations(size: list[int]) -> Tensor:
    """Return the numbers (P, C) of all combinations of P choices, each from size[p] numbers."""
    grids = torch.meshgrid(*map(torch.arange, size), indexing="ij") if size else ()
    return torch.stack([grid.flatten() for grid in grids]) if size else torch.zeros(0, 1, dtype=torch.int64)
