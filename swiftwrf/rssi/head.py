"""The head: a receiver's primitives, whose responses move with the transmitter, averaged over all directions.

    pooled(c) = 100 mean over directions |A + c B|        [dB]

A is the field of the canonical primitives on a 16 x 16 grid, B that of the same primitives with other responses, scaled so
that a small c is a change in dB. 100 dB a unit is the scale of the NeRF2 data (rssi = 100 (a - 1)). Where the primitives
stay, A and B are drawn once, and all that is left of them is one convex function of one number.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.models.swiftwrf.primitives import Primitives
from swiftwrf.rasterize import rasterize
from swiftwrf.rasterize.magnitude import magnitude

GRID = AngularGrid.hemisphere(16, 16)
SCALE = 100.0  # dB a unit of magnitude
REACH, STEP = 64.0, 0.125  # [dB] of the table: a motion beyond is 10 deviations of any field that was measured


class Head(nn.Module):
    """The primitives of R receivers.

    Args:
        n_receivers: R.
        n_primitives: of each; 0 draws nothing.
        seed: of where they lie and how they respond.
    """

    def __init__(self, n_receivers: int, n_primitives: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.primitives = Primitives(n_primitives, GRID, generator=generator, scenes=(n_receivers,))
        # the moving responses resemble the canonical ones: independent ones overfit where only sums are measured
        self.basis = nn.Parameter(1 + 0.3 * torch.randn(n_receivers, n_primitives, generator=generator))

    def draw(self) -> Tensor:
        """A and B of each receiver, (R, 2, 2, directions): which, real and imaginary part."""
        mean, cholesky, attenuation, response = self.primitives()
        if not len(self.primitives):
            return torch.zeros(len(mean), 2, 2, GRID.shape[0] * GRID.shape[1])
        canonical = attenuation[..., None] * response
        weight = torch.stack([canonical, self.basis[..., None] * canonical], dim=1)  # (R, 2, N, 2)
        means, choleskys = (x[:, None].expand(-1, 2, -1, -1) for x in (mean, cholesky))
        still, moving = rasterize(means, choleskys, weight, GRID).flatten(-2).unbind(1)
        phase = still / magnitude(still[..., None]).squeeze(-1).unsqueeze(-2).clamp_min(1e-6)
        gain = SCALE * (phase * moving).sum(dim=-2).mean(dim=-1)
        drawn: Tensor = torch.stack([still, moving / gain.clamp_min(1e-3)[:, None, None]], dim=1)
        return drawn


def pooled(drawn: Tensor, motion: Tensor) -> Tensor:
    """The averaged magnitude (n, R) [dB] of drawn fields (R, 2, 2, directions) at motions (n, R) [dB]."""
    moved = drawn[:, 0] + motion[..., None, None] * drawn[:, 1]
    mean: Tensor = magnitude(moved[..., None]).mean(dim=(-2, -1))
    return SCALE * mean


class Table:
    """`pooled` of some receivers at all motions, by straight lines between points an eighth of a dB apart, which is off by
    less than 2e-3 dB.

    Args:
        drawn: fields (R, 2, 2, directions).
    """

    def __init__(self, drawn: Tensor) -> None:
        node = torch.arange(-REACH, REACH + STEP, STEP, device=drawn.device)
        self.value = pooled(drawn, node[:, None].expand(-1, len(drawn))).double()  # (nodes, R)

    def __call__(self, motion: Tensor) -> tuple[Tensor, Tensor]:
        """The averaged magnitude and its slope at motions (n, R) [dB], each of their type."""
        place = (motion + REACH) / STEP
        node = place.floor().long().clamp(0, len(self.value) - 2)
        low, high = (self.value.gather(0, n).to(motion) for n in (node, node + 1))
        return low + (place - node) * (high - low), (high - low) / STEP
