"""How far the field is unknown at a position: not at all among measurements, wholly far from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from swiftwrf.gp import Kernel, thinned

LEVEL = 0.8  # of measurements that an interval should cover
ENOUGH = 200  # positions tell measured regions from others, at a fraction of the cost of all


class Known(NamedTuple):
    """Some measured positions, as far as they tell the field."""

    position: Tensor  # (m, 3) [m]
    root: Tensor  # (m, m): inverse Cholesky factor of the noisy covariance

    def unknown(self, position: Tensor, kernel: Kernel) -> Tensor:
        """Variance of the field at positions (n, 3) under its posterior, relative to that of its prior, (n,) in [0, 1]."""
        return (1 - (kernel(position, self.position) @ self.root.T).square().sum(dim=1)).clamp(0, 1)


def known(position: Tensor, kernel: Kernel) -> Known:
    """What measurements at positions (n, 3) tell."""
    (some,) = thinned(position, rows=ENOUGH)
    lower = torch.linalg.cholesky(kernel.noisy_gram(some))
    eye = torch.eye(len(some), dtype=lower.dtype, device=lower.device)
    return Known(some, torch.linalg.solve_triangular(lower, eye, upper=False))
