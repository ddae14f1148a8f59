"""Weights of several predictors, and the scale of their intervals, by held-out predictions.

Weights follow by stacking (L. Breiman, Machine Learning 24, 1996), intervals by cross-conformal prediction.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.gp import subsample

LEVEL = 0.8  # nominal coverage of the interval that the standard deviation is calibrated for
MAX_PAIRS = 20_000  # measurements that determine the mixing weights


def comparable(held_out: Tensor, measured: Tensor) -> Tensor:
    """Return which measurements exist and are predicted by all predictors, bool (rows, R).

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
    """
    return (~held_out.isnan()).all(dim=0) & ~measured.isnan()


def check_comparable(held_out: Tensor, measured: Tensor) -> None:
    """Raise InputError if held-out predictions (predictors, rows, R) cannot be compared with any measurement (rows, R)."""
    if not comparable(held_out, measured).any():
        raise InputError(
            "no rows can be held out to estimate the error of the model: all measurements are in one part of the "
            'region; measure elsewhere, too, give a pool of more receivers, or take validation="random"'
        )


def mixing_weights(held_out: Tensor, measured: Tensor, shrinkage: float = 0.05) -> Tensor:
    """Return the weights of the weighted mean of predictors with the lowest mean absolute error on held-out rows.

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
        shrinkage: Ridge penalty on the distance of the weights to those of the first predictor alone, relative to the mean
            squared error of a predictor. It steadies weights that few folds determine. The default is by nested
            cross-validation.

    Returns:
        Non-negative weights of sum 1, float64 (predictors,); those of the first predictor alone without a comparable row.

    Example:
        >>> held_out = torch.tensor([[[1.0], [2.0], [3.0]], [[9.0], [9.0], [9.0]]])
        >>> mixing_weights(held_out, held_out[0]).round(decimals=2)
        tensor([1., 0.], dtype=torch.float64)
    """
    usable = comparable(held_out, measured)
    if not bool(usable.any()):
        return torch.eye(len(held_out), dtype=torch.float64)[0]
    predicted, target = subsample(held_out[:, usable].T.double(), measured[usable].double(), rows=MAX_PAIRS)
    error = (predicted - target[:, None]).numpy()  # the error of a mean with weights of sum 1 is the mean of the errors
    n = error.shape[1]
    weight, importance = np.full(n, 1 / n), np.ones(len(error))
    scale = 1e-9 * max(float((error**2).mean()), 1.0)
    away = np.eye(n)
    away[0] -= 1.0  # weights less (1, 0, ...), for weights of sum 1
    for _ in range(20):  # least absolute errors by weighted least squares
        gram = (error * importance[:, None]).T @ error / max(len(error), 1)
        gram += shrinkage * np.trace(gram) / n * away.T @ away
        # the weights of least squares are proportional to argmin of w' G w / 2 - sum w over w >= 0
        factor = np.linalg.cholesky(gram + scale * np.eye(n))
        weight = nnls(factor.T, np.linalg.solve(factor, np.ones(n)))[0]
        weight /= weight.sum()
        # absolute errors below 0.5 dB count as squares, so that the solution is unique
        importance = 1 / np.maximum(np.abs(error @ weight), 0.5)
    return torch.from_numpy(weight)


def interval_scale(predicted: Tensor, std: Tensor, measured: Tensor) -> Tensor:
    """Return the factors (R,) of the standard deviations with which the 80 % intervals hold 80 % of the held-out rows.

    The interval is cross-conformal (V. Vovk, Annals of Mathematics and Artificial Intelligence 74, 2015): the error of each
    row is divided by the standard deviation that a model without the row's fold predicts.

    Args:
        predicted: Held-out predictions of the rows (n, R) [dBm], nan where there is none.
        std: Their standard deviations (n, R) [dB].
        measured: Measurements of the rows, (n, R) [dBm].
    """
    score = ((measured - predicted) / std).abs()
    finite = score.where(score.isfinite(), torch.nan)
    quantile = finite.nanquantile(LEVEL, dim=0)
    few = (~finite.isnan()).sum(dim=0) < 30  # scores of all receivers count
    if few.any():
        quantile = quantile.where(~few, score[score.isfinite()].quantile(LEVEL))
    return quantile / NormalDist().inv_cdf((1 + LEVEL) / 2)


def rounding_std(rssi: Tensor) -> float:
    """Return the standard deviation of the rounding error of RSSI [dBm], the least of a prediction [dB].

    The step of the values is their least difference, at most 1 dB, which is also that of constant values.
    """
    step: float = min([1.0, *rssi[~rssi.isnan()].unique().diff().tolist()])
    return step / math.sqrt(12)
