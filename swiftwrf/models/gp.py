"""A Gaussian process on the pixels of the spectra."""

from __future__ import annotations

import math
from dataclasses import asdict

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, Kernel, choose_kernel, thinned
from swiftwrf.models.base import FitContext
from swiftwrf.models.nearest import MemoryModel
from swiftwrf.runtime.checkpoint import Header


class GPModel(MemoryModel):
    """Gaussian process regression of every pixel with one kernel, chosen by cross-validation.

    A prediction among more than 2000 training spectra uses the nearest 64. A sample is drawn from the marginal posterior of
    each position; correlation between positions is not sampled.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> GPModel().fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "gp"
    kind = "pixel Gaussian process"
    samples = True

    kernel: Kernel

    def _fit(self, train: Spectra, context: FitContext) -> None:
        super()._fit(train, context)
        fold = folds(train.position, self.config.validation, self.config.seed)
        self.kernel = choose_kernel(train.position, train.store, fold)
        self._prepare()

    def _prepare(self) -> None:
        """Precompute what predictions share: mean, process, and differences from the mean, if they are few."""
        self._mean = self.store.mean()
        self._process = GaussianProcess(self.kernel, self.position)
        some = self.store[:] if self._process.exact else thinned(self.store)[0]
        self._change = (some - self._mean).flatten(1)

    def _mean_change(self, position: Tensor) -> Tensor:
        """Return predicted differences from the mean spectrum (b, pixels)."""
        rows, weight = self._process.weights(position)
        change = self._change if self._process.exact else (self.store[rows] - self._mean).flatten(1)
        return weight.float() @ change

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return self._mean + self._mean_change(position).reshape(-1, *grid.shape), None

    def _sample(self, position: Tensor, grid: AngularGrid, generator: torch.Generator) -> Tensor:
        variance, n = self._process.variance(position), len(self._change)
        # the covariance of the training spectra between pixels, scaled by the posterior variance of each position
        scale = variance.sqrt().float()[:, None] / math.sqrt(n)
        noise = scale * torch.randn(len(position), n, generator=generator)
        return self._mean + (self._mean_change(position) + noise @ self._change).reshape(-1, *grid.shape)

    def _state(self) -> tuple[dict[str, Tensor], Header]:
        return super()._state()[0], {"kernel": asdict(self.kernel)}

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        super()._restore(tensors, header)
        self.kernel = Kernel(**header["kernel"])
        self._prepare()
