"""No deformation: one spectrum for all positions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from swiftwrf.models.swiftwrf.deformation.base import DEFORMATIONS, Deformation, DeformationContext, Offsets
from swiftwrf.runtime.checkpoint import Header


@DEFORMATIONS.register("none")
class Static(Deformation):
    """Return no offsets: the primitives stay canonical."""

    @classmethod
    def initial(cls, context: DeformationContext, *, generator: torch.Generator) -> Static:
        return cls()

    @classmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> Static:
        return cls()

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        return Offsets()
