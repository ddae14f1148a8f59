"""Synthesizers: spectra at any position from measured ones, behind one protocol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from swiftwrf import FitConfig, InputError, Spectra, SwiftWRF, fit
from swiftwrf.coarray import fit_coarray
from swiftwrf.deformation import Kernel
from swiftwrf.fit import folds
from swiftwrf.fit_config import Validation
from swiftwrf.prior import choose_kernel


class Synthesizer(Protocol):
    """Learns from spectra, then draws one at any position."""

    def fit(self, train: Spectra) -> None:
        """Learns; `train` is all it ever sees."""

    def synthesize(self, position: Tensor) -> Tensor:
        """Magnitudes in [0, 1], float32 (n, H, W), at positions (n, 3) [m]."""


class Nearest:
    """The spectrum of the nearest measured position: the baseline that a dense path makes hard to beat."""

    def fit(self, train: Spectra) -> None:
        self._train = train

    def synthesize(self, position: Tensor) -> Tensor:
        return self._train.spectrum[torch.cdist(position.double(), self._train.position).argmin(dim=1)]


class InverseDistance:
    """Inverse-distance weighting of the k nearest spectra (Shepard 1968); k predicts held-out training spectra best."""

    CANDIDATES = (1, 2, 3, 5, 8, 13, 20, 30)

    def __init__(self, validation: Validation, seed: int) -> None:
        self._validation: Validation = validation
        self._seed = seed

    def fit(self, train: Spectra) -> None:
        self._train = train
        fold = folds(train.position, self._validation, self._seed)
        candidates = [k for k in self.CANDIDATES if k <= len(train) - int(fold.bincount().max())]
        self.k = min(candidates, key=lambda k: self._held_out_loss(k, fold))

    def _held_out_loss(self, k: int, fold: Tensor) -> float:
        position, flat = self._train.position, self._train.spectrum.flatten(1)
        loss = 0.0
        for number in range(int(fold.max()) + 1):
            out = fold == number
            predicted = _inverse_distance(position[out], position[~out], k) @ flat[~out]
            loss += float((predicted - flat[out]).square().sum())
        return loss

    def synthesize(self, position: Tensor) -> Tensor:
        weight = _inverse_distance(position, self._train.position, self.k)
        return (weight @ self._train.spectrum.flatten(1)).reshape(-1, *self._train.grid.shape)


def _inverse_distance(position: Tensor, known: Tensor, k: int) -> Tensor:
    """Weights (n, m) of the k nearest of m known positions; a known position itself gets all its own."""
    distance, nearest = torch.cdist(position.double(), known).topk(k, largest=False)
    inverse = 1 / distance.clamp_min(1e-9)
    weight = torch.zeros(len(position), len(known), dtype=torch.float64)
    return weight.scatter_(1, nearest, inverse / inverse.sum(dim=1, keepdim=True)).float()


class GaussianProcess:
    """A Gaussian process on the pixels, its kernel chosen as SwiftWRF's motion prior is: the best blurred picture."""

    def __init__(self, validation: Validation, seed: int) -> None:
        self._validation: Validation = validation
        self._seed = seed

    def fit(self, train: Spectra) -> None:
        self._train = train
        self._mean = train.spectrum.mean(dim=0)
        self._kernel: Kernel = choose_kernel(
            train.position, train.spectrum, folds(train.position, self._validation, self._seed)
        )
        gram = self._kernel(train.position, train.position)
        self._inverse = torch.linalg.inv(gram + self._kernel.noise * torch.eye(len(gram), dtype=gram.dtype))

    def synthesize(self, position: Tensor) -> Tensor:
        weight = (self._kernel(position.double(), self._train.position) @ self._inverse).float()
        change = weight @ (self._train.spectrum - self._mean).flatten(1)
        drawn: Tensor = self._mean + change.reshape(-1, *self._train.grid.shape)
        return drawn.clamp(0, 1)


class Coarray:
    """The array's physics: 49 numbers a position for a 4 x 4 array, known in a second."""

    def __init__(self, validation: Validation, seed: int) -> None:
        self._validation: Validation = validation
        self._seed = seed

    def fit(self, train: Spectra) -> None:
        self._model = fit_coarray(train, validation=self._validation, seed=self._seed)

    def synthesize(self, position: Tensor) -> Tensor:
        return self._model.synthesize(position)

    def save(self, path: Path) -> None:
        """Writes the fitted model."""
        self._model.save(path)


class SwiftWRFSynthesizer:
    """The model of this package."""

    def __init__(self, config: FitConfig, **options: Any) -> None:
        self._config, self._options = config, options

    def fit(self, train: Spectra) -> None:
        self._model: SwiftWRF = fit(train, self._config, **self._options)

    def synthesize(self, position: Tensor) -> Tensor:
        return self._model.synthesize(position)

    def save(self, path: Path) -> None:
        """Writes the fitted model."""
        self._model.save(path)


def make_synthesizer(
    name: str,
    *,
    validation: Validation = "random",
    seed: int = 0,
    config: FitConfig | None = None,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[dict[str, Any]], None] | None = None,
) -> Synthesizer:
    """The synthesizer of that name.

    Args:
        name: one of `SYNTHESIZERS`.
        validation: how those that choose a setting hold out training spectra: at random, or a region at a time where
            the positions to come lie apart from the measured ones.
        seed: of what is random in them.
        config, device, checkpoint, on_record: of the SwiftWRF fit; see `swiftwrf.fit`.

    Raises:
        InputError: an unknown name.
    """
    if name == "nearest":
        return Nearest()
    if name == "idw":
        return InverseDistance(validation, seed)
    if name == "gp":
        return GaussianProcess(validation, seed)
    if name == "coarray":
        return Coarray(validation, seed)
    if name == "swiftwrf":
        config = replace(config or FitConfig(), validation=validation, seed=seed)
        return SwiftWRFSynthesizer(config, device=device, checkpoint=checkpoint, on_record=on_record)
    raise InputError(f"unknown synthesizer {name!r}; choose from {', '.join(SYNTHESIZERS)}")


SYNTHESIZERS = ("swiftwrf", "nearest", "idw", "gp", "coarray")
