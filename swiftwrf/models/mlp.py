"""Positional encoding, and the multilayer perceptron with skip connections that networks of this field are built on."""

from __future__ import annotations

import math
from collections.abc import Collection

import torch
from torch import Tensor, nn

NERF_SKIPS = (5,)  # the layer that takes the input again in NeRF2's code


def encode(x: Tensor, bands: int, lowest: float = math.pi) -> Tensor:
    """Return [x, sin(2^k lowest x), cos(2^k lowest x)] for k = 0 .. bands - 1.

    Args:
        x: Values (..., d).
        bands: Number of frequencies.
        lowest: Lowest angular frequency. The paper takes pi, for values in [-1, 1]; NeRF2 takes 1, for metres.

    Returns:
        Encoded values (..., d (2 bands + 1)).
    """
    angle = x[..., None, :] * (lowest * 2.0 ** torch.arange(bands, dtype=x.dtype, device=x.device))[:, None]
    return torch.cat([x, torch.sin(angle).flatten(-2), torch.cos(angle).flatten(-2)], dim=-1)


def skip_layers(inputs: int, width: int, depth: int, skips: Collection[int] = NERF_SKIPS) -> nn.ModuleList:
    """Return linear layers of one width; the layers `skips`, counted from 0, take the input again."""
    return nn.ModuleList(
        nn.Linear(inputs if i == 0 else width + (inputs if i in skips else 0), width) for i in range(depth)
    )


def skip_forward(layers: nn.ModuleList, x: Tensor, skips: Collection[int] = NERF_SKIPS) -> Tensor:
    """Return the output (..., width) of `skip_layers` with ReLU for inputs (..., inputs)."""
    h = x
    for i, layer in enumerate(layers):
        h = torch.relu(layer(torch.cat([h, x], dim=-1) if i in skips else h))
    return h


class SkipMLP(nn.Module):
    """`skip_layers` as one module.

    Args:
        inputs, width, depth: Size of the input, size of each layer, number of layers.
    """

    def __init__(self, inputs: int, width: int, depth: int) -> None:
        super().__init__()
        self.layers = skip_layers(inputs, width, depth)

    def forward(self, x: Tensor) -> Tensor:
        """Return the output (..., width) for inputs (..., inputs)."""
        return skip_forward(self.layers, x)
