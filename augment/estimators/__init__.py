"""Estimators of the direction of the transmitter from a spectrum."""

from augment.estimators.base import ESTIMATORS, Estimator, EstimatorConfig, make_estimator

ESTIMATORS.discover(__name__)

__all__ = ["ESTIMATORS", "Estimator", "EstimatorConfig", "make_estimator"]
