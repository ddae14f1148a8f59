"""Field models whose dependence on position is one Gaussian process, which more spectra update in closed form."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel, choose_kernel
from swiftwrf.models.base import FieldModel


class ProcessModel(FieldModel):
    """Base class of field models that a Gaussian process of some values interpolates between the training positions.

    An update adds values to the process. Kernel, noise, mean spectrum and components stay as fitted. `with_chosen_kernel`
    chooses kernel and noise again.
    """

    updates = True

    process: GaussianProcess
    """process of the values"""

    def expected_error(self, position: Tensor) -> Tensor:
        """Return the expected error at positions (n, 3) [m] relative to that far from all training positions, (n,)."""
        self.check_fitted()
        return (self.process.variance(self._process_position(position)) + self.process.kernel.noise).sqrt()

    @property
    def kernel(self) -> Kernel:
        """Kernel of the process, lengths in [m]."""
        self.check_fitted()
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
        position = model.process.known
        fold = folds(position, self.config.validation, self.config.seed)
        model._set_process(model.process.with_kernel(choose_kernel(position, model._weighted_values(), fold)))
        return model

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
        self.process = self.process.without(rows)

    def _age(self, correlation: float) -> None:
        self.process = self.process.aged(correlation)
