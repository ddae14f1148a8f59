"""Combination of several likelihoods into one calibrated posterior, with weights from held-out data."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.locate.posterior import Posterior

RIDGE = 1e-3  # of the weights: keeps those that the data do not determine near their start
START = 0.3  # sum of the weights


def pooled_weights(at_truth: Tensor, at_candidates: Tensor, log_volume: Tensor) -> Tensor:
    """Return the weights of a log-linear pool that maximise the posterior density at held-out true positions.

        log p(x | y) = sum_k w_k l_k(x, y) - log sum_j V_j exp(sum_k w_k l_k(x_j, y)),    w_k >= 0

    The objective is concave in w (T. Heskes, "Selecting weighting factors in logarithmic opinion pools", 1998). One weight
    below 1 tempers a likelihood that is too certain. The true position is one more candidate, with the smallest mass:
    where a search misses it, the density would otherwise rise with the weights without limit.

    Args:
        at_truth: Log-likelihoods at the true positions, (k, n).
        at_candidates: Log-likelihoods at the candidates of each observation, (k, n, m).
        log_volume: Logarithms of the candidates' prior masses, (n, m).

    Returns:
        Weights, float64 (k,).
    """
    smallest = log_volume.masked_fill(log_volume.isinf(), torch.inf).amin(dim=1, keepdim=True)
    volume = torch.cat([log_volume, smallest], dim=1).double()
    values = torch.cat([at_candidates, at_truth[..., None]], dim=2)
    # relative to the best candidate: constants of each observation cancel
    top = values.amax(dim=2)
    truth, candidates = (at_truth - top).double(), (values - top[..., None]).double()

    def loss(values: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        weight = torch.from_numpy(values)
        log_mass = torch.einsum("k,knm->nm", weight, candidates) + volume
        total = log_mass.logsumexp(dim=1, keepdim=True)
        expected = torch.einsum("nm,knm->kn", (log_mass - total).exp(), candidates)
        density = torch.einsum("k,kn->n", weight, truth) - total[:, 0]
        gradient = (truth - expected).mean(dim=1) - 2 * RIDGE * weight
        return float(RIDGE * weight.square().sum() - density.mean()), -gradient.numpy()

    first = np.full(len(at_truth), START / len(at_truth))
    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=[(0, None)] * len(first))
    return torch.from_numpy(found.x)


def inflation(posterior: Posterior, truth: Tensor, level: float = 0.8) -> float:
    """Return the factor of credible radii for which regions of `level` contain that fraction of held-out positions.

    The weights of largest posterior density leave regions too small if the likelihoods are wrong in ways that no weight
    corrects (split conformal calibration: V. Vovk, A. Gammerman and G. Shafer, "Algorithmic Learning in a Random World",
    2005).

    Args:
        posterior: Posterior of held-out observations.
        truth: Their true positions, (n, 3) [m].
        level: Nominal coverage.
    """
    ratio = (posterior.median - truth).norm(dim=1) / posterior.credible_radius(level).clamp_min(1e-9)
    return float(ratio.quantile(level))
