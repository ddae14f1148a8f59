"""The model of this package."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import FitConfig, Spectra, SwiftWRF, fit


@SYNTHESIZERS.register("swiftwrf", meaning="2D Gaussians that move with the position", colour="#4477aa")
class SwiftWRFSynthesizer(Synthesizer):
    """2D Gaussians that move with the position, as many as the scene needs."""

    def fit(self, train: Spectra) -> None:
        own = self.settings
        config = FitConfig.paper() if own.preset == "paper" else FitConfig()
        self._model = fit(
            train,
            replace(config, validation=own.validation, seed=own.seed),
            device=own.device,
            checkpoint=own.checkpoint,
            on_record=own.on_record,
            progress=own.progress,
        )

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position)

    @property
    def model(self) -> SwiftWRF:
        return self._model
