"""A Gaussian process on the pixels of the spectra."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, choose_kernel
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.models.process import ProcessModel


class GPModel(ProcessModel, MemoryModel):
    """Gaussian process regression of every pixel with one kernel, chosen by cross-validation.

    A prediction among more than 2000 training spectra uses the nearest 64.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> GPModel().fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "gp"
    kind = "pixel Gaussian process"

    def _fit(self, train: Spectra, **_: Any) -> None:
        self.position, self.store = train.position, train.store
        fold = folds(train.position, self.config.validation, self.config.seed)
        # without values, for weights and variances alone
        self._set_process(GaussianProcess(choose_kernel(train.position, train.store, fold), train.position))
        self._set_spread(
            train,
            fold,
            lambda rows: (self.store[rows] - self._mean).flatten(1),
            lambda change, _: self._mean + change.reshape(-1, *self.grid.shape),
        )

    def _set_process(self, process: GaussianProcess) -> None:
        """Take a process, and precompute the mean and, if each prediction needs all spectra, their differences from it."""
        self._mean, self.process = self.store.mean(), process
        self._change = (self.store[:] - self._mean).flatten(1) if process.is_exact else None

    def _values(self, new: Spectra) -> Tensor:
        return torch.zeros(len(new), 0)  # the values are the spectra of the store

    def _weighted_values(self) -> Store:
        return self.store

    def _update(self, new: Spectra) -> None:
        super()._update(new)
        self.position, self.store = self.process.known, self.store.joined(new.store)
        self._set_process(self.process)

    def _forget(self, rows: Tensor) -> None:
        super()._forget(rows)
        kept = torch.ones(len(self.store), dtype=torch.bool)
        kept[rows] = False
        self.position, self.store = self.process.known, self.store.subset(kept)
        self._set_process(self.process)

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        number, weight = self.process.weights(position)
        weight = weight.float()
        if self._change is None:  # each position has few spectra of its own
            mean = torch.empty(len(position), *grid.shape)
            for row, (near, own) in enumerate(zip(number, weight, strict=True)):
                mean[row] = torch.tensordot(own, self.store[near], dims=1) + (1 - own.sum()) * self._mean
        else:
            mean = self._mean + (weight @ self._change).reshape(-1, *grid.shape)
        return mean, self._std(position, grid) if with_std else None

    def _restored(self) -> None:
        super()._restored()
        if len(self.store) != len(self.process.known):
            raise InputError(f"{len(self.process.known)} positions have {len(self.store)} spectra")
        self._set_process(self.process)
