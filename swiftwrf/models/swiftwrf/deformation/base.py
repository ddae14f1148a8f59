"""What every deformation is.

Positions here are normalised: the training positions' bounding box, scaled alike on all axes, is centred in [-1, 1]^3.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from swiftwrf.data.store import Store
from swiftwrf.gp import Kernel
from swiftwrf.runtime.checkpoint import Header
from swiftwrf.runtime.registry import Registry

COMPONENTS = {"mean": 2, "response": 2, "attenuation": 1, "cholesky": 3}  # what can deform, and its numbers a primitive


class Offsets(NamedTuple):
    """What is added to each primitive at each position; None where a component does not deform."""

    mean: Tensor | None = None  # (B, N, 2) [rad]
    response: Tensor | None = None  # (B, N, 2)
    attenuation: Tensor | None = None  # (B, N)
    cholesky: Tensor | None = None  # (B, N, 3) on the raw factor

    @classmethod
    def of(cls, flat: Tensor, components: tuple[str, ...]) -> Offsets:
        """Splits (B, N, sum of sizes) into the named components."""
        parts = dict(zip(components, flat.split([COMPONENTS[c] for c in components], dim=-1), strict=True))
        if "attenuation" in parts:
            parts["attenuation"] = parts["attenuation"].squeeze(-1)
        return cls(**parts)


@dataclass(frozen=True)
class Setting:
    """What a deformation is made for.

    Args:
        n: number of primitives.
        components: that deform.
        rank: number of motions, for those that mix some.
        anchor: normalised positions (M, 3) of the training spectra.
        kernel: of the prior over positions, on normalised positions.
    """

    n: int
    components: tuple[str, ...]
    rank: int
    anchor: Tensor
    kernel: Kernel


class Deformation(nn.Module, ABC):
    """Normalised position to offsets of the primitives' parameters."""

    @classmethod
    @abstractmethod
    def initial(cls, setting: Setting, *, generator: torch.Generator) -> Deformation:
        """One at its start."""

    @classmethod
    @abstractmethod
    def restore(cls, components: tuple[str, ...], header: Header, tensors: Mapping[str, Tensor]) -> Deformation:
        """One of the shapes that saved `tensors` (by name within the deformation) have; they are copied in afterwards."""

    def header(self) -> Header:
        """Plain values that `restore` needs."""
        return {}

    @classmethod
    def choose_rank(cls, position: Tensor, spectrum: Store, fold: Tensor, kernel: Kernel) -> int:
        """How many motions training spectra call for; see `swiftwrf.gp.choose_rank`. 0 for those that mix none."""
        return 0

    @abstractmethod
    def forward(self, position: Tensor, mean: Tensor) -> Offsets:
        """Offsets at normalised positions (B, 3) of primitives with canonical means (N, 2) [rad]."""

    def doubt(self, position: Tensor) -> Tensor | None:
        """Standard deviation of a measured spectrum about the drawn one at normalised positions (B, 3), in units of that of
        all spectra, (B,); None where it is unknown."""
        return None

    def prior(self) -> Tensor | None:
        """Negative log prior up to a factor 1/2; None without one."""
        return None

    def parameter_groups(self, rate: float, own_rate: float | None) -> list[dict[str, Any]]:
        """Parameters with their peak learning rates.

        Args:
            rate: of the primitives.
            own_rate: of the deformation, where the configuration gives one.
        """
        parameters = list(self.parameters())
        return [{"params": parameters, "peak": own_rate or rate}] if parameters else []


DEFORMATIONS: Registry[Deformation] = Registry("deformation")


def deformation_type(name: str) -> type[Deformation]:
    """The class of the deformation of that name.

    Raises:
        InputError: there is none.
    """
    return cast(type[Deformation], DEFORMATIONS[name])
