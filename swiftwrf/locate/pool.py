"""Combination of several likelihoods into one calibrated posterior, with weights from held-out data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.locate.posterior import Posterior

BISECTIONS = 6  # of the tempering factor
MIN_LOG2_FACTOR, MAX_LOG2_FACTOR = -2.0, 1.0
RIDGE = 1e-3  # of the weights: keeps those that the data do not determine near their start
START = 0.3  # sum of the weights


def pooled_weights(at_truth: Tensor, at_candidates: Tensor, log_volume: Tensor) -> Tensor:
    """Return the weights of a log-linear pool that maximise the posterior density at held-out true positions.

        log p(x | y) = sum_k w_k l_k(x, y) - log sum_j V_j exp(sum_k w_k l_k(x_j, y)),    w_k >= 0

    The objective is concave in w (T. Heskes, "Selecting weighting factors in logarithmic opinion pools", 1998). One weight
    below 1 tempers a likelihood that is too certain.

    Args:
        at_truth: Log-likelihoods at the true positions, (k, n).
        at_candidates: Log-likelihoods at the candidates of each observation, (k, n, m).
        log_volume: Logarithms of the candidates' prior masses, (n, m).

    Returns:
        Weights, float64 (k,).
    """
    # relative to the best candidate: constants of each observation cancel
    top = at_candidates.amax(dim=2)
    truth = (at_truth - top).double()
    candidates, volume = (at_candidates - top[..., None]).double(), log_volume.double()

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


def tempered(weight: Tensor, posterior: Callable[[Tensor], Posterior], truth: Tensor, level: float = 0.8) -> Tensor:
    """Return the weights scaled so that credible regions of `level` contain that fraction of held-out positions.

    Maximum likelihood alone leaves regions too small if the likelihoods are wrong in ways that weights cannot mend.

    Args:
        weight: Weights of the pool, (k,).
        posterior: Returns the posterior of the held-out observations for weights (k,).
        truth: Held-out true positions, (n, 3) [m].
        level: Nominal coverage.
    """
    low, high = MIN_LOG2_FACTOR, MAX_LOG2_FACTOR
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        found = posterior(weight * 2**middle)
        inside = (found.median - truth).norm(dim=1) <= found.credible_radius(level)
        low, high = (middle, high) if float(inside.double().mean()) > level else (low, middle)
    return weight * 2 ** ((low + high) / 2)
