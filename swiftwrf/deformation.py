"""Position to offsets: how the primitives move, answer and fade as one end of the link moves (paper, section 4.2).

Positions here are normalised: the training positions' bounding box, scaled alike on all axes, is centred in [-1, 1]^3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

MEAN_BANDS, POSITION_BANDS = 10, 6  # frequency bands of the paper's encodings
WIDTH, DEPTH = 156, 8  # of the paper's network
COMPONENTS = {"mean": 2, "response": 2, "attenuation": 1, "cholesky": 3}  # what can deform, and its numbers a primitive


class Offsets(NamedTuple):
    """What is added to each primitive at each position; None where a component does not deform."""

    mean: Tensor | None = None  # (B, N, 2) [rad]
    response: Tensor | None = None  # (B, N, 2)
    attenuation: Tensor | None = None  # (B, N)
    cholesky: Tensor | None = None  # (B, N, 3) on the raw factor


def _offsets(flat: Tensor, components: tuple[str, ...]) -> Offsets:
    """Splits (B, N, sum of sizes) into the named components."""
    parts = dict(zip(components, flat.split([COMPONENTS[c] for c in components], dim=-1), strict=True))
    if "attenuation" in parts:
        parts["attenuation"] = parts["attenuation"].squeeze(-1)
    return Offsets(**parts)


def encode(x: Tensor, bands: int) -> Tensor:
    """[x, sin(2^k pi x), cos(2^k pi x)], k = 0 .. bands - 1 (paper): (..., d) to (..., d (2 bands + 1))."""
    angle = x[..., None, :] * (math.pi * 2.0 ** torch.arange(bands, dtype=x.dtype, device=x.device))[:, None]
    return torch.cat([x, torch.sin(angle).flatten(-2), torch.cos(angle).flatten(-2)], dim=-1)


class PerPrimitiveMLP(nn.Module):
    """The paper's network: one evaluation a primitive and position, from the encodings of the mean and the position.

    Eight layers of width 156 with the input fed in again every two layers, and one linear output whose initial zeros
    make the first deformed spectrum the canonical one. 0.3 million multiplications a primitive and position: at 10,000
    primitives it, not the rasterizer, bounds the spectra per second.
    """

    def __init__(self, components: tuple[str, ...], *, generator: torch.Generator) -> None:
        super().__init__()
        self.components = components
        inputs = 2 * (2 * MEAN_BANDS + 1) + 3 * (2 * POSITION_BANDS + 1)
        self.layers = nn.ModuleList(
            nn.Linear(inputs if i == 0 else WIDTH + (inputs if i % 2 == 0 else 0), WIDTH) for i in range(DEPTH)
        )
        self.output = nn.Linear(WIDTH, sum(COMPONENTS[c] for c in components))
        for layer in self.layers:
            bound = 1 / math.sqrt(cast(nn.Linear, layer).in_features)  # torch's default, drawn from our own generator
            for parameter in layer.parameters():
                nn.init.uniform_(parameter, -bound, bound, generator=generator)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Offsets at positions (B, 3) of primitives with canonical means (N, 2) [rad]."""
        unit = mean / mean.new_tensor([math.pi, math.pi / 4]) - 1  # the range the encoding was made for
        n_position, n = position.shape[0], mean.shape[0]
        x = torch.cat(
            [
                encode(unit, MEAN_BANDS).expand(n_position, n, -1),
                encode(position, POSITION_BANDS)[:, None].expand(n_position, n, -1),
            ],
            dim=-1,
        )
        h = x
        for i, layer in enumerate(self.layers):
            h = torch.relu(layer(torch.cat([h, x], dim=-1) if i and i % 2 == 0 else h))
        return _offsets(self.output(h), self.components)


@dataclass(frozen=True)
class Kernel:
    """How alike the motion is at two positions, by their distance r: a rough long-range and a smooth short-range part.

        k(r) = share exp(-r / long) + (1 - share) (1 + sqrt(3) r / short) exp(-sqrt(3) r / short)

    The long part (Matern 1/2) carries the rough field between rooms' positions, the short one (Matern 3/2) follows a path
    sampled densely.

    Args:
        long, short: correlation lengths, in the unit of the positions.
        share: of the long part, in [0, 1].
        noise: variance of what is not a function of position, relative to k(0) = 1.
    """

    long: float = 0.5
    short: float = 0.1
    share: float = 0.6
    noise: float = 1e-2

    def scaled(self, factor: float) -> Kernel:
        """The same kernel on positions multiplied by `factor`."""
        return replace(self, long=self.long * factor, short=self.short * factor)

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """k between positions (n, 3) and (m, 3), (n, m)."""
        r = torch.cdist(
            a, b, compute_mode="donot_use_mm_for_euclid_dist"
        )  # the fast mode loses close pairs to rounding
        if self.share == 1:
            return torch.exp(-r / self.long)
        near = math.sqrt(3) * r / self.short
        return self.share * torch.exp(-r / self.long) + (1 - self.share) * (1 + near) * torch.exp(-near)


class SmoothField(nn.Module):
    """K smooth random functions of position, c(s) = k(s, Z) R^-T z with anchors Z and k(Z, Z) + noise = R R^T.

    Under the Gaussian-process prior z is standard normal, so that a small |z|^2 is a smooth function. Near the anchors the
    functions follow them; far from all of them they fall back to 0 instead of extrapolating.

    Args:
        anchor: Z, normalised positions (M, 3).
        kernel: k, on normalised positions.
        rank: K.
    """

    def __init__(self, anchor: Tensor, kernel: Kernel, rank: int) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        gram = kernel(anchor.double(), anchor.double()) + kernel.noise * torch.eye(len(anchor), dtype=torch.float64)
        inverse = torch.linalg.inv(torch.linalg.cholesky(gram))  # of R; in float64, for nearby anchors are nearly alike
        self.register_buffer("whiten", inverse.T.to(anchor))
        self.coefficient = nn.Parameter(torch.zeros(len(anchor), rank))

    anchor: Tensor
    whiten: Tensor

    def forward(self, position: Tensor) -> Tensor:
        """c(s) at positions (B, 3), (B, K)."""
        return self.kernel(position, self.anchor) @ (self.whiten @ self.coefficient)

    def prior(self) -> Tensor:
        """|z|^2, the negative log prior up to a factor 1/2."""
        return self.coefficient.square().sum()


class MotionBasis(nn.Module):
    """Low-rank motion: all primitives move by one basis, mixed by smooth functions of position.

    Far from all measured positions the model falls back to the canonical primitives. One small matrix product a position,
    whatever the number of primitives.

    Args:
        anchor: normalised positions (M, 3) of the training spectra.
        kernel: of the prior, on normalised positions.
        rank: K, number of basis motions.
        n: number of primitives.
    """

    def __init__(
        self,
        anchor: Tensor,
        kernel: Kernel,
        rank: int,
        n: int,
        components: tuple[str, ...],
        *,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.components = components
        self.field = SmoothField(anchor, kernel, rank)
        size = sum(COMPONENTS[c] for c in components)
        self.basis = nn.Parameter(0.1 / math.sqrt(rank) * torch.randn(rank, n, size, generator=generator))

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Offsets at positions (B, 3); the canonical means are not looked at."""
        return _offsets(torch.einsum("bk,kns->bns", self.field(position), self.basis), self.components)
