"""Kernel regression from coarse spectra to directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from augment import Mixed
from augment.estimators.base import ESTIMATORS, SavedEstimator
from augment.estimators.nadaraya_watson import NadarayaWatson, coarse_pixels, kept_rows
from swiftwrf.array.angles import to_angles, to_direction
from swiftwrf.runtime.checkpoint import Header

BATCH_SPECTRA = 512  # spectra that are loaded at a time


@ESTIMATORS.register("kernel_regression")
class KernelRegression(SavedEstimator):
    """Kernel regression from coarse spectra to directions, accurate for few training spectra.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=40)
        >>> KernelRegression(seed=1).fit(Mixed.measured(room)).predict(room.spectrum).shape
        torch.Size([40, 2])
    """

    kind = "kernel regression"

    def _fit(self, train: Mixed, device: torch.device) -> None:
        rows = torch.from_numpy(kept_rows(len(train), self.config.seed))
        features = np.concatenate([_features(train.select(some)) for some in rows.split(BATCH_SPECTRA)])
        direction = to_direction(*train.label[rows].unbind(-1)).numpy()
        self._direction = NadarayaWatson.fit(features, direction, self.config.seed)

    def predict(self, spectra: Tensor) -> Tensor:
        return torch.stack(to_angles(torch.from_numpy(self._direction(_features(spectra)))), dim=-1)

    def _state(self) -> tuple[dict[str, Tensor], Header]:
        return self._direction.state()

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        pixels = _features(torch.zeros(1, *self.grid.shape)).shape[1]
        self._direction = NadarayaWatson.from_state(tensors, header, pixels, 3)


def _features(spectra: Tensor) -> NDArray[Any]:
    coarse: NDArray[Any] = coarse_pixels(spectra).double().numpy()
    return coarse
