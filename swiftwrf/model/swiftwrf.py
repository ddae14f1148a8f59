"""SwiftWRF: primitives that move with the position, drawn as a spectrum."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from swiftwrf.angles import AngularGrid
from swiftwrf.checkpoint import Header, Saved, expect
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel
from swiftwrf.model.deformation import COMPONENTS, Deformation, Offsets, Setting, deformation_type
from swiftwrf.model.primitives import Gaussians, Primitives
from swiftwrf.positions import check_batch, check_drawn, check_positions
from swiftwrf.rasterize import rasterize_magnitude

FARTHEST = 1e6  # normalised: beyond, all is equally far, and float32 must not overflow


@dataclass(frozen=True)
class ModelConfig:
    """What a SwiftWRF model consists of."""

    n_primitives: int | Literal["auto"] = "auto"
    """number N of primitives; auto lets the fit find how many the scene needs"""
    deformation: str = "motion_basis"
    """how they move: a name of `swiftwrf.model.deformation.DEFORMATIONS`"""
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
        low, high = anchor.min(dim=0).values, anchor.max(dim=0).values
        scale = float((high - low).max()) / 2 or 1.0
        frame = ((low + high) / 2).double(), torch.tensor(scale, dtype=torch.float64)
        primitives = config.make_primitives(grid, generator)
        setting = Setting(n, config.components, rank, _normalise(anchor, *frame), kernel.scaled(1 / scale))
        deformation = deformation_type(config.deformation).initial(setting, generator=generator)
        return cls(config, grid, *frame, primitives, deformation)

    def normalise(self, position: Tensor) -> Tensor:
        """Positions (n, 3) [m] in the training positions' frame, float32: their box is centred in [-1, 1]^3 and scaled
        alike on all axes. In float64 first, so that coordinates in kilometres keep their millimetres."""
        return _normalise(position, self.centre, self.scale)

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
            InputError: positions of another shape, or not finite; a batch below 1.
        """
        position = check_positions(position)
        check_batch(batch)
        grid = grid or self.grid
        spectrum = torch.empty(len(position), *grid.shape)
        for start in range(0, len(position), batch):
            x = self.normalise(position[start : start + batch].to(self.centre.device))
            spectrum[start : start + batch] = self.draw(self.gaussians(x), len(x), grid).clamp(0, 1)
        return check_drawn(spectrum)

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


def _normalise(position: Tensor, centre: Tensor, scale: Tensor) -> Tensor:
    return ((position.double() - centre) / scale).clamp(-FARTHEST, FARTHEST).float()
