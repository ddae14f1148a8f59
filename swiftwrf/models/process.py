"""Field models whose dependence on position is one Gaussian process, which more spectra update in closed form."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess
from swiftwrf.models.base import FieldModel


class ProcessModel(FieldModel):
    """Base class of field models that a Gaussian process of some values interpolates between the training positions.

    An update adds values to the process. Kernel, noise, mean spectrum and components stay as fitted.
    """

    updates = True

    process: GaussianProcess
    """process of the values"""

    def expected_error(self, position: Tensor) -> Tensor:
        """Return the expected error at positions (n, 3) [m] relative to that far from all training positions, (n,)."""
        return (self.process.variance(self._process_position(position)) + self.process.kernel.noise).sqrt()

    def _process_position(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] in the frame of the process."""
        return position

    @abstractmethod
    def _values(self, new: Spectra) -> Tensor:
        """Return the values (k, K) of the process that represent spectra."""

    def _update(self, new: Spectra) -> None:
        self.process = self.process.updated(self._process_position(new.position), self._values(new))

    def _forget(self, rows: Tensor) -> None:
        n = len(self.process.known)
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < n:
            raise InputError(f"the model has training rows 0 to {n - 1}, but was asked to forget others")
        self.process = self.process.without(rows)

    def _age(self, correlation: float) -> None:
        self.process = self.process.aged(correlation)
