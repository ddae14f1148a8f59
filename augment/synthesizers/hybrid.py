"""The room, and the smooth part of what it leaves."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import ARRAY, FIXED_END, SYNTHESIZERS, Synthesizer
from augment.synthesizers.geometry import find_room
from swiftwrf import GeometryModel, Spectra
from swiftwrf.geometry import HybridModel, fit_hybrid, refit_geometry


@SYNTHESIZERS.register(
    "hybrid",
    meaning="geometry, and a Gaussian process on what it leaves",
    needs=(ARRAY, FIXED_END),
    colour="#332288",
)
class Hybrid(Synthesizer):
    """A share of the geometry's spectra and a smooth remainder; the share is chosen on held-out training spectra."""

    samples = True

    def fit(self, train: Spectra) -> None:
        room, self.shared_seconds = find_room(train, self.settings)
        self._fit(train, room)

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, Hybrid)
        self._fit(train, refit_geometry(other.model.geometry, train, seed=self.settings.seed))

    def _fit(self, train: Spectra, room: GeometryModel) -> None:
        self._model = fit_hybrid(train, room, validation=self.settings.validation, seed=self.settings.seed)

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position, generator)

    @property
    def model(self) -> HybridModel:
        return self._model
