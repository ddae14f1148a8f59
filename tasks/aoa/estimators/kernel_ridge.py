"""Regression that is strong where spectra are few."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from augment import Mixed
from swiftwrf.array.angles import AngularGrid, to_angles, to_direction
from swiftwrf.runtime.checkpoint import Header
from tasks.aoa.estimators.base import ESTIMATORS, SavedEstimator, Settings
from tasks.aoa.estimators.radial import RadialRegression, coarse_pixels, kept_rows


@ESTIMATORS.register("kernel_ridge")
class KernelRegression(SavedEstimator):
    """Kernel ridge regression from coarse spectra to directions: strong where spectra are few."""

    kind = "kernel ridge regression"

    def fit(self, train: Mixed) -> None:
        rows, seed = kept_rows(len(train), self.settings.seed), self.settings.seed
        feature = np.concatenate([self._feature(part) for part in train.batches()])[rows]
        direction = to_direction(*train.label.unbind(-1)).numpy()[rows]
        self._direction = RadialRegression.fit(feature, direction, seed)

    def estimate(self, spectrum: Tensor) -> Tensor:
        return torch.stack(to_angles(torch.from_numpy(self._direction(self._feature(spectrum)))), dim=-1)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        tensors, header = self._direction.state()
        return tensors, header | {"grid": asdict(self.settings.grid)}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> KernelRegression:
        own = cls(Settings(AngularGrid(**header["grid"])))
        pixels = own._feature(torch.zeros(1, *own.settings.grid.shape)).shape[1]
        own._direction = RadialRegression.from_state(tensors, header, pixels, 3)
        return own

    def _feature(self, spectrum: Tensor) -> NDArray[Any]:
        coarse: NDArray[Any] = coarse_pixels(spectrum).double().numpy()
        return coarse
