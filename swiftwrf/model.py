"""SwiftWRF: primitives that move with the position, drawn as a spectrum."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from swiftwrf import checkpoint, checks
from swiftwrf.angles import AngularGrid
from swiftwrf.deformation import Kernel, MotionBasis, Offsets, PerPrimitiveMLP
from swiftwrf.errors import InputError
from swiftwrf.primitives import Gaussians, Primitives
from swiftwrf.rasterize import rasterize_magnitude

Deformation = Literal["motion_basis", "per_primitive_mlp", "none"]


@dataclass(frozen=True)
class ModelConfig:
    """What a SwiftWRF model consists of."""

    n_primitives: int | Literal["auto"] = "auto"
    """number N of primitives; auto lets the fit find how many the scene needs"""
    deformation: Deformation = "motion_basis"
    """how they move: low-rank motion (fast), the paper's network per primitive, or not at all"""
    components: tuple[Literal["mean", "response", "attenuation", "cholesky"], ...] = (
        "mean",
        "response",
        "attenuation",
        "cholesky",
    )
    """which of their parameters move"""
    rank: int | Literal["auto"] = "auto"
    """number K of motions that the motion basis mixes; auto lets the fit find how many the scene needs"""
    axis_aligned: bool = False
    """primitives do not lean: l2 = 0"""
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


class SwiftWRF(nn.Module):
    """Spectrum at any position: |sum_n psi_n delta_n kernel_n|, with parameters deformed by the position.

    Args:
        config: what it consists of.
        grid: the grid that it is fitted on and that `synthesize` draws unless told otherwise.
        anchor: positions (M, 3) [m] of the training spectra; they give the frame in which positions are normalised and
            the anchors of the motion basis.
        kernel: of the motion basis, with lengths [m].
        generator: for the initial parameters.
    """

    def __init__(
        self, config: ModelConfig, grid: AngularGrid, anchor: Tensor, kernel: Kernel, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        n, rank = config.size
        low, high = anchor.min(dim=0).values, anchor.max(dim=0).values
        scale = float((high - low).max()) / 2 or 1.0
        self.register_buffer("centre", ((low + high) / 2).double())
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float64))
        self.primitives = Primitives(
            n, grid, bounded=config.bounded, axis_aligned=config.axis_aligned, generator=generator
        )
        self.deformation: MotionBasis | PerPrimitiveMLP | None
        if config.deformation == "motion_basis":
            normalised, scaled = self.normalise(anchor), kernel.scaled(1 / scale)
            self.deformation = MotionBasis(normalised, scaled, rank, n, config.components, generator=generator)
        elif config.deformation == "per_primitive_mlp":
            self.deformation = PerPrimitiveMLP(config.components, generator=generator)
        else:
            self.deformation = None

    centre: Tensor
    scale: Tensor

    def normalise(self, position: Tensor) -> Tensor:
        """Positions (n, 3) [m] in the training positions' frame, float32: their box is centred in [-1, 1]^3 and scaled
        alike on all axes. In float64 first, so that coordinates in kilometres keep their millimetres."""
        return ((position.double() - self.centre) / self.scale).float()

    def gaussians(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Gaussians:
        """The primitives at normalised positions (B, 3).

        Args:
            deform: False leaves them canonical (the coarse stage).
            stop_mean: no gradient reaches the canonical means (the paper's fine stage).
        """
        canonical = self.primitives()
        if stop_mean:
            canonical = canonical._replace(mean=canonical.mean.detach())
        offsets = Offsets() if self.deformation is None or not deform else self.deformation(position, canonical.mean)
        mean, cholesky, attenuation, response = canonical
        if offsets.cholesky is not None:
            cholesky = self.primitives.constrained(self.primitives.cholesky + offsets.cholesky)
        if offsets.mean is not None:
            mean = mean + offsets.mean
        if offsets.attenuation is not None:
            attenuation = attenuation + offsets.attenuation
        if offsets.response is not None:
            response = response + offsets.response
        return Gaussians(mean, cholesky, attenuation, response)

    def draw(self, gaussians: Gaussians, n: int, grid: AngularGrid) -> Tensor:
        """Magnitudes (n, H, W) of primitives at n positions."""
        mean = gaussians.mean.expand(n, -1, -1)
        weight = gaussians.weight.expand(n, -1, -1)
        return rasterize_magnitude(mean, gaussians.cholesky, weight, grid, cutoff=self.config.cutoff)

    def forward(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Tensor:
        """Magnitudes (B, H, W) at normalised positions (B, 3), on the model's grid, differentiable."""
        return self.draw(self.gaussians(position, deform=deform, stop_mean=stop_mean), len(position), self.grid)

    @torch.no_grad()
    def synthesize(self, position: Tensor, grid: AngularGrid | None = None, batch: int = 64) -> Tensor:
        """Spectra at any positions.

        Args:
            position: of the moving end [m], (n, 3).
            grid: directions to draw; the model's own unless given. Any resolution will do.
            batch: spectra drawn at a time, which bounds the memory.

        Returns:
            Magnitudes clipped to [0, 1], float32 (n, n_elevation, n_azimuth), on the CPU.

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position = checks.positions(position)
        grid = grid or self.grid
        spectrum = torch.empty(len(position), *grid.shape)
        for start in range(0, len(position), batch):
            x = self.normalise(position[start : start + batch].to(self.centre.device))
            spectrum[start : start + batch] = self.draw(self.gaussians(x), len(x), grid).clamp(0, 1)
        return spectrum

    def save(self, path: str | Path, provenance: dict[str, str] | None = None) -> None:
        """Writes the model to one safetensors file, its configuration and `provenance` in the header."""
        motion = self.deformation.field.kernel if isinstance(self.deformation, MotionBasis) else Kernel()
        header = {
            "config": asdict(self.config),
            "grid": asdict(self.grid),
            "kernel": asdict(motion),
            "provenance": provenance or {},
        }
        checkpoint.write(path, "swiftwrf model", self.state_dict(), header)


def load(path: str | Path) -> SwiftWRF:
    """The model that `SwiftWRF.save` wrote.

    Raises:
        InputError: not such a file.
    """
    tensors, header = checkpoint.read(path, "swiftwrf model")
    config = ModelConfig(**{**header["config"], "components": tuple(header["config"]["components"])})
    anchor = torch.zeros_like(tensors.get("deformation.field.anchor", torch.empty(1, 3)))  # of the right shape, for now
    grid = AngularGrid(**header["grid"])
    model = SwiftWRF(config, grid, anchor, Kernel(), generator=torch.Generator())
    model.load_state_dict(tensors)
    if isinstance(model.deformation, MotionBasis):
        model.deformation.field.kernel = Kernel(**header["kernel"])
    return model.eval()
