"""Several predictors in one."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack, vstack
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.data.splits import folds
from swiftwrf.rssi import PredictorConfig, RssiFitContext, RssiPredictor
from swiftwrf.runtime.validation import configuration
from tasks.rssi.predictors.base import PREDICTORS, Preset, make_predictor

MAX_PAIRS = 5000  # that the weights of a blend are found on


@configuration
class BlendConfig(PredictorConfig):
    """Options of `Blend`."""

    members: tuple[str, ...] = ("swiftwrf", "gp", "knn", "mri_residual")
    """names of the predictors; those whose requirements the data do not meet are left out"""
    preset: Preset = "quick"
    """configuration of the members"""


@PREDICTORS.register("blend")
class Blend(RssiPredictor):
    """A weighted mean of other predictors, weights by cross-validation.

    The weights, the same at all receivers, have the lowest absolute error on held-out training rows (stacking: L. Breiman,
    "Stacked regressions", Machine Learning 24, 1996).
    """

    name = "blend"
    config_type = BlendConfig
    slow = True

    weights: dict[str, float]
    """weight of each member, set by `fit`"""

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        names = [name for name in self.config.members if not PREDICTORS[name].lacking(train)]
        fold = folds(train.transmitter_position, self.config.validation, self.config.seed)
        held_out = torch.full((len(names), *train.rssi_dbm.shape), torch.nan, dtype=torch.float64)
        for number in fold.unique():
            out = fold == number
            position = train.transmitter_position[out]
            for i, name in enumerate(names):
                held_out[i, out] = self._member(name, train, context, ~out).predict(position).mean.double()
        detected = ~train.rssi_dbm.isnan()
        weights = self._weights(held_out[:, detected].T, train.rssi_dbm[detected])
        self.weights = dict(zip(names, weights, strict=True))
        every = torch.ones_like(fold, dtype=torch.bool)
        self._members = {name: self._member(name, train, context, every) for name in names if self.weights[name] > 0}

    def _member(self, name: str, train: Rssi, context: RssiFitContext, kept: Tensor) -> RssiPredictor:
        """Return a member, fitted to the kept rows (rows,)."""
        rows = kept.nonzero()[:, 0]
        member = make_predictor(name, self.config.preset, validation=self.config.validation, seed=self.config.seed)
        return member.fit(
            train.subset(rows), pool=context.pool.subset(rows), device=context.device, parallel=context.parallel
        )

    def _weights(self, predicted: Tensor, measured: Tensor) -> list[float]:
        """Return non-negative weights of sum 1 for predictions (n, m) of n values, by a linear programme.

        Its variables are the weights and the absolute errors.
        """
        some = np.random.default_rng(self.config.seed).permutation(len(measured))[:MAX_PAIRS]
        matrix, values = csr_array(predicted.numpy()[some]), measured.numpy()[some]
        n, m = matrix.shape
        size = eye_array(n)
        result = linprog(
            c=np.concatenate([np.zeros(m), np.ones(n)]),
            A_ub=vstack([hstack([matrix, -size]), hstack([-matrix, -size])]),
            b_ub=np.concatenate([values, -values]),
            A_eq=np.concatenate([np.ones(m), np.zeros(n)])[None],
            b_eq=[1.0],
        )
        weight: list[float] = result.x[:m].tolist()
        return weight

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        parts = [self.weights[name] * member.predict(position).mean.double() for name, member in self._members.items()]
        return torch.stack(parts).sum(dim=0), None
