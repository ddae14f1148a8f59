"""Options of a SwiftWRF model and of its fit."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Gt, Lt

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.models.base import FieldConfig
from swiftwrf.models.swiftwrf.deformation import DEFORMATIONS
from swiftwrf.models.swiftwrf.primitives import Primitives
from swiftwrf.runtime.validation import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    configuration,
)

PixelLoss = Literal["l1", "l2"]


@configuration
class ModelConfig:
    """Structure of a SwiftWRF model.

    Example:
        >>> ModelConfig(n_primitives=64).rank
        'auto'
    """

    n_primitives: PositiveInt | Literal["auto"] = "auto"
    """number N of primitives; "auto" lets the fit choose it on held-out spectra"""
    deformation: str = "motion_basis"
    """name of the deformation in `swiftwrf.models.swiftwrf.deformation.DEFORMATIONS`"""
    components: tuple[Literal["mean", "response", "attenuation", "cholesky"], ...] = ("response",)
    """parameters of the primitives that depend on the position"""
    rank: NonNegativeInt | Literal["auto"] = "auto"
    """rank K of the low-rank deformation; "auto" lets the fit choose it on held-out spectra"""
    axis_aligned: bool = False
    """keep the axes of the primitives along azimuth and elevation: l2 = 0"""
    bounded: bool = False
    """keep canonical means inside the grid by the paper's tanh map"""
    cutoff: Annotated[float, Gt(0), Lt(1)] = 1e-4
    """kernel values below the cutoff count as 0"""

    def check(self) -> None:
        """Refuse unknown deformations and repeated components."""
        DEFORMATIONS[self.deformation]
        if len(set(self.components)) < len(self.components):
            raise InputError(f"components must be named once each, got {', '.join(self.components)}")

    @property
    def size(self) -> tuple[int, int]:
        """Number of primitives and rank.

        Raises:
            InputError: One of them is "auto".
        """
        if self.n_primitives == "auto" or self.rank == "auto":
            raise InputError("n_primitives and rank must be numbers here; only a fit can choose them")
        return self.n_primitives, self.rank

    def make_primitives(self, grid: AngularGrid, generator: torch.Generator) -> Primitives:
        """Return canonical primitives with random parameters."""
        n, _ = self.size
        return Primitives(n, grid, bounded=self.bounded, axis_aligned=self.axis_aligned, generator=generator)


@configuration
class FitConfig(FieldConfig):
    """Options of `SwiftWRF`. The defaults fit by regression; `FitConfig.paper()` has the settings of the paper.

    Example:
        >>> FitConfig.paper(seed=1).steps
        110000
    """

    model: ModelConfig = field(default_factory=ModelConfig)
    """structure of the model"""
    steps: NonNegativeInt = 0
    """number of Adam steps, including the coarse stage; 0 fits in closed form and ignores the optimiser's options below"""
    coarse_fraction: Fraction = 0.0
    """fraction of the steps without deformation (the paper's coarse stage)"""
    batch: PositiveInt = 16
    """spectra per step"""
    rate: PositiveFloat = 1e-2
    """learning rate of primitives and coefficients; the basis of the low-rank deformation has half of it"""
    deformation_rate: PositiveFloat | None = None
    """learning rate of the paper's network; None takes `rate`"""
    warm_up: NonNegativeInt = 50
    """steps over which the rates rise"""
    final_rate: Fraction = 0.02
    """final fraction of the rates after cosine decay"""
    ssim_weight: Fraction = 0.3
    """weight of 1 - SSIM in the loss, also when the fit compares sizes; the pixel loss has the remaining weight"""
    pixel_loss: PixelLoss = "l1"
    """absolute or squared error of pixels"""
    prior_weight: NonNegativeFloat = 1e-4
    """weight of the deformation's negative log prior per training spectrum"""
    smoothing: NonNegativeFloat = 0.0
    """the paper's gamma: scale of the noise on positions, annealed to 0"""
    smoothing_steps: PositiveInt = 10_000
    """the paper's tau: fine steps after which that noise is 0"""
    stop_mean: bool = False
    """freeze the canonical means after the coarse stage"""
    max_azimuths: NonNegativeInt = 180
    """fit to spectra averaged down to at most this number of columns; 0 fits to all pixels"""
    check_every: PositiveInt = 50
    """steps between two evaluations, at which a record is sent and the state is saved"""

    def check(self) -> None:
        """Refuse a regression of what only gradient descent fits, and gradient descent without a number of primitives."""
        model = self.model
        linear = model.deformation == "none" or (model.deformation == "motion_basis" and "response" in model.components)
        if not self.steps and not linear:
            raise InputError(
                f"deformation {model.deformation} of {', '.join(model.components)} cannot be fitted by regression; give a "
                "number of steps to fit it by gradient descent"
            )
        if self.steps and model.n_primitives == "auto":
            raise InputError("a fit by gradient descent needs a number of primitives; only regression chooses it")

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """Return the settings of the paper: 10,000 bounded primitives, its network, frozen means, annealed noise."""
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
            coarse_fraction=1 / 11,
            batch=1,
            deformation_rate=8e-3,
            smoothing=1.0,
            stop_mean=True,
            max_azimuths=0,
            check_every=1000,
        )
        return replace(paper, **changes)
