"""What every estimator of the direction of the transmitter is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from augment import Mixed
from swiftwrf import AngularGrid
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.registry import Registry
from tasks.run import Preset


@dataclass(frozen=True)
class Settings:
    """What estimators are made with; each takes what it needs.

    Args:
        grid: of the spectra.
        seed: of what is random.
        device: where to train.
        preset: how large and how long.
        spectra: that there would be with everything measured: how long a training lasts, whatever it is given, must follow
            from one number, or the longer training would win.
    """

    grid: AngularGrid
    seed: int = 0
    device: torch.device | str = "cpu"
    preset: Preset = "quick"
    spectra: int = 0


class Estimator(ABC):
    """Learns from spectra and labels, then estimates the direction behind a spectrum.

    Args:
        settings: what it is made with.
    """

    learns: ClassVar[bool] = True
    """whether more labelled spectra can make it better"""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.history: list[dict[str, Any]] = []  # step, loss and seconds as training goes on

    @abstractmethod
    def fit(self, train: Mixed) -> None:
        """Learns from labelled spectra."""

    @abstractmethod
    def estimate(self, spectrum: Tensor) -> Tensor:
        """Azimuth and elevation (n, 2) [rad] of spectra (n, H, W)."""


class SavedEstimator(Estimator, Saved):
    """One that a file can hold once it is trained: `swiftwrf.load` brings it back, ready to estimate."""


ESTIMATORS: Registry[Estimator] = Registry("estimator")


def learners() -> list[str]:
    """Names of the estimators that more labelled spectra can make better."""
    return [entry.name for entry in ESTIMATORS.entries() if cast(type[Estimator], entry.make).learns]
