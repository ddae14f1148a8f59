"""A Gaussian process on the pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import EXACT, GaussianProcess, NearbyProcess, choose_kernel, thinned


@SYNTHESIZERS.register("gp", meaning="a Gaussian process on the pixels", colour="#ee8866")
class PixelProcess(Synthesizer):
    """A Gaussian process on the pixels, its kernel chosen as SwiftWRF's motion prior is: the best blurred picture.

    Among more than 2000 spectra the nearest 64 tell of a position. A sample is one of the process' posterior at each
    position; what neighbouring positions have in common is not drawn.
    """

    samples = True

    def fit(self, train: Spectra) -> None:
        fold = folds(train.position, self.settings.validation, self.settings.seed)
        kernel = choose_kernel(train.position, train.store, fold)
        self._train, self._mean = train.store, train.store.mean()
        self._process: GaussianProcess | NearbyProcess
        if len(train) <= EXACT:
            self._process = GaussianProcess(kernel, train.position)
            self._change = train.spectrum - self._mean
        else:
            self._process = NearbyProcess(kernel, train.position)
            self._change = thinned(train.store)[0] - self._mean

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        # the spectra's own covariance between pixels, scaled by what is unknown at each position
        n = len(self._change)
        if isinstance(self._process, GaussianProcess):
            weight = self._process.weights(position).float()
            if generator is not None:
                unknown = self._process.variance(position).sqrt().float() / math.sqrt(n)
                weight = weight + unknown[:, None] * torch.randn(len(position), n, generator=generator)
            change = (weight @ self._change.flatten(1)).reshape(-1, *self._mean.shape)
        else:
            number, near, variance = self._process.weights(position)
            change = torch.empty(len(position), *self._mean.shape)
            for i, (rows, weight) in enumerate(zip(number, near.float(), strict=True)):
                torch.tensordot(weight, self._train[rows] - self._mean, dims=1, out=change[i])
            if generator is not None:
                noise = (variance.float() / n).sqrt()[:, None] * torch.randn(len(position), n, generator=generator)
                change += (noise @ self._change.flatten(1)).reshape(change.shape)
        drawn: Tensor = self._mean + change
        return drawn.clamp(0, 1)
