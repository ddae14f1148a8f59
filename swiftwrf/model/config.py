"""What a SwiftWRF model consists of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from swiftwrf.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.model.deformation import COMPONENTS, deformation_type
from swiftwrf.model.primitives import Primitives


@dataclass(frozen=True)
class ModelConfig:
    """What a SwiftWRF model consists of."""

    n_primitives: int | Literal["auto"] = "auto"
    """number N of primitives; auto lets the fit find how many the scene needs"""
    deformation: str = "motion_basis"
    """how they move: a name of `swiftwrf.model.deformation.DEFORMATIONS`"""
    components: tuple[Literal["mean", "response", "attenuation", "cholesky"], ...] = ("response",)
    """which of their parameters change with the position"""
    rank: int | Literal["auto"] = "auto"
    """number K of motions that the motion basis mixes; auto lets the fit find how many the scene needs"""
    axis_aligned: bool = False
    """keep the axes of the primitives along azimuth and elevation: l2 = 0"""
    bounded: bool = False
    """keep canonical means inside the grid by the paper's tanh map"""
    cutoff: float = 1e-4
    """kernel values below it are not drawn"""

    @property
    def size(self) -> tuple[int, int]:
        """N and K.

        Raises:
            InputError: one is still to be found.
        """
        if self.n_primitives == "auto" or self.rank == "auto":
            raise InputError(
                "a model needs numbers for n_primitives and rank; swiftwrf.fit finds those that are 'auto'"
            )
        return self.n_primitives, self.rank

    def check(self) -> None:
        """Refuses what no model can have, wherever the configuration comes from.

        Raises:
            InputError: such a setting.
        """
        deformation_type(self.deformation)
        unknown = set(self.components) - set(COMPONENTS)
        if unknown or len(set(self.components)) < len(self.components):
            raise InputError(f"components must be some of {', '.join(COMPONENTS)}, each once, got {self.components}")
        whole = all(type(value) is int and value >= 0 for value in self.size)
        if not whole or not 0 < self.cutoff < 1 or not all(type(x) is bool for x in (self.bounded, self.axis_aligned)):
            raise InputError(f"this makes no model: {self}")

    def make_primitives(self, grid: AngularGrid, generator: torch.Generator) -> Primitives:
        """Canonical primitives at their start."""
        n, _ = self.size
        return Primitives(n, grid, bounded=self.bounded, axis_aligned=self.axis_aligned, generator=generator)
