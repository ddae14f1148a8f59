"""Estimators of the direction of the transmitter from a spectrum."""

from augment.estimators import aann, aann_kernel, baselines, kernel_regression, subspace  # noqa: F401 (each registers its own)
from augment.estimators.base import ESTIMATORS, Estimator, EstimatorConfig, make_estimator

__all__ = ["ESTIMATORS", "Estimator", "EstimatorConfig", "make_estimator"]
