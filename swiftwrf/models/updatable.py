"""Updates of fitted field models with more spectra."""

from __future__ import annotations

from abc import abstractmethod
from copy import copy
from typing import ClassVar, Self

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra, check_spectra
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import checked


class Updatable:
    """Base class of fitted models that more spectra can update. A subclass implements `_update` and sets `updates`."""

    updates: ClassVar[bool] = False
    """whether `update` is available; other models must be fitted again"""

    kind: ClassVar[str]
    grid: AngularGrid
    bounds: Tensor

    @abstractmethod
    def check_fitted(self) -> None:
        """Raise InputError if the model is not fitted."""

    @single_thread()
    @checked
    def update(self, new: Spectra) -> Self:
        """Return the model with more training spectra, by an update of its factorisation. This model stays as it is.

        The result equals a fit to all spectra with the same kernel, noise and components. The planes of a room are refined
        and not searched, which needs 10 new positions.

        Args:
            new: Spectra of the same scene on the grid of the training spectra, any number.

        Raises:
            InputError: A model that must be fitted again, another grid, or a spectrum that is not finite.

        Example:
            >>> import swiftwrf
            >>> data = swiftwrf.simulated_room(n=50)
            >>> model = swiftwrf.make_model("coarray").fit(data.subset(torch.arange(40)))
            >>> model.update(data.subset(torch.arange(40, 50))).process.known.shape
            torch.Size([50, 3])
        """
        model = self._copy()
        if new.grid != self.grid:
            raise InputError(
                f"{new.name} has another grid than the training spectra; give spectra of {self.grid.shape}"
            )
        check_spectra(new)
        if len(new):
            model.bounds = bounding_box(torch.cat([self.bounds, new.position]))
            model._update(new)
        return model

    def forget(self, rows: Tensor) -> Self:
        """Return the model without some of its training spectra; see `update`.

        Args:
            rows: Numbers of training spectra, in the order in which the model received them, int64.

        Raises:
            InputError: A model that must be fitted again, or a number outside the range.
        """
        model = self._copy()
        model._forget(rows)
        return model

    def aged(self, correlation: float) -> Self:
        """Return the model after a change of the scene, for which earlier spectra count less than new ones.

        Args:
            correlation: Correlation of the fields before and after the change, above 0 and at most 1.

        Raises:
            InputError: A model that must be fitted again, or a correlation outside the range.
        """
        if not 0 < correlation <= 1:
            raise InputError(f"correlation must be above 0 and at most 1, got {correlation}")
        model = self._copy()
        model._age(correlation)
        return model

    def _copy(self) -> Self:
        """Return a copy that shares all tensors."""
        self.check_fitted()
        return copy(self)

    def _update(self, new: Spectra) -> None:
        """Add checked spectra to this copy."""
        raise InputError(f"{self.kind}: cannot be updated; fit it again to all spectra")

    def _forget(self, rows: Tensor) -> None:
        """Remove training spectra from this copy."""
        raise InputError(f"{self.kind}: cannot forget single spectra; fit it again to the others")

    def _age(self, correlation: float) -> None:
        """Lower the weight of the training spectra of this copy."""
        raise InputError(f"{self.kind}: cannot weigh earlier spectra less; fit it again to the new ones")


def bounding_box(position: Tensor) -> Tensor:
    """Return the lower and upper corner (2, 3) of the box around positions (n, 3) [m]."""
    position = check_positions(position)
    return torch.stack([position.amin(dim=0), position.amax(dim=0)])
