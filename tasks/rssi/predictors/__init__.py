"""Predictors of RSSI at every receiver from the position of the transmitter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from swiftwrf.runtime.registry import Registry

if TYPE_CHECKING:
    from swiftwrf.rssi import RssiPredictor

PREDICTORS: Registry[RssiPredictor] = Registry(
    "predictor",
    "swiftwrf.rssi_predictors",
    {
        "swiftwrf": "swiftwrf.rssi:RssiModel",
        "mean": "tasks.rssi.predictors.path_loss:Mean",
        "mri_pooled": "tasks.rssi.predictors.path_loss:SharedPathLoss",
        "mri_receiver": "tasks.rssi.predictors.path_loss:ReceiverPathLoss",
        "knn": "tasks.rssi.predictors.regressors:KNNPredictor",
        "mri_residual": "tasks.rssi.predictors.regressors:ResidualKNNPredictor",
        "gp": "tasks.rssi.predictors.regressors:GPPredictor",
        "pairs": "swiftwrf.rssi:PairModel",
        "knn_pairs": "tasks.rssi.predictors.pairs:PairKNN",
        "blend": "tasks.rssi.predictors.blend:Blend",
        "nerf2": "swiftwrf.comparison:NeRF2Rssi",
    },
)

__all__ = ["PREDICTORS"]
