"""Estimators of the direction of the transmitter from a spectrum, and the baselines that any network must beat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from augment import Mixed
from swiftwrf import AngularGrid
from swiftwrf.angles import to_angles, to_direction
from swiftwrf.registry import Registry
from tasks.run import Preset


@dataclass(frozen=True)
class Settings:
    """What estimators are made with; each takes what it needs.

    Args:
        grid: of the spectra.
        seed: of what is random.
        device: where to train.
        preset: how large and how long.
    """

    grid: AngularGrid
    seed: int = 0
    device: torch.device | str = "cpu"
    preset: Preset = "quick"


class Estimator(ABC):
    """Learns from spectra and labels, then estimates the direction behind a spectrum.

    Args:
        settings: what it is made with.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.history: list[dict[str, Any]] = []  # step, loss and seconds as training goes on

    @abstractmethod
    def fit(self, train: Mixed) -> None:
        """Learns from labelled spectra."""

    @abstractmethod
    def estimate(self, spectrum: Tensor) -> Tensor:
        """Azimuth and elevation (n, 2) [rad] of spectra (n, H, W)."""


ESTIMATORS: Registry[Estimator] = Registry("estimator")


@ESTIMATORS.register("peak", meaning="the strongest direction", colour="#bbbbbb")
class Peak(Estimator):
    """The strongest direction: what one has without learning. Multipath is often stronger than the line of sight."""

    def fit(self, train: Mixed) -> None:
        """Nothing to learn."""

    def estimate(self, spectrum: Tensor) -> Tensor:
        grid, pixel = self.settings.grid, spectrum.flatten(1).argmax(dim=1)
        row, column = pixel // grid.n_azimuth, pixel % grid.n_azimuth
        return torch.stack([grid.azimuth[column], grid.elevation[row]], dim=-1)


@ESTIMATORS.register("constant", meaning="the mean direction of the measured labels", colour="#999999")
class Constant(Estimator):
    """The mean direction of the training labels, whatever the spectrum: what an estimator must beat to have learnt."""

    def fit(self, train: Mixed) -> None:
        mean = to_direction(*train.label.unbind(-1)).mean(dim=0)
        self._angles = torch.stack(to_angles(mean), dim=-1)

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self._angles.expand(len(spectrum), 2)


@ESTIMATORS.register("nearest_spectrum", meaning="the label of the most similar measured spectrum", colour="#666666")
class NearestSpectrum(Estimator):
    """The label of the training spectrum with the least squared difference: look-up, hard to beat on a dense path."""

    def fit(self, train: Mixed) -> None:
        self._spectrum, self._label = train.spectrum.flatten(1), train.label

    def estimate(self, spectrum: Tensor) -> Tensor:
        return self._label[torch.cdist(spectrum.flatten(1), self._spectrum).argmin(dim=1)]
