"""Positional encoding, and the multilayer perceptron with skip connections that networks of this field are built on."""

from __future__ import annotations

import math
from collections.abc import Collection

import torch
from torch import Tensor, nn


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


class SkipMLP(nn.ModuleList):
    """Linear layers of one width with ReLU; some take the input again.

    Args:
        inputs, width, depth: Size of the input, size of each layer, number of layers.
        skips: Layers that take the input again, counted from 0.

    Example:
        >>> [layer.in_features for layer in SkipMLP(3, 8, 3, skips=(2,))]
        [3, 8, 11]
    """

    def __init__(self, inputs: int, width: int, depth: int, skips: Collection[int] = (5,)) -> None:
        sizes = [inputs] + [width + inputs * (i in skips) for i in range(1, depth)]
        super().__init__(nn.Linear(size, width) for size in sizes)
        self.skips = skips

    def forward(self, x: Tensor) -> Tensor:
        """Return the output (..., width) for inputs (..., inputs)."""
        h = x
        for i, layer in enumerate(self):
            h = torch.relu(layer(torch.cat([h, x], dim=-1) if i in self.skips else h))
        return h


def draw_parameters(model: nn.Module, generator: torch.Generator) -> None:
    """Initialise weights and biases of all layers uniformly within 1 / sqrt(inputs), torch's default."""
    for layer in model.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            inputs, _ = nn.init._calculate_fan_in_and_fan_out(layer.weight)
            for parameter in layer.parameters(recurse=False):
                nn.init.uniform_(parameter, -1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)
