"""SwiftWRF: primitives that move with the position, drawn as a spectrum."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import ClassVar, Literal, NamedTuple, overload

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel
from swiftwrf.models.swiftwrf.config import ModelConfig
from swiftwrf.models.swiftwrf.deformation import Deformation, Offsets, Setting, deformation_type
from swiftwrf.models.swiftwrf.primitives import Gaussians, Primitives
from swiftwrf.positions import check_batch, check_drawn, check_positions, frame, normalise
from swiftwrf.rasterize import rasterize, rasterize_magnitude
from swiftwrf.rasterize.reference import kernels
from swiftwrf.runtime.checkpoint import Header, Saved, expect

MANY = 16  # spectra from which on a product of matrices is faster than drawing each
MOST_VALUES = 2**26  # of the kernels on a grid: 256 MiB


class Canvas(NamedTuple):
    """What all spectra that a model draws on a grid have in common; see `SwiftWRF.canvas`.

    Args:
        grid: directions that are drawn.
        kernel: of primitives that stay where they are, (N, H, W); None where some move or there are too many.
        variation: standard deviation of all spectra, (H, W); None where the model knows none.
    """

    grid: AngularGrid
    kernel: Tensor | None
    variation: Tensor | None


class SwiftWRF(nn.Module, Saved):
    """Spectrum at any position: |sum_n psi_n delta_n kernel_n|, with parameters deformed by the position.

    Args:
        config: what it consists of.
        grid: the grid that it is fitted on and that `synthesize` draws unless told otherwise.
        centre, scale: of the frame in which positions are normalised, float64 (3,) and () [m].
        primitives: canonical ones.
        deformation: how they move.
    """

    kind: ClassVar[str] = "swiftwrf model"

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

    centre: Tensor
    scale: Tensor

    @classmethod
    def make(
        cls, config: ModelConfig, grid: AngularGrid, anchor: Tensor, kernel: Kernel, *, generator: torch.Generator
    ) -> SwiftWRF:
        """A model at its start.

        Args:
            config, grid: see the class.
            anchor: positions (M, 3) [m] of training spectra; they give the frame in which positions are normalised and
                the anchors of the motion.
            kernel: of the motion's prior, with lengths [m].
            generator: for the initial parameters.
        """
        n, rank = config.size
        centre, scale = frame(anchor)
        primitives = config.make_primitives(grid, generator)
        position = normalise(anchor, centre, scale)
        setting = Setting(n, config.components, rank, position, kernel.scaled(1 / float(scale)))
        deformation = deformation_type(config.deformation).initial(setting, generator=generator)
        return cls(config, grid, centre, scale, primitives, deformation)

    def normalise(self, position: Tensor) -> Tensor:
        """Positions (n, 3) [m] in the training positions' frame, float32: their box is centred in [-1, 1]^3 and scaled
        alike on all axes. In float64 first, so that coordinates in kilometres keep their millimetres."""
        return normalise(position, self.centre, self.scale)

    def gaussians(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Gaussians:
        """The primitives at normalised positions (B, 3).

        Args:
            deform: False leaves them canonical (the coarse stage).
            stop_mean: no gradient reaches the canonical means (the paper's fine stage).
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

    def draw(self, gaussians: Gaussians, n: int, grid: AngularGrid) -> Tensor:
        """Magnitudes (n, H, W) of primitives at n positions."""
        mean = gaussians.mean.expand(n, -1, -1)
        weight = gaussians.weight.expand(n, -1, -1)
        return rasterize_magnitude(mean, gaussians.cholesky, weight, grid, cutoff=self.config.cutoff)

    def forward(self, position: Tensor, *, deform: bool = True, stop_mean: bool = False) -> Tensor:
        """Magnitudes (B, H, W) at normalised positions (B, 3), on the model's grid, differentiable."""
        return self.draw(self.gaussians(position, deform=deform, stop_mean=stop_mean), len(position), self.grid)

    @overload
    def synthesize(self, position: Tensor, grid: AngularGrid | Canvas | None = None, batch: int = 64) -> Tensor: ...

    @overload
    def synthesize(
        self, position: Tensor, grid: AngularGrid | Canvas | None = None, batch: int = 64, *, return_std: Literal[True]
    ) -> tuple[Tensor, Tensor]: ...

    @torch.no_grad()
    def synthesize(
        self, position: Tensor, grid: AngularGrid | Canvas | None = None, batch: int = 64, *, return_std: bool = False
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Spectra at any positions.

        Args:
            position: of the moving end [m], (n, 3).
            grid: directions to draw; the model's own unless given. Any resolution will do. Who draws few spectra at a
                time, but often, gives a `canvas`.
            batch: spectra drawn at a time, which bounds the memory.
            return_std: also by how much a measured spectrum is expected to differ, from the Gaussian process behind the
                motion, calibrated on held-out training spectra: 80 % of all pixels lie within 1.28 of it.

        Returns:
            Magnitudes clipped to [0, 1], float32 (n, n_elevation, n_azimuth), on the CPU; with `return_std` also their
            standard deviations, of the same shape.

        Raises:
            InputError: positions of another shape, or not finite; a batch below 1; standard deviations of a model that was
                fitted by gradient.
        """
        position = check_positions(position)
        check_batch(batch)
        if isinstance(grid, Canvas):
            grid, kernel, variation = grid
        else:
            grid = grid or self.grid
            kernel = self._fixed_kernels(grid) if len(position) >= MANY else None
            variation = None
        if return_std and variation is None:
            variation = self._variation(grid)  # refuses where there is none
        spectrum = torch.empty(len(position), *grid.shape)
        std = torch.empty_like(spectrum) if return_std else None
        for start in range(0, len(position), batch):
            x = self.normalise(position[start : start + batch].to(self.centre.device))
            gaussians = self.gaussians(x)
            drawn = self.draw(gaussians, len(x), grid) if kernel is None else _product(gaussians.weight, kernel)
            spectrum[start : start + batch] = drawn.clamp(0, 1)
            if std is not None and variation is not None and (doubt := self.deformation.doubt(x)) is not None:
                std[start : start + batch] = doubt[:, None, None] * variation
        spectrum = check_drawn(spectrum)
        return spectrum if std is None else (spectrum, check_drawn(std))

    @torch.no_grad()
    def canvas(self, grid: AngularGrid | None = None) -> Canvas:
        """What does not depend on the position, computed once for all spectra to come: `synthesize` on a canvas draws a
        single spectrum as fast as one of many. It holds as long as the parameters stay as they are.

        Args:
            grid: directions to draw; the model's own unless given.
        """
        grid = grid or self.grid
        return Canvas(grid, self._fixed_kernels(grid), self._variation(grid) if self.knows_deviation else None)

    def _fixed_kernels(self, grid: AngularGrid) -> Tensor | None:
        """Kernels (N, H, W) of primitives that stay where they are, so that many spectra are one matrix product; None where
        some move or there are too many."""
        moving = {"mean", "cholesky"} & set(self.config.components) and self.config.deformation != "none"
        if moving or len(self.primitives) * math.prod(grid.shape) > MOST_VALUES:
            return None
        canonical = self.primitives()
        return kernels(canonical.mean, canonical.cholesky, grid, self.config.cutoff)

    @property
    def knows_deviation(self) -> bool:
        """Whether `synthesize` can tell standard deviations."""
        return self.deformation.doubt(self.centre.new_zeros(1, 3).float()) is not None

    def _variation(self, grid: AngularGrid) -> Tensor:
        """Standard deviation of all spectra, as far as motions of the responses draw it, (H, W)."""
        if not self.knows_deviation:
            raise InputError("this model knows no standard deviations; only one that was fitted by regression does")
        canonical = self.primitives()
        basis = torch.as_tensor(self.deformation.basis)  # only motions have doubt
        moved = Offsets.of(basis, self.config.components).response
        variance = torch.zeros(grid.shape, device=self.centre.device)
        assert moved is not None
        for motion in (canonical.attenuation[..., None] * moved).split(64):
            mean = canonical.mean.expand(len(motion), -1, -1)
            part = rasterize(mean, canonical.cholesky, motion, grid, cutoff=self.config.cutoff)
            variance += part[:, 0].square().sum(dim=0)
        return variance.sqrt()

    def state(self) -> tuple[dict[str, Tensor], Header]:
        header = {"config": asdict(self.config), "grid": asdict(self.grid)}
        return self.state_dict(), header | self.deformation.header()

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> SwiftWRF:
        config = ModelConfig(**{**header["config"], "components": tuple(header["config"]["components"])})
        grid = AngularGrid(**header["grid"])
        config.check()
        n, _ = config.size
        own_shapes = {"mean": (n, 2), "cholesky": (n, 3), "attenuation": (n,), "response": (n, 2), "floor": (2,)}
        expect(tensors, {"centre": (3,), "scale": ()} | {f"primitives.{name}": s for name, s in own_shapes.items()})
        if not float(tensors["scale"]) > 0:
            raise InputError(f"scale is {float(tensors['scale'])}, expected metres above 0")
        primitives = config.make_primitives(grid, torch.Generator())
        own = {name.removeprefix("deformation."): t for name, t in tensors.items() if name.startswith("deformation.")}
        deformation = deformation_type(config.deformation).restore(config.components, header, own)
        model = cls(config, grid, tensors["centre"], tensors["scale"], primitives, deformation)
        model.load_state_dict(tensors)
        return model.eval()


def _product(weight: Tensor, kernel: Tensor) -> Tensor:
    """|A| (B, H, W) from weights (B, N, 2), or (N, 2) for all."""
    real, imaginary = weight.unbind(-1)
    field: Tensor = torch.tensordot(real, kernel, dims=1)
    if imaginary.any():
        field = torch.hypot(field, torch.tensordot(imaginary, kernel, dims=1))
    return field.abs()
