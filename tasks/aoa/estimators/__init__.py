"""Estimators of the direction of the transmitter from a spectrum, one or some like each other a file."""

from tasks.aoa.estimators.base import ESTIMATORS, Estimator, SavedEstimator, Settings, learners

ESTIMATORS.discover(__name__, __path__)

__all__ = ["ESTIMATORS", "Estimator", "SavedEstimator", "Settings", "learners"]
