"""A Gaussian process on the pixels."""

from __future__ import annotations

from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, choose_kernel


@SYNTHESIZERS.register("gp", meaning="a Gaussian process on the pixels", colour="#ee8866")
class PixelProcess(Synthesizer):
    """A Gaussian process on the pixels, its kernel chosen as SwiftWRF's motion prior is: the best blurred picture."""

    def fit(self, train: Spectra) -> None:
        fold = folds(train.position, self.settings.validation, self.settings.seed)
        self._process = GaussianProcess(choose_kernel(train.position, train.spectrum, fold), train.position)
        self._mean = train.spectrum.mean(dim=0)
        self._change = train.spectrum - self._mean

    def synthesize(self, position: Tensor) -> Tensor:
        change = self._process.weights(position).float() @ self._change.flatten(1)
        drawn: Tensor = self._mean + change.reshape(-1, *self._mean.shape)
        return drawn.clamp(0, 1)
