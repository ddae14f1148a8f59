"""The paper's network: one evaluation a primitive and position (section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor, nn

from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS, DEFORMATIONS, Deformation, DeformationContext, Offsets
from swiftwrf.models.swiftwrf.encoding import encode
from swiftwrf.runtime.checkpoint import Header

MEAN_BANDS, POSITION_BANDS = 10, 6  # frequency bands of the paper's encodings
WIDTH, DEPTH = 156, 8  # of the paper's network


@DEFORMATIONS.register("per_primitive_mlp")
class PerPrimitiveMLP(Deformation):
    """Eight layers of width 156, from the encodings of the mean and the position.

    The input is fed in again every two layers; the one linear output starts at zero, which makes the first deformed
    spectrum the canonical one. 0.3 million multiplications a primitive and position: at 10,000 primitives it, not the
    rasterizer, bounds the spectra per second.
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

    @classmethod
    def initial(cls, context: DeformationContext, *, generator: torch.Generator) -> PerPrimitiveMLP:
        return cls(context.components, generator=generator)

    @classmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> PerPrimitiveMLP:
        return cls(components, generator=torch.Generator())

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
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
        return Offsets.of(self.output(h), self.components)
