"""The neural radiance field of NeRF2 as it predicts RSSI."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from swiftwrf import Rssi, comparison
from swiftwrf.comparison import NeRF2RssiConfig
from tasks.rssi.predictors.base import PREDICTORS, Settings


@PREDICTORS.register("nerf2")
class NeRF2Predictor:
    """A neural field that all receivers share."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def fit(self, train: Rssi) -> None:
        given = self._settings
        config = NeRF2RssiConfig.paper() if given.preset == "paper" else NeRF2RssiConfig()
        self._model = comparison.fit_rssi(train, replace(config, seed=given.seed), device=given.device)

    def predict(self, position: Tensor) -> Tensor:
        return self._model.predict(position)
