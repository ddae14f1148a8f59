"""Predictors of RSSI at every receiver from the transmitter's position, one or some like each other a file."""

from tasks.rssi.predictors.base import PREDICTORS, SLOW, Predictor, Settings, lacks

PREDICTORS.discover(__name__, __path__, first=("swiftwrf", "laws", "regressors"))

__all__ = ["PREDICTORS", "SLOW", "Predictor", "Settings", "lacks"]
