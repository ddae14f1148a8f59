"""Predictors of RSSI at every receiver from the position of the transmitter."""

from swiftwrf.comparison import NeRF2Rssi
from swiftwrf.rssi import RssiModel
from tasks.rssi.predictors.base import PREDICTORS, make_predictor

PREDICTORS.register("swiftwrf")(RssiModel)
PREDICTORS.discover(__name__, __path__, first=("path_loss", "regressors"))
PREDICTORS.register("nerf2")(NeRF2Rssi)

__all__ = ["PREDICTORS", "make_predictor"]
