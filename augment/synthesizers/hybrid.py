"""The room, and the smooth part of what it leaves."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import ARRAY, FIXED_END, SYNTHESIZERS, Synthesizer
from augment.synthesizers.geometry import find_room
from swiftwrf import Spectra
from swiftwrf.models.geometry import HybridModel, fit_hybrid, refit_geometry


@SYNTHESIZERS.register(
    "hybrid",
    meaning="geometry with paths as strong as they are in each place, and a Gaussian process on what it leaves",
    needs=(ARRAY, FIXED_END),
    colour="#332288",
)
class Hybrid(Synthesizer):
    """A share of the spectra of the room's paths and a smooth remainder; held-out training spectra choose the share, and
    whether the strengths of the paths vary."""

    samples = True

    def fit(self, train: Spectra) -> None:
        room, self.shared_seconds = find_room(train, self.settings)
        self._model = fit_hybrid(train, room, validation=self.settings.validation, seed=self.settings.seed)

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, Hybrid)
        given, seed = self.settings, self.settings.seed
        room = refit_geometry(other.model.geometry, train, seed=seed)
        self._model = fit_hybrid(train, room, validation=given.validation, seed=seed, like=other.model)

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position, generator)

    @property
    def model(self) -> HybridModel:
        return self._model
