"""The learnable part of SwiftWRF: canonical 2D Gaussians, their deformation and the frame of the positions."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel
from swiftwrf.models.swiftwrf.config import ModelConfig
from swiftwrf.models.swiftwrf.deformation import DEFORMATIONS, Deformation, DeformationContext, Offsets
from swiftwrf.models.swiftwrf.primitives import Gaussians, Primitives
from swiftwrf.positions import frame, normalise
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.rasterize.reference import kernels
from swiftwrf.runtime.checkpoint import Header, expect


class DeformableGaussians(nn.Module):
    """Spectrum at any position: |sum_n psi_n delta_n kernel_n|, with parameters deformed by the position.

    Args:
        config: Structure, with numbers for `n_primitives` and `rank`.
        grid: Directions that `forward` renders.
        centre: Origin of the frame in which positions are normalised, float64 (3,) [m].
        scale: Unit of that frame, float64 () [m].
        primitives: Canonical primitives.
        deformation: Their deformation.
    """

    centre: Tensor
    scale: Tensor

    def __init__(
        self,
        config: ModelConfig,
        grid: AngularGrid,
        centre: Tensor,
        scale: Tensor,
        primitives: Primitives,
        deformation: Deformation,
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.register_buffer("centre", centre)
        self.register_buffer("scale", scale)
        self.primitives, self.deformation = primitives, deformation

    @classmethod
    def initial(
        cls, config: ModelConfig, grid: AngularGrid, anchor: Tensor, kernel: Kernel, *, generator: torch.Generator
    ) -> DeformableGaussians:
        """Return Gaussians with random parameters, the start of a fit by gradient descent.

        Args:
            config: Options of the model.
            grid: Directions of the spectra.
            anchor: Training positions (M, 3) [m], which give the frame and the anchors of the deformation.
            kernel: Prior covariance of the deformation over positions, with lengths in metres.
            generator: Source of randomness.
        """
        n, rank = config.size
        centre, scale = frame(anchor)
        primitives = config.make_primitives(grid, generator)
        position = normalise(anchor, centre, scale)
        context = DeformationContext(n, config.components, rank, position, kernel.scaled(1 / float(scale)))
        deformation = DEFORMATIONS[config.deformation].initial(context, generator=generator)
        return cls(config, grid, centre, scale, primitives, deformation)

    @classmethod
    def restore(cls, grid: AngularGrid, tensors: dict[str, Tensor], header: Header) -> DeformableGaussians:
        """Return the Gaussians of a state dictionary and its header.

        Raises:
            InputError: Tensors and header do not match. No memory is allocated for sizes that only the header claims.
        """
        config = ModelConfig(**{**header["config"], "components": tuple(header["config"]["components"])})
        n, _ = config.size
        shapes = {"mean": (n, 2), "cholesky": (n, 3), "attenuation": (n,), "response": (n, 2), "floor": (2,)}
        expect(tensors, {"centre": (3,), "scale": ()} | {f"primitives.{name}": s for name, s in shapes.items()})
        if not float(tensors["scale"]) > 0:
            raise InputError(f"scale is {float(tensors['scale'])}, expected metres above 0")
        primitives = config.make_primitives(grid, torch.Generator())
        own = {name.removeprefix("deformation."): t for name, t in tensors.items() if name.startswith("deformation.")}
        deformation = DEFORMATIONS[config.deformation].restore(config.components, header, own)
        field = cls(config, grid, tensors["centre"], tensors["scale"], primitives, deformation)
        field.load_state_dict(tensors)
        return field

    @property
    def shapes_deform(self) -> bool:
        """True if means or widths depend on the position, so that kernels differ between positions."""
        return self.config.deformation != "none" and not {"mean", "cholesky"}.isdisjoint(self.config.components)

    def normalise(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] in the frame of the training positions, float32; differentiable.

        The bounding box of the training positions is centred in [-1, 1]^3, with one scale for all axes. The difference from
        the centre is taken in float64, so that map coordinates in kilometres keep their millimetres.
        """
        return normalise(position, self.centre, self.scale)

    def gaussians(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Gaussians:
        """Return the primitives at normalised positions (B, 3).

        Args:
            position: Normalised positions.
            deform: False returns the canonical primitives (the paper's coarse stage).
            stop_mean: Detach the canonical means (the paper's fine stage).
        """
        canonical: Gaussians = self.primitives()
        if stop_mean:
            canonical = canonical._replace(mean=canonical.mean.detach())
        if not deform:
            return canonical
        offsets: Offsets = self.deformation(position, canonical.mean)
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

    def render(self, gaussians: Gaussians, n: int, grid: AngularGrid) -> Tensor:
        """Return magnitudes (n, H, W) of primitives at n positions."""
        mean = gaussians.mean.expand(n, -1, -1)
        weight = gaussians.weight.expand(n, -1, -1)
        return rasterize_magnitude(mean, gaussians.cholesky, weight, grid, cutoff=self.config.cutoff)

    def forward(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Tensor:
        """Return magnitudes (B, H, W) at normalised positions (B, 3); differentiable."""
        return self.render(self.gaussians(position, deform=deform, stop_mean=stop_mean), len(position), self.grid)

    def kernels(self, grid: AngularGrid) -> Tensor:
        """Return the kernels (N, H, W) of the canonical primitives on a grid."""
        canonical = self.primitives()
        return kernels(canonical.mean, canonical.cholesky, grid, self.config.cutoff)

    def spread(self, grid: AngularGrid) -> Tensor:
        """Return the prior standard deviation (H, W) of the real part that the deformed responses give each direction."""
        kernel = self.kernels(grid)
        variance = torch.zeros(grid.shape, device=kernel.device)
        for weight in self._component_weight().split(64):
            variance = variance + torch.tensordot(weight, kernel, dims=1).square().sum(dim=0)
        return variance.sqrt()

    def projection(self, grid: AngularGrid) -> Tensor:
        """Return the mean spectrum, then the spectra whose inner products with a change are the scores, (1 + K, H, W)."""
        kernel, canonical = self.kernels(grid).flatten(1), self.primitives()
        component = (self._component_weight() @ kernel).double()
        dual = torch.linalg.pinv(component @ component.T, hermitian=True) @ component
        projection = torch.cat([(canonical.weight[:, 0] @ kernel)[None], dual.float()])
        whole: Tensor = projection.unflatten(1, grid.shape)
        return whole

    def _component_weight(self) -> Tensor:
        """Return the weights (K, N) of the primitives in each component of a regression."""
        response = Offsets.of(torch.as_tensor(self.deformation.basis), self.config.components).response
        assert response is not None  # a regression deforms responses
        weight: Tensor = self.primitives().attenuation * response[..., 0]
        return weight
