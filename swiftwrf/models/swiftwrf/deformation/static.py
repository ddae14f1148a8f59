"""No motion: one spectrum for all positions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from swiftwrf.models.swiftwrf.deformation.base import DEFORMATIONS, Deformation, Offsets, Setting
from swiftwrf.runtime.checkpoint import Header


@DEFORMATIONS.register("none")
class Static(Deformation):
    """Leaves the primitives canonical."""

    @classmethod
    def initial(cls, setting: Setting, *, generator: torch.Generator) -> Static:
        return cls()

    @classmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> Static:
        return cls()

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        return Offsets()
