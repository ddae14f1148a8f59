"""The interface of every deformation.

Positions are normalised: the bounding box of the training positions is centred in [-1, 1]^3, with one scale for all axes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from swiftwrf.data.store import Store
from swiftwrf.gp import Kernel
from swiftwrf.runtime.checkpoint import Header
from swiftwrf.runtime.registry import Registry

COMPONENTS = {"mean": 2, "response": 2, "attenuation": 1, "cholesky": 3}  # deformable parameters: values per primitive


class Offsets(NamedTuple):
    """Offsets of the parameters of each primitive at each position; None for a parameter that does not deform."""

    mean: Tensor | None = None  # (B, N, 2) [rad]
    response: Tensor | None = None  # (B, N, 2)
    attenuation: Tensor | None = None  # (B, N)
    cholesky: Tensor | None = None  # (B, N, 3) on the raw factor

    @classmethod
    def of(cls, flat: Tensor, components: tuple[str, ...]) -> Offsets:
        """Split (B, N, sum of sizes) into the named components."""
        parts = dict(zip(components, flat.split([COMPONENTS[c] for c in components], dim=-1), strict=True))
        if "attenuation" in parts:
            parts["attenuation"] = parts["attenuation"].squeeze(-1)
        return cls(**parts)


@dataclass(frozen=True)
class DeformationContext:
    """Sizes and prior that a new deformation needs.

    Args:
        n: Number of primitives.
        components: Parameters that deform.
        rank: Rank of a low-rank deformation.
        anchor: Normalised positions (M, 3) of the training spectra.
        kernel: Prior covariance over normalised positions.
    """

    n: int
    components: tuple[str, ...]
    rank: int
    anchor: Tensor
    kernel: Kernel


class Deformation(nn.Module, ABC):
    """Map from a normalised position to offsets of the parameters of the primitives."""

    @classmethod
    @abstractmethod
    def initial(cls, context: DeformationContext, *, generator: torch.Generator) -> Deformation:
        """Return a deformation with initial parameters."""

    @classmethod
    @abstractmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> Deformation:
        """Return a deformation with the shapes of saved tensors (by name within the deformation), to be loaded later."""

    def header(self) -> Header:
        """Return the plain values that `restore` needs."""
        return {}

    @classmethod
    def choose_rank(cls, position: Tensor, spectrum: Store, fold: Tensor, kernel: Kernel) -> int:
        """Return the rank with the lowest held-out error; see `swiftwrf.gp.choose_rank`. 0 if there is no rank."""
        return 0

    @abstractmethod
    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Return offsets at normalised positions (B, 3) of primitives with canonical means (N, 2) [rad]."""

    def unscaled_std(self, position: Tensor) -> Tensor | None:
        """Return the predictive standard deviation at normalised positions (B, 3) relative to the prior one, (B,).

        None if the fit gives no standard deviation.
        """
        return None

    def prior(self) -> Tensor | None:
        """Return twice the negative log prior of the parameters, or None without a prior."""
        return None

    def parameter_groups(self, rate: float, own_rate: float | None) -> list[dict[str, Any]]:
        """Return the parameters with their peak learning rates.

        Args:
            rate: Learning rate of the primitives.
            own_rate: Learning rate of the deformation, if the configuration has one.
        """
        parameters = list(self.parameters())
        return [{"params": parameters, "peak": own_rate or rate}] if parameters else []


DEFORMATIONS: Registry[Deformation] = Registry("deformation")
