"""Random scenes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.models.primitives import MIN_WIDTH_PIXELS

GRID = AngularGrid.hemisphere(30, 120)


def random_scene(
    n: int = 40,
    batch: int = 3,
    seed: int = 0,
    per_position: bool = False,
    dtype: torch.dtype = torch.float32,
    grid: AngularGrid = GRID,
) -> list[Tensor]:
    """Return mean, Cholesky factor and weight of random sheared primitives, which require gradients.

    Widths are from the smallest one to a radian. Some means lie beyond both edges or whole turns away.
    """
    generator = torch.Generator().manual_seed(seed)
    mean = torch.rand(batch, n, 2, generator=generator) * torch.tensor([6 * math.pi, 2.2]) - torch.tensor(
        [2 * math.pi, 0.3]
    )
    shape = (batch, n, 3) if per_position else (n, 3)
    floor = MIN_WIDTH_PIXELS * torch.tensor([grid.azimuth_step, 0.0, grid.elevation_step])
    cholesky = torch.exp(torch.rand(shape, generator=generator) * 4 - 4) + floor
    cholesky[..., 1] *= torch.randn(shape[:-1], generator=generator)
    weight = torch.randn(batch, n, 2, generator=generator)
    return [x.to(dtype).requires_grad_() for x in (mean, cholesky, weight)]
