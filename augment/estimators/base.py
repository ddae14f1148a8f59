"""Interface of the estimators of the direction of the transmitter."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from augment import Mixed
from swiftwrf import AngularGrid, Spectra
from swiftwrf.data.spectra import to_directions
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import Configured, NonNegativeInt, Preset, configuration


@configuration
class EstimatorConfig:
    """Options of every estimator.

    Example:
        >>> EstimatorConfig(seed=3).seed
        3
    """

    seed: NonNegativeInt = 0
    """seed of everything random"""

    @classmethod
    def for_scene(cls, n_spectra: int, preset: Preset, **options: Any) -> Self:
        """Return the options for a scene with `n_spectra` training spectra if all of them are measured.

        The length of a training depends on the scene alone, not on the training set. Otherwise the condition with the
        longest training would win.
        """
        return cls(**options)


class Estimator(Configured, ABC):
    """Base class of all estimators: fit to labelled spectra, then predict the direction behind a spectrum.

    One that also derives from `Saved` has a file, which `swiftwrf.load` opens on the CPU.

    Args:
        config: Options as one object. Defaults to `config_type()`.
        options: Single options, which replace those of `config`.

    Raises:
        InputError: An unknown option, or a value outside its range.

    Example:
        >>> make_estimator("peak").trainable
        False
    """

    config_type: ClassVar[type[Any]] = EstimatorConfig
    """dataclass of the options"""
    trainable: ClassVar[bool] = True
    """whether more labelled spectra can reduce the error"""
    fitted_attribute = "grid"
    saved: ClassVar[str] = "grid"
    """what the file of an estimator contains that is `Saved`, too"""

    grid: AngularGrid
    """grid of the training spectra, set by `fit`"""
    history: list[dict[str, Any]]
    """step, loss and seconds during the training, set by `fit`"""

    def fit(self, train: Mixed, *, device: torch.device | str = "cpu") -> Self:
        """Fit the estimator to labelled spectra and return it.

        Args:
            train: Training set.
            device: Device to compute on.
        """
        self.grid, self.history = train.grid, []
        self._fit(train, torch.device(device))
        return self

    @abstractmethod
    def _fit(self, train: Mixed, device: torch.device) -> None:
        """Fit to a training set on the grid `self.grid`."""

    @abstractmethod
    def predict(self, spectra: Tensor) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of spectra (n, H, W)."""

    def estimate(self, data: Spectra) -> Tensor:
        """Return azimuth and elevation (n, 2) [rad] of measurements."""
        name, batches = f"directions of {type(self).__name__}", data.store.batches()
        parts = [to_directions(name, self.predict(part), len(part)) for part in batches]
        return torch.cat(parts) if parts else torch.empty(0, 2, dtype=torch.float64)

    @classmethod
    def lacking(cls, data: Spectra) -> str:
        """Return a sentence about what the data lack for this estimator, or an empty text if they have it."""
        return ""


def estimated(estimator: Estimator, data: Spectra) -> Tensor:
    """Return the directions of measurements by an estimator of any class, checked, float64 (n, 2) [rad]."""
    return to_directions(f"directions of {type(estimator).__name__}", estimator.estimate(data), len(data))


ESTIMATORS: Registry[Estimator] = Registry("estimator", "swiftwrf.estimators")


def make_estimator(name: str, n_spectra: int = 0, preset: Preset = "quick", **options: Any) -> Estimator:
    """Return an estimator by its name.

    Args:
        name: Name in the registry, e.g. "kernel_regression".
        n_spectra: Number of training spectra of the scene, which determines the length of a training.
        preset: Size and length of the training.
        options: Options such as the seed.

    Raises:
        InputError: An unknown name, or a value outside its range.

    Example:
        >>> make_estimator("kernel_regression", seed=3).config.seed
        3
    """
    estimator: type[Estimator] = ESTIMATORS[name]
    return estimator(estimator.config_type.for_scene(n_spectra, preset, **options))
