"""Low-rank motion with a Gaussian-process prior over positions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from swiftwrf import gp
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS, DEFORMATIONS, Deformation, Offsets, Setting
from swiftwrf.runtime.checkpoint import Header, expect


@DEFORMATIONS.register("motion_basis")
class MotionBasis(Deformation):
    """All primitives move by one basis, mixed by smooth functions of position.

    Far from all measured positions the model falls back to the canonical primitives. One small matrix product a position,
    whatever the number of primitives.

    Args:
        field: the smooth functions; those of neighbours are not fitted by gradient.
        basis: motions of the primitives, (rank, N, numbers that deform).
        components: that deform.
        deviation: of measured spectra about the drawn ones, relative to what the prior of the motion says; 0 where it
            is unknown.
    """

    def __init__(
        self,
        field: gp.SmoothField | gp.NearbyField,
        basis: Tensor,
        components: tuple[str, ...],
        deviation: float = 0.0,
    ) -> None:
        super().__init__()
        self.components, self.field, self.basis = components, field, nn.Parameter(basis)
        self.register_buffer("deviation", torch.tensor(deviation))

    deviation: Tensor

    @classmethod
    def initial(cls, setting: Setting, *, generator: torch.Generator) -> MotionBasis:
        rank, size = setting.rank, sum(COMPONENTS[c] for c in setting.components)
        field = gp.SmoothField(setting.anchor, setting.kernel, rank)
        basis = 0.1 / math.sqrt(max(rank, 1)) * torch.randn(rank, setting.n, size, generator=generator)
        return cls(field, basis, setting.components)

    @classmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> MotionBasis:
        rank, n, m = header["config"]["rank"], header["config"]["n_primitives"], len(tensors["field.anchor"])
        kernel, few = gp.Kernel(**header["kernel"]), "field.whiten" in tensors
        own = {"whiten": (m, m), "coefficient": (m, rank)} if few else {"value": (m, rank)}
        field_shapes = {f"field.{name}": shape for name, shape in ({"anchor": (m, 3)} | own).items()}
        basis_shape = (rank, n, sum(COMPONENTS[c] for c in components))
        expect(dict(tensors), field_shapes | {"basis": basis_shape, "deviation": ()})
        if not float(tensors["deviation"]) >= 0:
            raise InputError(f"deviation is {float(tensors['deviation'])}, expected 0 or more")
        anchor, basis = tensors["field.anchor"], tensors["basis"].clone()
        if few:
            return cls(gp.SmoothField(anchor, kernel, rank, tensors["field.whiten"]), basis, components)
        return cls(gp.NearbyField(anchor, kernel, tensors["field.value"]), basis, components)

    def header(self) -> Header:
        return {"kernel": asdict(self.field.kernel)}

    @classmethod
    def choose_rank(cls, position: Tensor, spectrum: Store, fold: Tensor, kernel: gp.Kernel) -> int:
        return gp.choose_rank(position, spectrum, fold, kernel)

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Offsets at positions (B, 3); the canonical means play no part."""
        return Offsets.of(torch.einsum("bk,kns->bns", self.field(position), self.basis), self.components)

    def doubt(self, position: Tensor) -> Tensor | None:
        if not self.deviation > 0:
            return None
        return self.deviation * (self.field.variance(position) + self.field.kernel.noise).sqrt()

    def prior(self) -> Tensor:
        assert isinstance(self.field, gp.SmoothField)
        return self.field.prior()

    def parameter_groups(self, rate: float, own_rate: float | None) -> list[dict[str, Any]]:
        assert isinstance(self.field, gp.SmoothField)
        return [{"params": [self.field.coefficient], "peak": rate}, {"params": [self.basis], "peak": rate / 2}]
