"""Models that keep the measured spectra: the nearest one, and inverse-distance weighting of a few.

D. Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import each_fold, folds
from swiftwrf.data.store import Store
from swiftwrf.gp import dense_weights, inner_products, subsample
from swiftwrf.models.base import FieldModel
from swiftwrf.positions import distance, nearest
from swiftwrf.runtime.validation import PositiveInt

MAX_CHOICE_SPECTRA = 2000  # that choose the number of neighbours


class MemoryModel(FieldModel):
    """Base class of models that keep the measured spectra."""

    saved = "position spectrum"
    position: Annotated[Tensor, "float64 n 3"]
    """training positions [m]"""
    store: Store
    """training spectra (n, H, W)"""

    def _fit(self, train: Spectra, **_: Any) -> None:
        # by position, then power, so that ties of distances do not depend on the order of the rows
        power = torch.cat([part.flatten(1).double().square().sum(dim=1) for part in train.store.batches()])
        order = torch.from_numpy(np.lexsort([power.numpy(), *train.position.T.numpy()]))
        self.position, self.store = train.position[order], train.store.subset(order)

    def region(self) -> Tensor:
        return self.position

    @property
    def spectrum(self) -> Annotated[Tensor, "uint8|float n grid.n_elevation grid.n_azimuth"]:
        """Training spectra in the type of their source."""
        is_whole = self.store.rows is None and self.store.factor == 1
        return self.store.values if is_whole else self.store[:]

    @spectrum.setter
    def spectrum(self, values: Tensor) -> None:
        self.store = Store(values)


class NearestModel(MemoryModel):
    """The spectrum of the nearest measured position, a baseline that dense positions make hard to beat.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> NearestModel().fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "nearest"
    kind = "nearest-spectrum model"

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return self.store[nearest(position, self.position, 1)[1][:, 0]], None


class IDWModel(MemoryModel):
    """Inverse-distance weighting of the k nearest spectra; cross-validation chooses k.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> IDWModel(seed=1).fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "idw"
    kind = "inverse-distance model"

    saved = "k"
    k: PositiveInt
    """number of neighbours, at most that of the training positions"""

    def _fit(self, train: Spectra, **_: Any) -> None:
        super()._fit(train)
        (rows,) = subsample(torch.arange(len(train)), rows=MAX_CHOICE_SPECTRA)
        fold = folds(self.position, self.config.validation, self.config.seed)[rows]
        candidates = [k for k in (1, 2, 3, 5, 8, 13, 20, 30) if k <= len(rows) - int(fold.bincount().max())]
        position, gram = self.position[rows], inner_products(self.store[rows])
        self.k = min(candidates, key=lambda k: _held_out_loss(k, position, gram, fold))

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        rows, weight = dense_weights(*weights(position, self.position, self.k))
        return torch.tensordot(weight, self.store[rows], dims=1), None

    def _restored(self) -> None:
        super()._restored()
        self.k = min(self.k, len(self.position))


def _held_out_loss(k: int, position: Tensor, gram: Tensor, fold: Tensor) -> float:
    loss = 0.0
    for out, kept in each_fold(fold):
        neighbour, value = weights(position[out], position[kept], k)
        weight = -torch.eye(len(fold), dtype=gram.dtype)[out]  # predicted minus held-out spectra
        weight.scatter_(1, kept[neighbour], value.to(gram.dtype))
        loss += float(((weight @ gram) * weight).sum())
    return loss


def weights(position: Tensor, known: Tensor, k: int, min_distance: float = 1e-9) -> tuple[Tensor, Tensor]:
    """Return the indices of the k nearest known positions and their weights, (n, k).

    At a known position its own weight is 1. Differentiable in `position` (n, 3) [m]. `min_distance` [m] prevents a division
    by 0.
    """
    separation, number = nearest(position, known, k)
    if position.requires_grad:  # the search for neighbours is not differentiable, their distances are
        separation = distance(position[:, None], known[number])[:, 0]
    inverse = 1 / separation.clamp_min(min_distance)
    return number, (inverse / inverse.sum(dim=1, keepdim=True)).float()
