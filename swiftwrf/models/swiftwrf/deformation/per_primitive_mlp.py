"""The paper's network: one evaluation for each primitive and position (section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor, nn

from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS, DEFORMATIONS, Deformation, DeformationContext, Offsets
from swiftwrf.models.swiftwrf.mlp import encode, skip_forward, skip_layers
from swiftwrf.runtime.checkpoint import Header

MEAN_BANDS, POSITION_BANDS = 10, 6  # frequency bands of the paper's encodings
WIDTH, DEPTH = 156, 8  # size of the paper's network
SKIPS = range(2, DEPTH, 2)  # layers that take the input again


@DEFORMATIONS.register("per_primitive_mlp")
class PerPrimitiveMLP(Deformation):
    """Eight layers of width 156 on the encodings of mean and position.

    Every second layer takes the input again. The linear output starts at 0, so that the first deformed spectrum is the
    canonical one. A primitive and position costs 0.3 million multiplications: at 10,000 primitives the network, not the
    rasterizer, limits the spectra per second.
    """

    def __init__(self, components: tuple[str, ...], *, generator: torch.Generator) -> None:
        super().__init__()
        self.components = components
        inputs = 2 * (2 * MEAN_BANDS + 1) + 3 * (2 * POSITION_BANDS + 1)
        self.layers = skip_layers(inputs, WIDTH, DEPTH, SKIPS)
        self.output = nn.Linear(WIDTH, sum(COMPONENTS[c] for c in components))
        for layer in self.layers:
            bound = 1 / math.sqrt(
                cast(nn.Linear, layer).in_features
            )  # torch's default, sampled from the given generator
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
        unit = mean / mean.new_tensor([math.pi, math.pi / 4]) - 1  # the encoding expects values in [-1, 1]
        of_mean, of_position = encode(unit, MEAN_BANDS), encode(position, POSITION_BANDS)[:, None]
        shape = (len(position), len(mean), -1)
        x = torch.cat([of_mean.expand(shape), of_position.expand(shape)], dim=-1)
        return Offsets.of(self.output(skip_forward(self.layers, x, SKIPS)), self.components)
