"""Estimators of the direction of the transmitter from a spectrum: the baselines that any network must beat."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from augment import Mixed
from swiftwrf import AngularGrid
from swiftwrf.angles import to_angles, to_direction


class Estimator(Protocol):
    """Learns from spectra and labels, then tells the direction behind a spectrum."""

    def fit(self, train: Mixed) -> None:
        """Learns from labelled spectra."""

    def estimate(self, spectrum: Tensor) -> Tensor:
        """Azimuth and elevation (n, 2) [rad] of spectra (n, H, W)."""


class Peak:
    """The strongest direction: what one has without learning. Multipath is often stronger than the line of sight."""

    def __init__(self, grid: AngularGrid) -> None:
        self._grid = grid

    def fit(self, train: Mixed) -> None:
        """Nothing to learn."""

    def estimate(self, spectrum: Tensor) -> Tensor:
        pixel = spectrum.flatten(1).argmax(dim=1)
        row, column = pixel // self._grid.n_azimuth, pixel % self._grid.n_azimuth
        return torch.stack([self._grid.azimuth[column], self._grid.elevation[row]], dim=-1)


class Constant:
    """The mean direction of the training labels, whatever the spectrum: what an estimator must beat to have learnt."""

    def fit(self, train: Mixed) -> None:
        mean = to_direction(*train.label.unbind(-1)).mean(dim=0)
        self._angles = torch.stack(to_angles(mean), dim=-1)

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self._angles.expand(len(spectrum), 2)


class NearestSpectrum:
    """The label of the training spectrum with the least squared difference: look-up, hard to beat on a dense path."""

    def fit(self, train: Mixed) -> None:
        self._spectrum, self._label = train.spectrum.flatten(1), train.label

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self._label[torch.cdist(spectrum.flatten(1), self._spectrum).argmin(dim=1)]
