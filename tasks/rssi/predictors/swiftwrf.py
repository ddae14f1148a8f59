"""The model of this package."""

from __future__ import annotations

from torch import Tensor

from swiftwrf import Rssi, RssiConfig, RssiModel, fit_rssi
from swiftwrf.rasterize import prepare
from tasks.rssi.predictors.base import PREDICTORS, Settings


@PREDICTORS.register(
    "swiftwrf",
    meaning="50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance law; "
    "mixed with the laws and the mean as held-out rows say",
    colour="#4477aa",
)
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
