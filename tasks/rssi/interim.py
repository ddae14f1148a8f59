"""The predictors as a registry, over today's `tasks.rssi.predictors`: goes when that module has one."""

from __future__ import annotations

from functools import partial

from swiftwrf.registry import Registry
from tasks.rssi import predictors
from tasks.rssi.predictors import Predictor

_MEANING = {
    "swiftwrf": ("50 primitives a receiver on a 16 x 16 grid, averaged, on a log-distance law", "#4477aa"),
    "mean": ("the mean of the receiver's training values", "#bbbbbb"),
    "mri_pooled": ("one log-distance law for all receivers", "#ee6677"),
    "mri_receiver": ("a log-distance law for each receiver", "#ee8866"),
    "mri_residual": ("the same, and what it leaves interpolated from the nearest measurements", "#ccbb44"),
    "knn": ("inverse-distance mean of the nearest measurements", "#66ccee"),
    "gp": ("a Gaussian process on what the log-distance law leaves", "#228833"),
}
PREDICTORS: Registry[Predictor] = Registry("predictor")
for _name, (_meaning, _colour) in _MEANING.items():
    PREDICTORS.register(_name, meaning=_meaning, colour=_colour)(partial(predictors.make_predictor, _name))
