"""What the synthesizers of `swiftwrf.comparison` have in common: all but their names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from augment.synthesizers.base import Synthesizer
from swiftwrf import Spectra
from swiftwrf.comparison import Drawing, fit


class Published(Synthesizer):
    """A published method in its quick or its published size."""

    config: ClassVar[Any]
    """class of its configurations; the defaults are the quick preset"""

    def fit(self, train: Spectra) -> None:
        own = self.settings
        config = self.config.paper() if own.preset == "paper" else self.config()
        self._model: Any = fit(
            train,
            replace(config, seed=own.seed),
            device=own.device,
            checkpoint=own.checkpoint,
            on_record=own.on_record,
            progress=own.progress,
        )

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        drawing = {"generator": generator} if self.samples else {}
        drawn: Tensor = self._model.synthesize(position, **drawing)
        return drawn

    @property
    def model(self) -> Drawing:
        model: Drawing = self._model
        return model
