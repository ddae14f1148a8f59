"""Stacking: weights of several predictors from their held-out predictions (L. Breiman, Machine Learning 24, 1996)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from swiftwrf.gp import subsample

MAX_PAIRS = 20_000
MIN_ERROR_DB = 0.5  # absolute errors below it count as squares, so that the solution is unique
N_REWEIGHTINGS = 20


def comparable(held_out: Tensor, measured: Tensor) -> Tensor:
    """Return which measurements exist and are predicted by all predictors, bool (rows, R).

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
    """
    return (~held_out.isnan()).all(dim=0) & ~measured.isnan()


def mixing_weights(held_out: Tensor, measured: Tensor, shrinkage: float = 0.0) -> Tensor:
    """Return the weights of the weighted mean of predictors with the lowest mean absolute error on held-out rows.

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
        shrinkage: Ridge penalty on the distance of the weights to those of the first predictor alone, relative to the mean
            squared error of a predictor. It steadies weights that few folds determine.

    Returns:
        Non-negative weights of sum 1, float64 (predictors,).

    Example:
        >>> held_out = torch.tensor([[[1.0], [2.0], [3.0]], [[9.0], [9.0], [9.0]]])
        >>> mixing_weights(held_out, held_out[0]).round(decimals=2)
        tensor([1., 0.], dtype=torch.float64)
    """
    usable = comparable(held_out, measured)
    predicted, target = subsample(held_out[:, usable].T.double(), measured[usable].double(), rows=MAX_PAIRS)
    error = (predicted - target[:, None]).numpy()  # the error of a mean with weights of sum 1 is the mean of the errors
    n = error.shape[1]
    weight, importance = np.full(n, 1 / n), np.ones(len(error))
    scale = 1e-9 * max(float((error**2).mean()), 1.0)
    away = np.eye(n)
    away[0] -= 1.0  # weights less (1, 0, ...), for weights of sum 1
    for _ in range(N_REWEIGHTINGS):  # least absolute errors by weighted least squares
        gram = (error * importance[:, None]).T @ error / max(len(error), 1)
        gram += shrinkage * np.trace(gram) / n * away.T @ away
        # the weights of least squares are proportional to argmin of w' G w / 2 - sum w over w >= 0
        factor = np.linalg.cholesky(gram + scale * np.eye(n))
        weight = nnls(factor.T, np.linalg.solve(factor, np.ones(n)))[0]
        weight /= weight.sum()
        importance = 1 / np.maximum(np.abs(error @ weight), MIN_ERROR_DB)
    return torch.from_numpy(weight)
