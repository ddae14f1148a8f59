"""Estimators that any network must beat."""

from __future__ import annotations

import torch
from torch import Tensor

from augment import Mixed
from swiftwrf.array.angles import to_angles, to_direction
from tasks.aoa.estimators.base import ESTIMATORS, Estimator


@ESTIMATORS.register("peak")
class Peak(Estimator):
    """The strongest direction: what one has without learning. Multipath is often stronger than the line of sight."""

    learns = False

    def fit(self, train: Mixed) -> None:
        """Nothing to learn."""

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self.settings.grid.peak_direction(spectrum)


@ESTIMATORS.register("constant")
class Constant(Estimator):
    """The mean direction of the training labels, whatever the spectrum: what an estimator must beat to have learnt."""

    learns = False

    def fit(self, train: Mixed) -> None:
        mean = to_direction(*train.label.unbind(-1)).mean(dim=0)
        self._angles = torch.stack(to_angles(mean), dim=-1)

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self._angles.expand(len(spectrum), 2)


@ESTIMATORS.register("nearest_spectrum")
class NearestSpectrum(Estimator):
    """The label of the training spectrum with the least squared difference: look-up, hard to beat on a dense path."""

    def fit(self, train: Mixed) -> None:
        self._train = train

    def estimate(self, spectrum: Tensor) -> Tensor:
        flat, start = spectrum.flatten(1), 0
        least, label = torch.full((len(flat),), torch.inf), self._train.label.new_empty(len(flat), 2)
        for part in self._train.batches():
            apart, number = torch.cdist(flat, part.flatten(1)).min(dim=1)
            nearer = apart < least
            least, label[nearer] = torch.minimum(apart, least), self._train.label[start + number[nearer]]
            start += len(part)
        return label
