"""Several predictors in one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.data.splits import folds
from swiftwrf.models.base import FieldConfig
from swiftwrf.rssi import RssiFitContext, RssiPredictor
from swiftwrf.rssi.training import mixing_weights
from swiftwrf.runtime.validation import Preset, configuration
from tasks.rssi.predictors import PREDICTORS
from tasks.rssi.predictors.base import make_predictor


@configuration
class BlendConfig(FieldConfig):
    """Options of `Blend`."""

    members: tuple[str, ...] = ("swiftwrf", "gp", "knn", "mri_residual")
    """names of the predictors; those whose requirements the data do not meet are left out"""
    member_preset: Preset = "quick"
    """preset of the members"""

    @classmethod
    def paper(cls, **changes: Any) -> BlendConfig:
        """Return a blend of members with published settings."""
        return replace(cls(member_preset="paper"), **changes)


class Blend(RssiPredictor):
    """A weighted mean of other predictors, weights by cross-validation.

    The weights, the same at all receivers, have the lowest mean absolute error on held-out training rows (stacking).
    """

    name = "blend"
    config_type = BlendConfig
    slow = True

    weights: dict[str, float]
    """weight of each member, set by `fit`"""

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        names = [name for name in self.config.members if not PREDICTORS[name].lacking(train)]
        fold = folds(train.transmitter_position, self.config.validation, self.config.seed, session=train.session)
        held_out = torch.full((len(names), *train.rssi_dbm.shape), torch.nan, dtype=torch.float64)
        for number in fold.unique():
            out = fold == number
            position = train.transmitter_position[out]
            for i, name in enumerate(names):
                held_out[i, out] = self._member(name, train, context, ~out).predict(position).mean.double()
        self.weights = dict(zip(names, mixing_weights(held_out, train.rssi_dbm).tolist(), strict=True))
        every = torch.ones_like(fold, dtype=torch.bool)
        self._members = {name: self._member(name, train, context, every) for name in names if self.weights[name] > 0}

    def _member(self, name: str, train: Rssi, context: RssiFitContext, kept: Tensor) -> RssiPredictor:
        """Return a member, fitted to the kept rows (rows,)."""
        rows = kept.nonzero()[:, 0]
        member = make_predictor(
            name, self.config.member_preset, validation=self.config.validation, seed=self.config.seed
        )
        return member.fit(
            train.subset(rows), pool=context.pool.subset(rows), device=context.device, parallel=context.parallel
        )

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        parts = [self.weights[name] * member.predict(position).mean.double() for name, member in self._members.items()]
        return torch.stack(parts).sum(dim=0), None
