"""What held-out rows say: the kernel of the field, and how far to trust the field beside simpler predictors."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from swiftwrf.gp import Kernel, candidates, held_out_errors, thinned

NOISES = (0.3, 1.0, 2.0, 3.0)  # variance of a packet relative to that of the field: fading is as large as shadowing
MAX_ROWS, MAX_RECEIVERS = 300, 12  # more do not change the choice
MAX_PAIRS = 20_000
SMALLEST_ERROR = 0.5  # [dB] below which absolute errors count as squares, so that the solution is one


def choose_kernel(position: Tensor, residual: Tensor, fold: Tensor) -> tuple[Kernel, bool]:
    """The kernel that best predicts what the law leaves where it is held out, by mean absolute error [dB], and whether that
    is better than leaving it.

    Args:
        position: of the sites [m], (n, 3).
        residual: what the law leaves (n, R) [dB], nan where not heard.
        fold: number of the part that each site is held out with, (n,).
    """
    some = (~residual.isnan()).any(dim=1)
    position, residual, fold = thinned(position[some], residual[some], fold[some], rows=MAX_ROWS)
    residual = residual[:, (~residual.isnan()).any(dim=0)]
    (columns,) = thinned(torch.arange(residual.shape[1]), rows=MAX_RECEIVERS)
    left = [_Left(values, fold) for values in residual[:, columns].T]

    def missed(kernel: Kernel) -> float:
        precision = torch.linalg.inv(kernel.noisy_gram(position))
        return float(torch.cat([error for values in left for error in values.errors(precision)]).abs().mean())

    # rough fields alone: a choice among mixtures with a smooth part follows chance, and its errors are no smaller
    rough = (kernel for kernel in candidates(position, NOISES) if kernel.share == 1)
    score, best = min(((missed(kernel), kernel) for kernel in rough), key=lambda pair: pair[0])
    return best, score < float(residual[:, columns].abs().nanmean())


class _Left:
    """Values (n,) of one receiver with gaps, and what a Gaussian process misses of each held-out fold of them."""

    def __init__(self, values: Tensor, fold: Tensor) -> None:
        self.filled = values.nan_to_num()
        unheard = values.isnan()
        parts = [((fold == number) & ~unheard).nonzero()[:, 0] for number in fold.unique()]
        gaps = unheard.nonzero()[:, 0]
        # held out together with the gaps, whose values then do not matter
        self.parts = [(len(part), torch.cat([part, gaps])) for part in parts if len(part)]

    def errors(self, precision: Tensor) -> list[Tensor]:
        """By fold [dB], with the precision (n, n) of all sites."""
        dual = precision @ self.filled
        return [held_out_errors(precision, dual, out)[:n] for n, out in self.parts]


def comparable(held_out: Tensor, measured: Tensor) -> Tensor:
    """Which measurements (rows, R) there are and all predictors (predictors, rows, R) say something of where they were held
    out, bool (rows, R); what is missing is nan."""
    return (~held_out.isnan()).all(dim=0) & ~measured.isnan()


def mixing_weights(held_out: Tensor, measured: Tensor) -> Tensor:
    """Weights, none negative and 1 in sum, of the mean of predictors that has the least absolute error where they were held
    out ("stacking": L. Breiman, Machine Learning 24, 1996).

    Args:
        held_out: predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: (rows, R) [dBm], nan where not heard.

    Returns:
        float64 (predictors,).
    """
    usable = comparable(held_out, measured)
    predicted, target = thinned(held_out[:, usable].T.double(), measured[usable].double(), rows=MAX_PAIRS)
    error = (predicted - target[:, None]).numpy()  # of a mean with weights that sum to 1: the mean of the errors
    n = error.shape[1]
    weight, importance = np.full(n, 1 / n), np.ones(len(error))
    scale = 1e-9 * max(float((error**2).mean()), 1.0)
    for _ in range(20):  # least absolute deviations by weighted least squares
        gram = (error * importance[:, None]).T @ error / max(len(error), 1)
        # the mixture of least square: proportional to argmin of w' G w / 2 - sum w over w >= 0
        factor = np.linalg.cholesky(gram + scale * np.eye(n))
        weight = nnls(factor.T, np.linalg.solve(factor, np.ones(n)))[0]
        weight /= weight.sum()
        importance = 1 / np.maximum(np.abs(error @ weight), SMALLEST_ERROR)
    return torch.from_numpy(weight)
