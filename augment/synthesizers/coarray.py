"""The array's physics."""

from __future__ import annotations

from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import CoarrayModel, Spectra, fit_coarray


@SYNTHESIZERS.register(
    "coarray",
    meaning="a Gaussian process in the space that the array's spectra can lie in",
    needs=("array",),
    colour="#aa3377",
)
class Coarray(Synthesizer):
    """49 numbers a position for a 4 x 4 array, known in a second."""

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

    def synthesize(self, position: Tensor) -> Tensor:
        return self._model.synthesize(position)

    @property
    def model(self) -> CoarrayModel:
        return self._model
