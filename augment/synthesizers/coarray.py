"""The array's physics."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import ARRAY, SYNTHESIZERS, Synthesizer
from swiftwrf import CoarrayModel, Spectra, fit_coarray


@SYNTHESIZERS.register(
    "coarray",
    meaning="a Gaussian process in the space that the array's spectra can lie in",
    needs=(ARRAY,),
    colour="#aa3377",
)
class Coarray(Synthesizer):
    """49 numbers a position for a 4 x 4 array, known in a second."""

    samples = True

    def fit(self, train: Spectra) -> None:
        own = self.settings
        self._model = fit_coarray(
            train,
            validation=own.validation,
            seed=own.seed,
            checkpoint=own.checkpoint,
            on_record=own.on_record,
            progress=own.progress,
        )

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position, generator=generator)

    @property
    def model(self) -> CoarrayModel:
        return self._model
