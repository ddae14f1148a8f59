"""The network that NeRF2 and WRF-GS are built on."""

from __future__ import annotations

import torch
from torch import Tensor, nn

AGAIN = 5  # the layer that is given the input again (NeRF2's code)


class Layers(nn.Module):
    """Layers with ReLU, one of which is given the input again.

    Args:
        inputs, width, depth: numbers entering, of each layer, and of layers.
    """

    def __init__(self, inputs: int, width: int, depth: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.Linear(inputs if i == 0 else width + (inputs if i == AGAIN else 0), width) for i in range(depth)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., width)."""
        h = x
        for i, layer in enumerate(self.layers):
            h = torch.relu(layer(torch.cat([h, x], dim=-1) if i == AGAIN else h))
        return h
