"""A Gaussian process on the pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, choose_kernel


@SYNTHESIZERS.register("gp", meaning="a Gaussian process on the pixels", colour="#ee8866")
class PixelProcess(Synthesizer):
    """A Gaussian process on the pixels, its kernel chosen as SwiftWRF's motion prior is: the best blurred picture.

    A sample is one of its posterior at each position; what neighbouring positions have in common is not drawn.
    """

    samples = True

    def fit(self, train: Spectra) -> None:
        fold = folds(train.position, self.settings.validation, self.settings.seed)
        self._process = GaussianProcess(choose_kernel(train.position, train.spectrum, fold), train.position)
        self._mean = train.spectrum.mean(dim=0)
        self._change = train.spectrum - self._mean

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        weight = self._process.weights(position).float()
        if generator is not None:
            # the spectra's own covariance between pixels, scaled by what is unknown at each position
            n = len(self._change)
            unknown = self._process.variance(position).sqrt().float() / math.sqrt(n)
            weight = weight + unknown[:, None] * torch.randn(len(position), n, generator=generator)
        change = weight @ self._change.flatten(1)
        drawn: Tensor = self._mean + change.reshape(-1, *self._mean.shape)
        return drawn.clamp(0, 1)
