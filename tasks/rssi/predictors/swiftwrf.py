"""The model of this package."""

from __future__ import annotations

from torch import Tensor

from swiftwrf import Rssi, RssiConfig, RssiModel, fit_rssi
from swiftwrf.rasterize import prepare
from tasks.rssi.predictors.base import PREDICTORS, Settings


@PREDICTORS.register("swiftwrf")
class SwiftWRFPredictor:
    """The model of this package; all receivers at once."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        prepare(settings.device)

    def fit(self, train: Rssi) -> None:
        given = self._settings
        config = RssiConfig.paper if given.preset == "paper" else RssiConfig
        self.model: RssiModel = fit_rssi(
            train,
            config(validation=given.validation, seed=given.seed),
            pool=given.pool,
            device=given.device,
            parallel=given.parallel,
        )

    def predict(self, position: Tensor) -> Tensor:
        return self.model.predict(position)[0]
