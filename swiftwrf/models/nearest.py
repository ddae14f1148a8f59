"""Look-up of the nearest measured spectrum."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.store import Store
from swiftwrf.models.base import FieldModel, FitContext
from swiftwrf.positions import nearest
from swiftwrf.runtime.checkpoint import Header, expect


class MemoryModel(FieldModel):
    """Base class of models that keep the measured spectra."""

    position: Tensor
    """training positions, float64 (n, 3) [m]"""
    store: Store
    """training spectra (n, H, W)"""

    def _fit(self, train: Spectra, context: FitContext) -> None:
        # by position, then power, so that ties of distances do not depend on the order of the rows
        power = torch.cat([part.flatten(1).double().square().sum(dim=1) for part in train.store.batches()])
        order = torch.from_numpy(np.lexsort([power.numpy(), *train.position.T.numpy()]))
        self.position, self.store = train.position[order], train.store.subset(order)

    def region(self) -> Tensor:
        return self.position

    def _state(self) -> tuple[dict[str, Tensor], Header]:
        return {
            "position": self.position,
            "spectrum": self.store.values if self.store.rows is None else self.store[:],
        }, {}

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        n = len(tensors["position"])
        expect(tensors, {"position": (n, 3), "spectrum": (n, *self.grid.shape)})
        self.position, self.store = tensors["position"].double(), Store(tensors["spectrum"])


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
