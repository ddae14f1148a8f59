"""WRF-GS: 3D Gaussians around the array whose signals a network gives, drawn on its sphere.

C. Wen, J. Tong, Y. Hu, Z. Lin and J. Zhang, "WRF-GS: Wireless Radiation Field Reconstruction with 3D Gaussian Splatting",
2024. `WrfGsConfig.paper()` has what its code has: 20,000 Gaussians with means drawn from N(0, (10 m)^2) that stay where they
are, and opacity 0.1; a network of 8 x 128 from the Gaussian's mean and the transmitter to one amplitude; one path loss;
0.8 L1 + 0.2 (1 - SSIM); 600,000 steps, the network's rate of 8e-4 decaying over 200,000; Gaussians grow in number from step
500 to 15,000. Initial scales, the rates of shapes and how Gaussians grow are those of B. Kerbl, G. Kopanas, T. Leimkuehler
and G. Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023.

Changed everywhere: spectra are sums of the projected Gaussians, not blended from front to back, so that
`swiftwrf.rasterize` draws them on any device; azimuth wraps; Gaussians lie about the centre of the training positions, those
behind the array are folded up, and the array moves among them where the receiver moves (its position then stands for the
transmitter's). Encodings (10 bands), the SSIM's window (7 x 7) and how the rates decay (along a cosine to 2 %, those of the
shapes, too) are not published and ours.

Changed in the quick preset, sized for two cores: 500 Gaussians (20,000) that stay as many, 6 bands, 8 spectra a step (1) at
90 azimuths (all), 2,000 steps (600,000) at rate 3e-3 (8e-4), averaged parameters (the last), gradients clipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Size, Training
from swiftwrf.comparison.drawing import Link, LinkDrawing, draw_parameters
from swiftwrf.comparison.layers import Layers
from swiftwrf.comparison.sphere import on_sphere
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.models.swiftwrf.encoding import encode
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.models.swiftwrf.primitives import FLOOR
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.runtime.session import State

FIRST_OPACITY = 0.1
SSIM_WEIGHT = 0.2
CUTOFF = 1e-4
NEAREST = 1e-3  # [m] between a Gaussian and the array
# how Gaussians grow in number: in these steps
GROW_FROM, GROW_UNTIL, GROW_EVERY, RESET_EVERY = 500, 15_000, 100, 3_000
PULL = 2e-4  # mean gradient from which one is doubled
DENSE = 0.01  # of the spread: smaller ones are cloned, larger ones split
SPLIT = 1.6  # by which the two are smaller
LEAST_OPACITY, RESET_OPACITY = 0.005, 0.01


@dataclass(frozen=True)
class WrfGsSize(Size):
    """Of the Gaussians and their network."""

    n_gaussians: int = 500
    """at the start"""
    spread: float = 10.0
    """standard deviation of their means [m]"""
    width: int = 128
    """of the network's layers"""
    depth: int = 8
    """their number"""
    bands: int = 6
    """frequencies of the encodings"""


@dataclass(frozen=True)
class WrfGsConfig(Config[WrfGsSize, "WrfGs"]):
    """How WRF-GS is fitted."""

    size: WrfGsSize = WrfGsSize()
    steps: int = 2000
    batch: int = 8
    rate: float = 3e-3
    scale_rate: float = 5e-3
    """learning rate of logarithms of scales"""
    rotation_rate: float = 1e-3
    """of quaternions"""
    opacity_rate: float = 5e-2
    """of opacities before the sigmoid"""
    max_azimuths: int = 90
    """spectra with more columns are averaged down to at most this many for fitting; 0 fits all pixels"""
    grows: bool = False
    """Gaussians are cloned, split and removed"""

    @classmethod
    def paper(cls, **changes: Any) -> WrfGsConfig:
        paper = cls(
            size=WrfGsSize(n_gaussians=20_000, bands=10),
            steps=600_000,
            batch=1,
            rate=8e-4,
            warm_up=1,
            decay_steps=200_000,
            averaging=0.0,
            clip=math.inf,
            max_azimuths=0,
            grows=True,
            check_every=1000,
        )
        return replace(paper, **changes)

    def training(self, train: Spectra, device: torch.device) -> WrfGsTraining:
        return WrfGsTraining(self, train, device)


class WrfGs(LinkDrawing):
    """Magnitude of the sum of 3D Gaussians, projected onto the sphere of directions.

    Args:
        size, grid, moving: see `LinkDrawing`.
    """

    kind: ClassVar[str] = "wrf-gs model"
    size_type = WrfGsSize

    def __init__(self, size: WrfGsSize, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid, moving)
        n, inputs = size.n_gaussians, 2 * 3 * (2 * size.bands + 1)
        self.network, self.signal = Layers(inputs, size.width, size.depth), nn.Linear(size.width, 1)
        self.register_buffer("mean", torch.zeros(n, 3))
        self.register_buffer("blur", torch.ones(2))
        self.log_scale = nn.Parameter(torch.zeros(n, 3))
        self.quaternion = nn.Parameter(torch.zeros(n, 4))
        self.opacity = nn.Parameter(torch.zeros(n))
        self.path_loss = nn.Parameter(torch.ones(()))

    mean: Tensor
    blur: Tensor

    @classmethod
    def make(cls, size: WrfGsSize, train: Spectra, generator: torch.Generator) -> WrfGs:
        """At its start.

        Args:
            size: of the model.
            train: spectra in the resolution in which they are fitted.
            generator: for means and network.

        Raises:
            InputError: the data do not say where the fixed end stands.
        """
        model = cls(size, train.grid, train.moving)
        model.link = Link.of(train)
        draw_parameters(model, generator)
        model.mean = size.spread * torch.randn(size.n_gaussians, 3, generator=generator)
        model.blur = FLOOR * torch.tensor([train.grid.azimuth_step, train.grid.elevation_step])
        with torch.no_grad():
            model.log_scale.copy_(_spacing(model.mean).log()[:, None])
            model.quaternion[:, 3] = 1
            model.opacity.fill_(math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)))
        return model

    def project(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Means (P or 1, N, 2) and Cholesky factors (P, N, 3) or (N, 3) [rad], the moving end at positions (P, 3) [m]."""
        _, receiver = self.link(position)
        to_array = self.link.rotation.float()  # of rows, from the right
        local = (self.mean - receiver[:, None]) @ to_array
        away = local.norm(dim=-1, keepdim=True)
        local = torch.where(away > NEAREST, local, local.new_tensor([0.0, 0.0, NEAREST]))
        factor = to_array.T @ _rotations(self.quaternion) * self.log_scale.exp()[:, None, :]
        mean, cholesky = on_sphere(local, factor, self.blur)
        return mean, cholesky[0] if len(receiver) == 1 else cholesky

    def weight(self, position: Tensor) -> Tensor:
        """Real amplitude of each Gaussian, (P, N, 2) with an imaginary part of 0, at positions (P, 3) [m]."""
        transmitter, receiver = self.link(position)
        end = transmitter if self.link.moving == "transmitter" else receiver
        of_mean = encode(self.mean / self.size.spread, self.size.bands, lowest=1.0)
        of_end = encode(end, self.size.bands, lowest=1.0)
        x = torch.cat(torch.broadcast_tensors(of_mean, of_end[:, None]), dim=-1)
        amplitude = self.path_loss * torch.sigmoid(self.opacity) * self.signal(self.network(x))[..., 0].abs()
        return torch.stack([amplitude, torch.zeros_like(amplitude)], dim=-1)

    def draw(self, position: Tensor, mean: Tensor, cholesky: Tensor, grid: AngularGrid) -> Tensor:
        """Magnitudes (P, H, W) of projected Gaussians."""
        weight = self.weight(position)
        return rasterize_magnitude(mean.expand_as(weight), cholesky, weight, grid, cutoff=CUTOFF)

    def synthesize(self, position: Tensor, grid: AngularGrid | None = None, batch: int = 16) -> Tensor:
        """Spectra at any positions; arguments, result and errors as of `SwiftWRF.synthesize`."""
        grid = grid or self.grid
        return self.drawn(position, grid, batch, lambda some: self.draw(some, *self.project(some), grid))


def _spacing(mean: Tensor) -> Tensor:
    """Root mean square distance of each of the points (N, 3) from its three neighbours, (N,)."""
    apart, _ = KDTree(mean.numpy()).query(mean.numpy(), k=4)
    return torch.from_numpy(apart[:, 1:]).square().mean(dim=1).sqrt().clamp_min(NEAREST).float()


def _rotations(quaternion: Tensor) -> Tensor:
    """Matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) of any length but 0."""
    x, y, z, w = functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], dim=-1),
        torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], dim=-1),
        torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


class WrfGsTraining(Training[WrfGsConfig, WrfGs]):
    """Of the Gaussians' shapes and opacities and of the network; Gaussians that the loss pulls at are doubled, and those
    that are hardly seen are removed (B. Kerbl et al., section 5.2)."""

    SHAPES = ("log_scale", "quaternion", "opacity")  # in the order of the optimiser's first groups

    def __init__(self, config: WrfGsConfig, train: Spectra, device: torch.device) -> None:
        work = train.at_most(config.max_azimuths)
        model = WrfGs.make(config.size, work, torch.Generator().manual_seed(config.seed)).to(device)
        model.grid = train.grid
        rates = (config.scale_rate, config.rotation_rate, config.opacity_rate)
        groups = [{"params": [getattr(model, n)], "peak": r} for n, r in zip(self.SHAPES, rates, strict=True)]
        network = [*model.network.parameters(), *model.signal.parameters(), model.path_loss]
        super().__init__(config, model, [*groups, {"params": network, "peak": config.rate}], betas=(0.9, 0.999))
        self.position, self.spectrum, self.grid = work.position, work.spectrum.to(device), work.grid
        self.pull = torch.zeros(len(model.mean), device=device)

    def rate(self, step: int) -> float:
        return super().rate(min(step, self.config.decay_steps or step))  # stays low once it has decayed

    def objective(self) -> Tensor:
        row = torch.randint(len(self.position), (self.config.batch,), generator=self.generator())
        position = self.position[row]
        mean, cholesky = self.model.project(position)
        self.projected = mean.requires_grad_(self.config.grows)
        drawn = self.model.draw(position, mean, cholesky, self.grid)
        return spectrum_loss(drawn, self.spectrum[row.to(drawn.device)], SSIM_WEIGHT)

    def advance(self) -> Tensor:
        loss = super().advance()
        if self.config.grows and self.step <= GROW_UNTIL:
            assert self.projected.grad is not None
            # as of an image that spans [-1, 1] in both directions, which the threshold was chosen for
            pull = self.projected.grad * self.projected.new_tensor([math.pi, math.pi / 4])
            self.pull += pull.norm(dim=-1).sum(dim=0) / GROW_EVERY
            if self.step % GROW_EVERY == 0:
                if self.step > GROW_FROM:
                    self._grow()
                self.pull.zero_()
            if self.step % RESET_EVERY == 0:
                with torch.no_grad():
                    self.model.opacity.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        return loss

    @torch.no_grad()
    def _grow(self) -> None:
        model = self.model
        pulled, seen = self.pull > PULL, torch.sigmoid(model.opacity) > LEAST_OPACITY
        large = model.log_scale.max(dim=1).values > math.log(DENSE * model.size.spread)
        stay = (seen & ~(pulled & large)).nonzero()[:, 0]
        clone = (seen & pulled & ~large).nonzero()[:, 0]
        split = (seen & pulled & large).nonzero()[:, 0].repeat(2)
        offset = torch.randn(len(split), 3, generator=self.generator()).to(split.device) * model.log_scale[split].exp()
        offset = (_rotations(model.quaternion[split]) @ offset[..., None])[..., 0]
        self._take(torch.cat([stay, clone, split]), n_old=len(stay))
        if len(split):
            model.mean[-len(split) :] += offset
            model.log_scale[-len(split) :] -= math.log(SPLIT)
        self.average = self.averaged()

    @torch.no_grad()
    def _take(self, row: Tensor, n_old: int) -> None:
        """The Gaussians become those of these rows; only of the first `n_old` does Adam remember anything."""
        model, fresh = self.model, torch.arange(len(row), device=row.device) >= n_old
        model.mean = model.mean[row]
        for name, group in zip(self.SHAPES, self.optimiser.param_groups, strict=False):
            (old,) = group["params"]
            new = nn.Parameter(old[row])
            if old in self.optimiser.state:
                state = self.optimiser.state.pop(old)
                moments = {key: state[key][row] for key in ("exp_avg", "exp_avg_sq")}
                for moment in moments.values():
                    moment[fresh] = 0
                self.optimiser.state[new] = state | moments
            group["params"] = [new]
            setattr(model, name, new)
        model.size = replace(model.size, n_gaussians=len(row))
        self.pull = self.pull.new_zeros(len(row))

    def _restore(self, saved: State) -> None:
        n = len(saved.tensors["model.mean"])
        self._take(torch.zeros(n, dtype=torch.int64, device=self.pull.device), n_old=0)
        self.average = self.averaged()
        super()._restore(saved)
