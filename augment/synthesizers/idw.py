"""Inverse-distance weighting (D. Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968)."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.positions import distance

CANDIDATES = (1, 2, 3, 5, 8, 13, 20, 30)


@SYNTHESIZERS.register("idw", meaning="inverse-distance mean of the nearest spectra", colour="#66ccee")
class InverseDistance(Synthesizer):
    """Inverse-distance weighting of the k nearest spectra; k predicts held-out training spectra best."""

    def fit(self, train: Spectra) -> None:
        self._train = train
        fold = folds(train.position, self.settings.validation, self.settings.seed)
        candidates = [k for k in CANDIDATES if k <= len(train) - int(fold.bincount().max())]
        self.k = min(candidates, key=lambda k: self._held_out_loss(k, fold))

    def _held_out_loss(self, k: int, fold: Tensor) -> float:
        position, flat = self._train.position, self._train.spectrum.flatten(1)
        loss = 0.0
        for number in range(int(fold.max()) + 1):
            out = fold == number
            predicted = weights(position[out], position[~out], k) @ flat[~out]
            loss += float((predicted - flat[out]).square().sum())
        return loss

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        weight = weights(position, self._train.position, self.k)
        return (weight @ self._train.spectrum.flatten(1)).reshape(-1, *self._train.grid.shape)


def weights(position: Tensor, known: Tensor, k: int) -> Tensor:
    """Weights (n, m) of the k nearest of m known positions; a known position itself gets all its own."""
    apart, nearest = distance(position.double(), known).topk(k, largest=False)
    inverse = 1 / apart.clamp_min(1e-9)
    weight = torch.zeros(len(position), len(known), dtype=torch.float64)
    return weight.scatter_(1, nearest, inverse / inverse.sum(dim=1, keepdim=True)).float()
