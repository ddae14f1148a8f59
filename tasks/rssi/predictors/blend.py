"""Several predictors in one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack, vstack
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.data.splits import folds
from tasks.rssi.predictors.base import PREDICTORS, Predictor, Settings, lacks

BLENDED = ("swiftwrf", "gp", "knn", "mri_residual")
MOST_PAIRS = 5000  # that the weights of a blend are found on


@PREDICTORS.register(
    "blend",
    meaning=f"a weighted mean of {', '.join(BLENDED)}, its weights from held-out training rows",
    colour="#332288",
)
class Blend:
    """A weighted mean of the best predictors. The weights, the same at all receivers, are those with the least absolute
    error on held-out training rows (stacking: L. Breiman, "Stacked regressions", Machine Learning 24, 1996)."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def fit(self, train: Rssi) -> None:
        names = [name for name in BLENDED if not lacks(name, train)]
        fold = folds(train.transmitter_position, self._settings.validation, self._settings.seed)
        held_out = torch.full((len(names), *train.rssi_dbm.shape), torch.nan, dtype=torch.float64)
        for number in fold.unique():
            out = fold == number
            place = train.transmitter_position[out]
            for i, name in enumerate(names):
                held_out[i, out] = self._fitted(name, train, (~out).nonzero()[:, 0]).predict(place).double()
        heard = ~train.rssi_dbm.isnan()
        self.weights = dict(zip(names, self._weights(held_out[:, heard].T, train.rssi_dbm[heard]), strict=True))
        self._members = {
            name: self._fitted(name, train, torch.arange(len(train)))
            for name, weight in self.weights.items()
            if weight > 0
        }

    def _fitted(self, name: str, train: Rssi, rows: Tensor) -> Predictor:
        """A member, fitted to some rows."""
        pool = self._settings.pool
        predictor = PREDICTORS[name].make(replace(self._settings, pool=pool and pool.subset(rows)))
        predictor.fit(train.subset(rows))
        return predictor

    def _weights(self, predicted: Tensor, measured: Tensor) -> list[float]:
        """Non-negative, of sum 1, for predictions (n, m) of n values: a linear programme in weights and absolute errors."""
        some = np.random.default_rng(self._settings.seed).permutation(len(measured))[:MOST_PAIRS]
        known, values = csr_array(predicted.numpy()[some]), measured.numpy()[some]
        n, m = known.shape
        size = eye_array(n)
        result = linprog(
            c=np.concatenate([np.zeros(m), np.ones(n)]),
            A_ub=vstack([hstack([known, -size]), hstack([-known, -size])]),
            b_ub=np.concatenate([values, -values]),
            A_eq=np.concatenate([np.ones(m), np.zeros(n)])[None],
            b_eq=[1.0],
        )
        weight: list[float] = result.x[:m].tolist()
        return weight

    def predict(self, position: Tensor) -> Tensor:
        parts = [self.weights[name] * member.predict(position).double() for name, member in self._members.items()]
        return torch.stack(parts).sum(dim=0)
