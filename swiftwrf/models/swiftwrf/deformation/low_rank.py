"""Low-rank deformation with a Gaussian-process prior over positions."""

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
from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS, DEFORMATIONS, Deformation, DeformationContext, Offsets
from swiftwrf.runtime.checkpoint import Header, expect


@DEFORMATIONS.register("motion_basis")
class LowRankDeformation(Deformation):
    """Offsets of all primitives as K basis vectors with coefficients that are smooth functions of the position.

    Far from all training positions the coefficients are 0 and the primitives canonical. A position costs one small matrix
    product, for any number of primitives.

    Args:
        field: The smooth functions. A regression cannot be fitted by gradient descent.
        basis: Offsets of the primitives, (K, N, sum of component sizes).
        components: Parameters that deform.
        deviation: Calibration factor between the prior's standard deviation of a spectrum and the measured one; 0 if
            unknown.
    """

    deviation: Tensor

    def __init__(
        self,
        field: gp.SmoothField,
        basis: Tensor,
        components: tuple[str, ...],
        deviation: float = 0.0,
    ) -> None:
        super().__init__()
        self.components, self.field, self.basis = components, field, nn.Parameter(basis)
        self.register_buffer("deviation", torch.tensor(deviation))

    @classmethod
    def initial(cls, context: DeformationContext, *, generator: torch.Generator) -> LowRankDeformation:
        rank, size = context.rank, sum(COMPONENTS[c] for c in context.components)
        field = gp.SmoothField(context.anchor, context.kernel, rank)
        basis = 0.1 / math.sqrt(max(rank, 1)) * torch.randn(rank, context.n, size, generator=generator)
        return cls(field, basis, context.components)

    @classmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> LowRankDeformation:
        rank, n, m = header["config"]["rank"], header["config"]["n_primitives"], len(tensors["field.anchor"])
        kernel, regressed = gp.Kernel(**header["kernel"]), "field.value" in tensors
        own: dict[str, tuple[int, ...]] = (
            {"value": (m, rank)} if regressed else {"whiten": (m, m), "coefficient": (m, rank)}
        )
        own |= {"correlation": (m,)} if "field.correlation" in tensors else {}
        field_shapes = {f"field.{name}": shape for name, shape in ({"anchor": (m, 3)} | own).items()}
        basis_shape = (rank, n, sum(COMPONENTS[c] for c in components))
        expect(dict(tensors), field_shapes | {"basis": basis_shape, "deviation": ()})
        if not float(tensors["deviation"]) >= 0:
            raise InputError(f"deviation is {float(tensors['deviation'])}, expected 0 or more")
        anchor, basis = tensors["field.anchor"], tensors["basis"].clone()
        known = (tensors.get(f"field.{name}") for name in ("whiten", "value", "correlation"))
        return cls(gp.SmoothField(anchor, kernel, rank, *known), basis, components)

    def header(self) -> Header:
        return {"kernel": asdict(self.field.kernel)}

    @classmethod
    def choose_rank(cls, position: Tensor, spectrum: Store, fold: Tensor, kernel: gp.Kernel) -> int:
        return gp.choose_rank(position, spectrum, fold, kernel)

    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Return offsets at normalised positions (B, 3); the canonical means are not used."""
        return Offsets.of(torch.einsum("bk,kns->bns", self.field(position), self.basis), self.components)

    def unscaled_std(self, position: Tensor) -> Tensor | None:
        if not self.deviation > 0:
            return None
        return self.deviation * (self.field.variance(position) + self.field.kernel.noise).sqrt()

    def prior(self) -> Tensor:
        return self.field.prior()

    def parameter_groups(self, rate: float, own_rate: float | None) -> list[dict[str, Any]]:
        return [{"params": [self.field.coefficient], "peak": rate}, {"params": [self.basis], "peak": rate / 2}]
