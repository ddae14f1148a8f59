"""The model of this package."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Settings, Synthesizer
from swiftwrf import FitConfig, Spectra, SwiftWRF, fit
from swiftwrf.rasterize import prepare


@SYNTHESIZERS.register("swiftwrf", meaning="2D Gaussians that move with the position", colour="#4477aa")
class SwiftWRFSynthesizer(Synthesizer):
    """2D Gaussians that change with the position, as many as the scene needs."""

    shared = True

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        prepare(settings.device)

    def fit(self, train: Spectra) -> None:
        self._fit(train, FitConfig.paper() if self.settings.preset == "paper" else FitConfig())

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, SwiftWRFSynthesizer)
        n = other.model.config.n_primitives
        config = FitConfig()
        self._fit(train, replace(config, model=replace(config.model, n_primitives=n)))

    def _fit(self, train: Spectra, config: FitConfig) -> None:
        own = self.settings
        self._model = fit(
            train,
            replace(config, validation=own.validation, seed=own.seed),
            device=own.device,
            checkpoint=own.checkpoint,
            on_record=own.on_record,
            progress=own.progress,
            group=own.group,
        )

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position)

    def deviation(self, position: Tensor) -> Tensor | None:
        return self._model.synthesize(position, return_std=True)[1] if self._model.knows_deviation else None

    @property
    def model(self) -> SwiftWRF:
        return self._model
