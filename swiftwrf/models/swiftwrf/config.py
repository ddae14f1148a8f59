"""Configuration of a SwiftWRF model and of its fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.splits import Validation
from swiftwrf.errors import InputError
from swiftwrf.models.swiftwrf.deformation import COMPONENTS, deformation_type
from swiftwrf.models.swiftwrf.primitives import Primitives


@dataclass(frozen=True)
class ModelConfig:
    """What a SwiftWRF model consists of."""

    n_primitives: int | Literal["auto"] = "auto"
    """number N of primitives; auto lets the fit find how many the scene needs"""
    deformation: str = "motion_basis"
    """how they move: a name of `swiftwrf.models.swiftwrf.deformation.DEFORMATIONS`"""
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


@dataclass(frozen=True)
class FitConfig:
    """How a model is fitted. The defaults are what measured best; `FitConfig.paper()` is the paper."""

    model: ModelConfig = field(default_factory=ModelConfig)
    steps: int = 0
    """0: by regression; otherwise steps by gradient from a random start, coarse ones included; what follows on steps,
    rates, batch, prior and smoothing is theirs"""
    coarse_share: float = 0.0
    """share of them on shared primitives, without deformation (the paper's coarse stage)"""
    batch: int = 16
    """spectra a step"""
    rate: float = 3e-2
    """learning rate of primitives and coefficients (half of it for the motion basis)"""
    deformation_rate: float | None = None
    """learning rate of the paper's network"""
    warm_up: int = 50
    """steps over which the rates rise"""
    final_rate: float = 0.02
    """share of the rates left after cosine decay"""
    ssim_weight: float = 0.3
    """weight of 1 - SSIM in the loss, by which a size is chosen, too; the pixels' error has the rest"""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """absolute or squared error"""
    prior_weight: float = 1e-4
    """weight of the motion's negative log prior per training spectrum"""
    smoothing: float = 0.0
    """the paper's gamma: scale of the noise on positions, annealed to 0"""
    smoothing_steps: int = 10_000
    """the paper's tau: fine steps until that noise is gone"""
    stop_mean: bool = False
    """keep the canonical means where the coarse stage left them"""
    max_azimuths: int = 180
    """spectra with more columns are averaged down to at most this many for fitting; 0 fits all pixels"""
    validation: Validation = "random"
    """what is held out inside the training part: single spectra, or a region where the model must extrapolate"""
    check_every: int = 50
    """steps between two evaluations, at which progress is recorded and the state kept"""
    seed: int = 0

    def check(self) -> None:
        """Refuses settings that do not fit together.

        Raises:
            InputError: what goes only by gradient without steps, or steps of a model whose size is to be found.
        """
        model = self.model
        still = model.deformation == "none" or (model.deformation == "motion_basis" and "response" in model.components)
        if not self.steps and not still:
            raise InputError(
                f"deformation {model.deformation} of {', '.join(model.components)} is not found by regression; give a "
                "number of steps to fit it by gradient"
            )
        if self.steps and model.n_primitives == "auto":
            raise InputError("a fit by gradient needs a number of primitives; only regression finds it")

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """The paper's settings: 10,000 bounded primitives, its network, means kept, annealed noise, all pixels."""
        model = ModelConfig(
            n_primitives=10_000,
            rank=0,
            deformation="per_primitive_mlp",
            components=("mean", "response", "attenuation"),
            bounded=True,
        )
        paper = cls(
            model=model,
            steps=110_000,
            coarse_share=1 / 11,
            batch=1,
            rate=1e-2,
            deformation_rate=8e-3,
            smoothing=1.0,
            stop_mean=True,
            max_azimuths=0,
            check_every=1000,
        )
        return replace(paper, **changes)
