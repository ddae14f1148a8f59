"""Steering responses: the waves of planes at many alternative offsets, and the scores of all combinations of these."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import PhaseObservations, field, sequences

N_INNER = 3  # planes whose combinations are scored at a time


@dataclass(frozen=True)
class SteeringResponses:
    """Waves of single and double reflections in P planes.

    Args:
        single: Waves of each plane at each of its A offsets, complex64 (A, n, K).
        double: Waves of each pair i < j of planes at all their offsets, both orders of reflection together, (A, B, n, K).
    """

    single: list[Tensor]
    double: dict[tuple[int, int], Tensor]

    @classmethod
    def of(
        cls, scene: PhaseObservations, normal: Tensor, offset: list[Tensor], gain: list[Tensor], order: int = 2
    ) -> SteeringResponses:
        """Return the waves of planes with normals (P, 3) at offsets (A,) [m] with gains (A,); none are double at order 1."""
        single = [
            field(scene, normal[i].expand(len(o), 1, 3), o[:, None], g[:, None], [(0,)])
            for i, (o, g) in enumerate(zip(offset, gain, strict=True))
        ]
        double = {}
        for i, j in itertools.combinations(range(len(normal)), 2):
            both, pair = normal[[i, j]], torch.cartesian_prod(offset[i], offset[j])
            chain = [s for s in sequences(both, min(order, 2)) if len(s) > 1]
            gains = torch.cartesian_prod(gain[i], gain[j])
            waves = field(scene, both.expand(len(pair), 2, 3), pair, gains, chain)
            double[i, j] = waves.reshape(len(offset[i]), len(offset[j]), *waves.shape[1:])
        return cls(single, double)

    def at(self, rows: list[Tensor]) -> SteeringResponses:
        """Return the waves at the given offset numbers (A,) of each plane."""
        double = {(i, j): waves[rows[i]][:, rows[j]] for (i, j), waves in self.double.items()}
        return SteeringResponses([waves[r] for waves, r in zip(self.single, rows, strict=True)], double)

    def moved(self, direct: Tensor, moving: tuple[int, ...]) -> tuple[Tensor, SteeringResponses]:
        """Return the field (n, K) of the planes that stay at their first offsets, with the direct wave.

        Also return the waves that the moving planes add to it.
        """
        stay = [i for i in range(len(self.single)) if i not in moving]
        base = sum((self.single[i][0] for i in stay), start=direct)
        base = sum((self.double[pair][0, 0] for pair in itertools.combinations(stay, 2)), start=base)
        single = []
        for i in moving:
            beside = [self.double[i, j][:, 0] if i < j else self.double[j, i][0] for j in stay]
            single.append(sum(beside, start=self.single[i]))
        double = {(p, q): self.double[i, j] for (p, i), (q, j) in itertools.combinations(enumerate(moving), 2)}
        return base, SteeringResponses(single, double)

    def scores(self, scene: PhaseObservations, base: Tensor) -> Tensor:
        """Return the scores (A, B, ...) of all combinations of the planes' offsets, added to a field (n, K)."""
        planes = len(self.single)
        outer, inner = range(max(planes - N_INNER, 0)), range(max(planes - N_INNER, 0), planes)
        among = base
        for i, j in itertools.combinations(inner, 2):
            among = among + _spread(self.double[i, j], [i - inner.start, j - inner.start], len(inner))
        found = []
        for choice in itertools.product(*[range(len(self.single[i])) for i in outer]):
            total = among + sum(self.single[i][choice[i]] for i in outer)
            total = total + sum(self.double[i, j][choice[i], choice[j]] for i, j in itertools.combinations(outer, 2))
            for axis, j in enumerate(inner):
                own = sum((self.double[i, j][choice[i]] for i in outer), start=self.single[j])
                total = total + _spread(own, [axis], len(inner))
            found.append(scene.score(total))
        return torch.stack(found).reshape([len(waves) for waves in self.single])


def _spread(waves: Tensor, axes: list[int], k: int) -> Tensor:
    """Return waves (A, [B,] n, K) with their first dimensions at the given ones of k dimensions."""
    shape = [1] * k
    for axis, size in zip(axes, waves.shape, strict=False):
        shape[axis] = size
    return waves.reshape(*shape, *waves.shape[-2:])
