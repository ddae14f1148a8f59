"""The head of a receiver: primitives whose responses depend on a latent field, averaged over all directions.

    m(c) = 100 mean over directions |A + c B|        [dB]

A is the field of the canonical primitives on a 16 x 16 grid, B that of the same primitives with other responses, scaled so
that a small c is a change in dB. 100 dB a unit is the scale of the NeRF2 data (rssi = 100 (a - 1)). If the primitives are
fixed, A and B are rendered once, and m is one convex function of one number.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Self

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.models.primitives import Primitives
from swiftwrf.rasterize import reference
from swiftwrf.rasterize.operators import magnitude

HEAD_GRID = AngularGrid.hemisphere(16, 16)
N_DIRECTIONS = HEAD_GRID.shape[0] * HEAD_GRID.shape[1]
DB_PER_UNIT = 100.0  # of magnitude
TABLE_RANGE_DB, TABLE_STEP_DB = 64.0, 0.125  # 64 dB are 10 standard deviations of any measured field


class Head(nn.Module):
    """The primitives of one receiver, which are alike at all receivers until they are trained.

    Args:
        n_primitives: Number of primitives. With 0 the head is 0 everywhere.
        seed: Seed of the primitives' means and responses.
    """

    def __init__(self, n_primitives: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.primitives = Primitives(n_primitives, HEAD_GRID, generator=generator)
        # independent responses overfit, since only their sum is measured
        self.basis = nn.Parameter(1 + 0.3 * torch.randn(n_primitives, generator=generator))


def render(heads: Iterable[Head]) -> Tensor:
    """Return A and B of R heads with equally many primitives, (R, 2, 2, directions): field, real and imaginary part."""
    heads = list(heads)
    if not len(heads[0].primitives):
        return torch.zeros(len(heads), 2, 2, N_DIRECTIONS)
    mean, cholesky, attenuation, response = map(torch.stack, zip(*(head.primitives() for head in heads), strict=True))
    canonical = attenuation[..., None] * response
    basis = torch.stack([head.basis for head in heads])
    weight = torch.stack([canonical, basis[..., None] * canonical], dim=1)  # (R, 2, N, 2)
    means, choleskys = (x[:, None].expand(-1, 2, -1, -1) for x in (mean, cholesky))
    # 50 kernels take less time than loading a compiled backend
    fixed, varying = reference.field(means, choleskys, weight, HEAD_GRID, cutoff=1e-4).flatten(-2).unbind(1)
    phase = fixed / magnitude(fixed[..., None]).squeeze(-1).unsqueeze(-2).clamp_min(1e-6)
    gain = DB_PER_UNIT * (phase * varying).sum(dim=-2).mean(dim=-1)
    return torch.stack([fixed, varying / gain.clamp_min(1e-3)[:, None, None]], dim=1)


def mean_magnitude(rendered: Tensor, latent: Tensor) -> Tensor:
    """Return m(c) (n, R) [dB] of rendered fields (R, 2, 2, directions) at a latent field c (n, R) [dB]."""
    changed = rendered[:, 0] + latent[..., None, None] * rendered[:, 1]
    mean: Tensor = magnitude(changed[..., None]).mean(dim=(-2, -1))
    return DB_PER_UNIT * mean


@dataclass(frozen=True, eq=False)
class Heads:
    """The functions m(c) - m(0) of R receivers and their derivatives, piecewise linear with an error below 2e-3 dB.

    Args:
        rendered: Fields A and B, float32 (R, 2, 2, directions), or (1, 2, 2, directions) for equal heads of all receivers.

    Example:
        >>> value, derivative = Heads.alike(n_primitives=50, seed=0)(torch.tensor([[0.0], [3.0]]))
        >>> value.round(), derivative.round()
        (tensor([[0.],
                [3.]]), tensor([[1.],
                [1.]]))
    """

    rendered: Annotated[Tensor, f"float32 h 2 2 {N_DIRECTIONS}"]

    @classmethod
    def alike(cls, n_primitives: int, seed: int) -> Self:
        """Return one head for all receivers, whose primitives are not trained."""
        return cls(render([Head(n_primitives, seed).requires_grad_(False)]))

    @cached_property
    def _table(self) -> Tensor:
        """Values of m(c) - m(0) every 0.125 dB, float64 (nodes, R)."""
        node = torch.arange(-TABLE_RANGE_DB, TABLE_RANGE_DB + TABLE_STEP_DB, TABLE_STEP_DB)
        value = mean_magnitude(self.rendered, node[:, None].expand(-1, len(self.rendered))).double()
        return value - value[len(node) // 2]

    def __call__(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return m(c) - m(0) and its derivative, each (n, R), at a latent field c (n, R) [dB]."""
        place = (latent + TABLE_RANGE_DB) / TABLE_STEP_DB
        node = place.detach().floor().long().clamp(0, len(self._table) - 2)
        table = self._table.to(latent.device).expand(-1, latent.shape[1])
        low, high = (table.gather(0, number).to(latent) for number in (node, node + 1))
        return low + (place - node) * (high - low), (high - low) / TABLE_STEP_DB
