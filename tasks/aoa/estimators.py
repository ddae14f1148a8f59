"""Estimators of the direction of the transmitter from a spectrum, and the baselines that any network must beat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GridSearchCV, KFold
from torch import Tensor
from torch.nn import functional

from augment import Mixed
from swiftwrf import AngularGrid
from swiftwrf.angles import to_angles, to_direction
from swiftwrf.data.spectra import coarsening
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


ESTIMATORS: Registry[Estimator] = Registry("estimator")


@ESTIMATORS.register("peak", meaning="the strongest direction", colour="#bbbbbb")
class Peak(Estimator):
    """The strongest direction: what one has without learning. Multipath is often stronger than the line of sight."""

    learns = False

    def fit(self, train: Mixed) -> None:
        """Nothing to learn."""

    def estimate(self, spectrum: Tensor) -> Tensor:
        grid, pixel = self.settings.grid, spectrum.flatten(1).argmax(dim=1)
        row, column = pixel // grid.n_azimuth, pixel % grid.n_azimuth
        return torch.stack([grid.azimuth[column], grid.elevation[row]], dim=-1)


@ESTIMATORS.register("constant", meaning="the mean direction of the measured labels", colour="#999999")
class Constant(Estimator):
    """The mean direction of the training labels, whatever the spectrum: what an estimator must beat to have learnt."""

    learns = False

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


@ESTIMATORS.register(
    "kernel_ridge", meaning="kernel ridge regression from the spectrum to the direction", colour="#44aa99"
)
class KernelRegression(Estimator):
    """Kernel ridge regression (Saunders et al. 1998) from coarse spectra to unit vectors: strong where spectra are few.

    Width and penalty are chosen by cross-validation on the training spectra.
    """

    AZIMUTHS = 60  # the array's beams are wider than these columns
    CHOSEN_ROWS, KEPT_ROWS = 400, 4000  # its cost grows with their cube

    def fit(self, train: Mixed) -> None:
        order = np.random.default_rng(self.settings.seed).permutation(len(train))[: self.KEPT_ROWS]
        feature = self._feature(train.spectrum)[order]
        direction = to_direction(*train.label.unbind(-1)).numpy()[order]
        self._mean = direction.mean(axis=0)
        some = feature[: self.CHOSEN_ROWS]
        apart = ((some[:, None, ::7] - some[None, :, ::7]) ** 2).sum(axis=-1) * 7  # every seventh pixel will do
        width = 1 / max(float(np.median(apart[~np.eye(len(some), dtype=bool)])), 1e-9)
        grid = {"alpha": [1e-4, 1e-3, 1e-2, 1e-1], "gamma": [factor * width for factor in (0.1, 0.3, 1.0, 3.0)]}
        folds = KFold(min(5, len(some)), shuffle=True, random_state=self.settings.seed)
        search = GridSearchCV(KernelRidge(kernel="rbf"), grid, cv=folds, scoring="neg_mean_absolute_error", refit=False)
        search.fit(some, direction[: self.CHOSEN_ROWS] - self._mean)
        self._regression = KernelRidge(kernel="rbf", **search.best_params_).fit(feature, direction - self._mean)

    def estimate(self, spectrum: Tensor) -> Tensor:
        pointing = self._regression.predict(self._feature(spectrum)) + self._mean
        return torch.stack(to_angles(torch.from_numpy(pointing)), dim=-1)

    def _feature(self, spectrum: Tensor) -> NDArray[Any]:
        factor = coarsening(spectrum.shape[1:], self.AZIMUTHS)
        coarse: NDArray[Any] = functional.avg_pool2d(spectrum[:, None], factor).flatten(1).double().numpy()
        return coarse


def learners() -> list[str]:
    """Names of the estimators that more labelled spectra can make better."""
    return [entry.name for entry in ESTIMATORS.entries() if cast(type[Estimator], entry.make).learns]
