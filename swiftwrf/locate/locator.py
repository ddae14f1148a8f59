"""The base class of locators: a calibrated pool of likelihoods and the posterior on candidate positions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from swiftwrf.locate.posterior import HeldOut, Inflation, PoolWeights, Posterior, calibrated_pool, normalised
from swiftwrf.locate.region import Cells, Region
from swiftwrf.runtime.checkpoint import Saved


class Locator(Saved):
    """Base class of posteriors over the position of the moving end, given an observation.

    The posterior mass of a candidate is its prior mass times a product of likelihoods, each to the power of its weight.
    """

    fitted_attribute = "likelihoods"

    likelihoods: Any
    """likelihoods that are pooled, set by `fit`"""
    weight: PoolWeights
    """their weights, float64 (k,)"""
    inflation: Inflation
    """factor of credible radii"""
    region: Region
    """prior over positions"""
    cells: Cells
    """cells of the region"""

    @property
    def _resolution_m(self) -> float:
        """Edge of the smallest cells [m]."""
        return self.cells.edge_m

    def _calibrate(self, held_out: Iterable[HeldOut]) -> Tensor:
        """Choose weights and inflation by held-out folds, and return the errors there, (n,) [m]."""
        floors = self.region.floors
        self.weight, self.inflation, error = calibrated_pool(list(held_out), self._resolution_m, floors)
        return error

    def _posterior(self, position: Tensor, values: Tensor, log_volume: Tensor) -> Posterior:
        """Return the posterior on candidates with log-likelihoods (k, n, m); other arguments as of `HeldOut`."""
        log_mass = normalised(torch.einsum("k,knm->nm", self.weight, values.double()) + log_volume)
        return Posterior(position, log_mass, self._resolution_m, self.inflation, floors=self.region.floors)
