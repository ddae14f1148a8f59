"""The 2D Gaussians of a scene and how their constraints are kept (paper, section 4.1)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid

WIDEST = 4 * math.pi  # [rad]: flat over the whole grid within 5 %; wider ones would only overflow
FLOOR = 0.3  # of a pixel: narrower primitives fall between pixel centres, draw nothing and get no gradient


class Gaussians(NamedTuple):
    """Primitives at some positions; leading dimensions are positions, and none where all positions share a value."""

    mean: Tensor  # (..., N, 2) azimuth, elevation [rad]
    cholesky: Tensor  # (..., N, 3) l1, l2, l3 [rad]
    attenuation: Tensor  # (..., N) delta, in (0, 1) before deformation
    response: Tensor  # (..., N, 2) psi, real and imaginary part

    @property
    def weight(self) -> Tensor:
        """delta psi, (..., N, 2)."""
        return self.attenuation[..., None] * self.response


class Primitives(nn.Module):
    """Learnable canonical primitives.

    Args:
        n: their number, 0 or more.
        grid: the grid that the model is fitted on; its pixels give the width's floor and the initial widths.
        bounded: keep means inside the grid by the paper's tanh map, az = pi (tanh + 1), el = pi/4 (tanh + 1).
            Otherwise means are free: azimuth is periodic anyway, and a mean below the plane or beyond the pole draws
            its flank, which the tanh map cannot.
        axis_aligned: keep l2 at 0.
        generator: for the initial means (uniform over the grid, as in the paper) and responses.
        scenes: leading dimensions of independent sets of n primitives, e.g. (receivers,).
    """

    def __init__(
        self,
        n: int,
        grid: AngularGrid,
        *,
        generator: torch.Generator,
        bounded: bool = False,
        axis_aligned: bool = False,
        scenes: tuple[int, ...] = (),
    ) -> None:
        super().__init__()
        self.bounded, self.shear = bounded, 0.0 if axis_aligned else 1.0
        unit = torch.rand(*scenes, n, 2, generator=generator).clamp(1e-3, 1 - 1e-3)
        extent = torch.tensor([2 * math.pi, math.pi / 2])
        pixel = torch.tensor([grid.azimuth_step, grid.elevation_step], dtype=torch.float32)
        self.register_buffer("floor", FLOOR * pixel)
        # one standard deviation so that N of them, evenly spread, overlap at about 60 % of their peaks
        width = extent / math.sqrt(max(n, 1)) * torch.tensor([0.5, 0.5])
        self.mean = nn.Parameter(torch.atanh(2 * unit - 1) if bounded else unit * extent)
        self.cholesky = nn.Parameter(
            torch.stack([width[0].log(), torch.zeros(()), width[1].log()]).repeat(*scenes, n, 1)
        )
        self.attenuation = nn.Parameter(torch.zeros(*scenes, n))
        self.response = nn.Parameter(0.2 * torch.randn(*scenes, n, 2, generator=generator))

    floor: Tensor

    def __len__(self) -> int:
        return self.mean.shape[-2]

    def constrained(self, cholesky: Tensor) -> Tensor:
        """l1, l2, l3 [rad] of raw numbers (..., 3): positive diagonal between the floor and two turns; l2 is free, in units
        of l3."""
        diagonal = torch.exp(cholesky[..., ::2].clamp(max=math.log(WIDEST))) + self.floor
        return torch.stack(
            [diagonal[..., 0], self.shear * cholesky[..., 1] * diagonal[..., 1], diagonal[..., 1]], dim=-1
        )

    def forward(self) -> Gaussians:
        mean: Tensor = self.mean
        if self.bounded:
            mean = (torch.tanh(mean) + 1) * mean.new_tensor([math.pi, math.pi / 4])
        return Gaussians(mean, self.constrained(self.cholesky), torch.sigmoid(self.attenuation), self.response)
