"""Field models whose dependence on position is one Gaussian process, which more spectra update in closed form.

The standard deviation of a measurement at position s and direction d is

    std(s, d) = spread(d) sqrt(variance(s) + noise)

with the variance of the process relative to its prior. The spread follows from the errors at held-out training spectra, such
that 80 % of their pixels are inside their 80 % intervals.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Annotated, Self

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds, places
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel, choose_kernel, leave_folds_out, subsample
from swiftwrf.metrics import HALF_WIDTH, interval_factor
from swiftwrf.models.base import FieldModel

MAX_HELD_OUT = 100  # training spectra that determine the spread
SHRINKAGE_SPECTRA = 5.0  # weight of the mean over directions in the spread of each one, in spectra


class ProcessModel(FieldModel):
    """Base class of field models that a Gaussian process of some values interpolates between the training positions.

    An update adds values to the process. Kernel, noise, mean spectrum, components and spread stay as fitted.
    `with_chosen_kernel` chooses kernel and noise again.
    """

    updates = True

    saved = "process spread"
    process: GaussianProcess
    """process of the values"""
    spread: Annotated[Tensor, "float32 grid.n_elevation grid.n_azimuth"]
    """standard deviation of a measurement far from all training positions"""

    def expected_error(self, position: Tensor) -> Tensor:
        """Return the expected error at positions (n, 3) [m] relative to that far from all training positions, (n,)."""
        return (self.process.variance(self._process_position(position)) + self.process.kernel.noise).sqrt()

    def region(self) -> Tensor:
        return self.process.known.cpu()

    @property
    def kernel(self) -> Kernel:
        """Kernel of the process, lengths in [m]."""
        return self.process.kernel

    def with_chosen_kernel(self, without: Tensor | None = None) -> Self:
        """Return the model with the kernel and noise that predict held-out training spectra best. This model stays as it is.

        Mean spectrum and components stay as fitted.

        Args:
            without: Numbers of training spectra that are forgotten first, int64. Defaults to none.

        Raises:
            InputError: As `forget`, or a model that cannot be updated.

        Example:
            >>> import swiftwrf, torch
            >>> data = swiftwrf.simulated_room(n=60, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
            >>> model = swiftwrf.make_model("gp").fit(data.subset(torch.arange(15)))
            >>> model.update(data.subset(torch.arange(15, 60))).with_chosen_kernel().kernel.noise > 0
            True
        """
        model = self._copy() if without is None else self.forget(without)
        position, before = model.process.known.cpu(), model.process.kernel
        fold = folds(position, self.config.validation, self.config.seed)
        model._set_process(model.process.with_kernel(choose_kernel(position, model._weighted_values(), fold)))
        (rows,) = subsample(torch.arange(len(position)), rows=MAX_HELD_OUT)
        old, new = (
            torch.cat([variance for *_, variance in leave_folds_out(kernel, position, fold, rows)]).mean().sqrt()
            for kernel in (before, model.process.kernel)
        )
        model.spread = self.spread * float(old / new)  # of noisy values at held-out positions
        return model

    def _set_spread(
        self,
        train: Spectra,
        fold: Tensor,
        value: Callable[[Tensor], Tensor],
        spectrum: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Determine the spread by training spectra that are held out from the process.

        Args:
            train: Training spectra.
            fold: Number of the fold of each spectrum, (n,).
            value: Returns the values (r, K) of the process at rows (r,) of the training spectra.
            spectrum: Returns spectra (b, H, W) at rows (b,) from held-out values (b, K).
        """
        (rows,) = subsample(torch.arange(len(train)), rows=MAX_HELD_OUT)
        scores, order = [], []
        for own, others, weight, variance in leave_folds_out(self.process.kernel, train.position, fold, rows):
            predicted = spectrum(weight.float() @ value(others).float(), own).clamp(0, 1)
            scores.append((predicted - train.store[own]).abs() / variance.sqrt().float()[:, None, None])
            order.append(own)
        score = torch.cat(scores)
        square = score.square()
        total = square.sum(dim=0) + SHRINKAGE_SPECTRA * square.mean()
        spread = (total / (len(score) + SHRINKAGE_SPECTRA)).sqrt().clamp_min(1e-6)
        place = places(train.position)[torch.cat(order)]
        self.spread = spread * interval_factor(score / (HALF_WIDTH * spread), place)

    def _std(self, position: Tensor, grid: AngularGrid) -> Tensor:
        """Return the standard deviation (b, H, W) of measurements at positions (b, 3) [m]."""
        spread = self.spread
        if grid != self.grid:  # that of the nearest direction
            row = ((grid.elevation - self.grid.elevation_start) / self.grid.elevation_step).round().long()
            column = ((grid.azimuth - self.grid.azimuth_start) / self.grid.azimuth_step).round().long()
            spread = spread[row.clamp(0, self.grid.n_elevation - 1)][:, column % self.grid.n_azimuth]
        return self.expected_error(position).float()[:, None, None] * spread

    def _set_process(self, process: GaussianProcess) -> None:
        self.process = process

    def _process_position(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] in the frame of the process."""
        return position

    @abstractmethod
    def _values(self, new: Spectra) -> Tensor:
        """Return the values (k, K) of the process that represent spectra."""

    @abstractmethod
    def _weighted_values(self) -> Tensor | Store:
        """Return the values (n, ...) of the process, weighted such that their squared errors are those of the spectra."""

    def _update(self, new: Spectra) -> None:
        self.process = self.process.updated(self._process_position(new.position), self._values(new))

    def _forget(self, rows: Tensor) -> None:
        n = len(self.process.known)
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < n:
            raise InputError(f"the model has training rows 0 to {n - 1}, but was asked to forget others")
        if len(rows.unique()) == n:
            raise InputError(f"the model was asked to forget all of its {n} training rows; fit another one")
        self.process = self.process.without(rows)

    def _age(self, correlation: float) -> None:
        self.process = self.process.aged(correlation)
