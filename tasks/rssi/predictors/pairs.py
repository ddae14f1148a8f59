"""Neighbours among pairs of positions, where both ends move."""

from __future__ import annotations

from torch import Tensor, from_numpy

from swiftwrf.rssi import PairPredictor
from tasks.rssi.predictors.regressors import choose_neighbours


class PairKNN(PairPredictor):
    """Inverse-distance mean of the k nearest measured pairs of positions; k by cross-validation in the training rows."""

    name = "knn_pairs"

    def _fit_pairs(self, pair: Tensor, rssi: Tensor, fold: Tensor) -> None:
        self._regressor = choose_neighbours(pair.numpy(), rssi.numpy(), fold.numpy())

    def _at_pairs(self, pair: Tensor) -> tuple[Tensor, None]:
        if not len(pair):  # scikit-learn refuses it
            return pair.new_zeros(0), None
        return from_numpy(self._regressor.predict(pair.detach().numpy())), None
