"""Posteriors over the positions along a walk: each observation's posterior, smoothed by those before and after it."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.locate.posterior import Posterior, normalised

JUMP = 1e-3  # prior probability of a displacement that does not depend on the distance, for each step
CHUNK = 2**22  # pairs of candidates whose distances are computed together
MAX_KEPT_PAIRS = 4096**2  # pairs of shared candidates whose distances are kept from step to step
MAX_PAIRS = 20_000**2  # pairs of candidates of two consecutive observations


def smoothed(posterior: Posterior, time: Tensor | None, speed_m_s: float) -> Posterior:
    """Return the posterior of each observation given all observations of a walk.

    The motion prior is a random walk: the displacement between consecutive observations is Gaussian along each axis, with
    standard deviation `speed_m_s` times the time between them, and uniform with a probability of 0.001. The candidates'
    resolution adds to the variance. The forward-backward recursion is exact on the candidates (L. Rabiner, Proc. IEEE 77,
    1989). A single observation keeps its posterior.

    Args:
        posterior: Posteriors of n independent observations in the order of the walk, on m candidates each.
        time: Time of each observation, which does not decrease, (n,) [s]. None stands for one observation a second.
        speed_m_s: Typical speed, above 0 [m/s].

    Raises:
        InputError: A speed or times that are not as above, or more than 20,000 candidates.

    Example:
        >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]], dtype=torch.float64)
        >>> weight = torch.tensor([[0.98, 0.01, 0.01], [0.01, 0.49, 0.5]], dtype=torch.float64)
        >>> smoothed(Posterior(at, weight.log()), None, 1.0).most_likely[:, 0].tolist()
        [0.0, 1.0]
    """
    if not (math.isfinite(speed_m_s) and speed_m_s > 0):
        raise InputError(f"a speed is a number above 0 [m/s], got {speed_m_s}")
    n, m = posterior.log_weight.shape
    if m * m > MAX_PAIRS:
        raise InputError(f"a walk is smoothed on at most {math.isqrt(MAX_PAIRS)} candidate positions, got {m}")
    std = (speed_m_s * _intervals(time, n)).square().add(posterior.resolution_m**2 / 6).sqrt().clamp_min(1e-6).tolist()
    # the error of the distances is that of float32 relative to the region, not to the origin of the coordinates
    position = (posterior.position - posterior.position.reshape(-1, 3).mean(dim=0)).float().expand(n, -1, -1)
    own = posterior.log_weight
    # distances between candidates that all observations share are computed once
    shared = _square(position[0], position[0]) if len(posterior.position) == 1 and m * m <= MAX_KEPT_PAIRS else None

    def step(to: Tensor, start: Tensor, std: float, log_mass: Tensor) -> Tensor:
        """Return the log-density at candidates `to` (m, 3) after a step from masses (m,) at `start` (m, 3)."""
        mass = (log_mass - log_mass.max()).exp()
        moved, total = torch.empty(m), 0.0
        for rows in torch.arange(m).split(max(1, CHUNK // m)):
            square = _square(to[rows], start) if shared is None else shared[rows]
            density = (square * (-0.5 / std**2)).exp_()
            moved[rows] = density @ mass.float()
            total += float(density.sum(dtype=torch.float64))
        floor = JUMP * max(total / m**2, 1e-30) * mass.sum()
        return ((1 - JUMP) * moved.double() + floor).log()

    before, after = torch.zeros_like(own), torch.zeros_like(own)
    for i in range(1, n):
        before[i] = step(position[i], position[i - 1], std[i - 1], own[i - 1] + before[i - 1])
    for i in range(n - 2, -1, -1):
        after[i] = step(position[i], position[i + 1], std[i], own[i + 1] + after[i + 1])
    # the inflation belongs to posteriors of single observations
    return replace(posterior, log_weight=normalised(own + before + after), inflation=1.0)


def _intervals(time: Tensor | None, n: int) -> Tensor:
    """Return the times between consecutive observations (n - 1,) [s]."""
    if time is None:
        return torch.ones(max(n - 1, 0), dtype=torch.float64)
    time = torch.as_tensor(time, dtype=torch.float64)
    if time.shape != (n,) or not bool(time.isfinite().all()):
        raise InputError(f"expected {n} finite times [s], one for each observation, got shape {tuple(time.shape)}")
    interval = time.diff()
    back = (interval < 0).nonzero()[:, 0]
    if len(back):
        raise InputError(f"observations of a walk must be in the order of time; number {int(back[0]) + 2} is earlier")
    return interval


def _square(to: Tensor, start: Tensor) -> Tensor:
    """Return the squared distances between candidates (k, 3) and (m, 3), float32 (k, m) [m^2]."""
    return torch.cdist(to, start, compute_mode="donot_use_mm_for_euclid_dist").square_()
