"""Estimators that any network must beat."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from augment import Mixed
from augment.estimators.base import ESTIMATORS, Estimator
from swiftwrf.array.angles import to_angles, to_direction
from swiftwrf.array.planar import folded_angles
from swiftwrf.data.store import Store
from swiftwrf.runtime.checkpoint import Saved

SHORTLIST = 8  # candidates found by inner products, whose differences are then computed


@ESTIMATORS.register("peak")
class Peak(Estimator):
    """The direction with the largest magnitude, folded as the labels. A reflection is often stronger than the line of sight.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Peak().fit(Mixed.measured(room)).predict(room.spectrum).shape
        torch.Size([20, 2])
    """

    trainable = False

    def _fit(self, train: Mixed, device: torch.device) -> None:
        self._array = train.array

    def predict(self, spectra: Tensor) -> Tensor:
        return folded_angles(self._array, self.grid.peak_direction(spectra))


@ESTIMATORS.register("constant")
class Constant(Estimator):
    """The mean direction of the training labels, whatever the spectrum.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Constant().fit(Mixed.measured(room)).predict(room.spectrum).unique(dim=0).shape
        torch.Size([1, 2])
    """

    trainable = False

    def _fit(self, train: Mixed, device: torch.device) -> None:
        mean = to_direction(*train.label.unbind(-1)).mean(dim=0)
        self._angles = torch.stack(to_angles(mean), dim=-1)

    def predict(self, spectra: Tensor) -> Tensor:
        return self._angles.expand(len(spectra), 2)


@ESTIMATORS.register("nearest_spectrum")
class NearestSpectrum(Estimator, Saved):
    """The label of the training spectrum with the least squared difference, hard to beat on a dense path.

    Inner products find candidates fast, but lose the digits in which similar spectra differ. Among the candidates, the
    float64 differences decide.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> predicted = NearestSpectrum().fit(Mixed.measured(room)).predict(room.spectrum)
        >>> torch.equal(predicted, room.label)
        True
    """

    kind = "nearest spectrum"
    saved = "spectrum label"
    label: Annotated[Tensor, "float64 n 2"]

    def _fit(self, train: Mixed, device: torch.device) -> None:
        self.label, self._batches = train.label, train.batches

    def predict(self, spectra: Tensor) -> Tensor:
        queries, start = spectra.flatten(1).double(), 0
        least = torch.full((len(queries),), torch.inf, dtype=torch.float64)
        label = self.label.new_empty(len(queries), 2)
        for batch in self._batches():
            known = batch.flatten(1).double()
            shortlist = torch.cdist(queries, known).topk(min(SHORTLIST, len(known)), largest=False).indices
            for number in shortlist.T:
                distance = (queries - known[number]).square().sum(dim=1)
                nearer = distance < least
                least, label[nearer] = torch.minimum(distance, least), self.label[start + number[nearer]]
            start += len(batch)
        return label

    @property
    def spectrum(self) -> Annotated[Tensor, "float16 n grid.n_elevation grid.n_azimuth"]:
        """Training spectra with the precision of a file."""
        return torch.cat(list(self._batches())).half()

    @spectrum.setter
    def spectrum(self, values: Tensor) -> None:
        self._batches = Store(values.float()).batches
