"""The 2D Gaussians of a scene and the constraints of their parameters (paper, section 4.1)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid

MAX_WIDTH_RAD = 4 * math.pi  # flat over the whole grid within 5 %; wider primitives would overflow
MIN_WIDTH_PIXELS = 0.3  # narrower primitives fall between pixel centres and get no gradient


class Gaussians(NamedTuple):
    """Parameters of N primitives."""

    mean: Tensor  # (N, 2) azimuth, elevation [rad]
    cholesky: Tensor  # (N, 3) l1, l2, l3 [rad]
    attenuation: Tensor  # (N,) delta, in (0, 1)
    response: Tensor  # (N, 2) psi, real and imaginary part


class Primitives(nn.Module):
    """Learnable canonical primitives.

    Args:
        n: Number of primitives.
        grid: Grid of the spectra to fit; its pixels give the minimum and the initial widths.
        bounded: Keep means inside the grid by the paper's tanh map, az = pi (tanh + 1), el = pi/4 (tanh + 1).
        generator: Source of the initial means (uniform over the grid, as in the paper) and responses.
    """

    floor: Tensor

    def __init__(self, n: int, grid: AngularGrid, *, generator: torch.Generator, bounded: bool = False) -> None:
        super().__init__()
        self.bounded = bounded
        unit = torch.rand(n, 2, generator=generator).clamp(1e-3, 1 - 1e-3)
        extent = torch.tensor([2 * math.pi, math.pi / 2])
        self.register_buffer("floor", min_width(grid))
        width = extent / math.sqrt(n) / 2  # n evenly spread primitives overlap at about 60 % of their peaks
        self.mean = nn.Parameter(torch.atanh(2 * unit - 1) if bounded else unit * extent)
        self.cholesky = nn.Parameter(torch.stack([width[0].log(), torch.zeros(()), width[1].log()]).repeat(n, 1))
        self.attenuation = nn.Parameter(torch.zeros(n))
        self.response = nn.Parameter(0.2 * torch.randn(n, 2, generator=generator))

    def __len__(self) -> int:
        return len(self.mean)

    def forward(self) -> Gaussians:
        mean: Tensor = self.mean
        if self.bounded:
            mean = (torch.tanh(mean) + 1) * mean.new_tensor([math.pi, math.pi / 4])
        return Gaussians(mean, constrained(self.cholesky, self.floor), torch.sigmoid(self.attenuation), self.response)


def constrained(raw: Tensor, floor: Tensor) -> Tensor:
    """Return Cholesky factors l1, l2, l3 [rad] of raw values (..., 3): log l1, l2 / l3 and log l3.

    Args:
        raw: Raw values.
        floor: Minimum of l1 and l3 [rad], (2,); see `min_width`.
    """
    diagonal = torch.exp(raw[..., ::2].clamp(max=math.log(MAX_WIDTH_RAD))) + floor
    return torch.stack([diagonal[..., 0], raw[..., 1] * diagonal[..., 1], diagonal[..., 1]], dim=-1)


def min_width(grid: AngularGrid) -> Tensor:
    """Return the minimum widths of primitives on a grid in azimuth and elevation, (2,) [rad]."""
    return MIN_WIDTH_PIXELS * torch.tensor([grid.azimuth_step, grid.elevation_step], dtype=torch.float32)
