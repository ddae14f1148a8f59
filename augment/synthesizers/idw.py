"""Inverse-distance weighting (D. Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968)."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import EXACT, inner_products, squared_errors, thinned
from swiftwrf.positions import nearest
from swiftwrf.runtime.threads import single_thread

CANDIDATES = (1, 2, 3, 5, 8, 13, 20, 30)


@SYNTHESIZERS.register("idw", meaning="inverse-distance mean of the nearest spectra", colour="#66ccee")
class InverseDistance(Synthesizer):
    """Inverse-distance weighting of the k nearest spectra; k predicts held-out training spectra best."""

    def fit(self, train: Spectra) -> None:
        self._train = train
        (rows,) = thinned(torch.arange(len(train)), rows=EXACT)
        fold = folds(train.position, self.settings.validation, self.settings.seed)[rows]
        candidates = [k for k in CANDIDATES if k <= len(rows) - int(fold.bincount().max())]
        some = train.subset(rows)
        gram = inner_products(some.spectrum)
        self.k = min(candidates, key=lambda k: _held_out_loss(k, some.position, gram, fold))

    @single_thread()
    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        number, weight = weights(position, self._train.position, self.k)
        drawn = torch.empty(len(position), *self._train.grid.shape)
        for i, (rows, share) in enumerate(zip(number, weight, strict=True)):
            torch.tensordot(share, self._train.store[rows], dims=1, out=drawn[i])
        return drawn


def _held_out_loss(k: int, position: Tensor, gram: Tensor, fold: Tensor) -> float:
    loss = 0.0
    for number in fold.unique():
        out, kept = fold == number, fold != number
        near, share = weights(position[out], position[kept], k)
        weight = torch.zeros(len(near), int(kept.sum()), dtype=gram.dtype).scatter_(1, near, share.to(gram.dtype))
        loss += float(squared_errors(gram, out, kept, weight).sum())
    return loss


def weights(position: Tensor, known: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Numbers of the k nearest of known positions, and their weights, (n, k); a known position itself gets all its own."""
    apart, number = nearest(position, known, k)
    inverse = 1 / apart.clamp_min(1e-9)
    return number, (inverse / inverse.sum(dim=1, keepdim=True)).float()
