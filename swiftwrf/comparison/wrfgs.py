"""WRF-GS: 3D Gaussians around the array whose signals a network predicts, projected onto the sphere of directions.

C. Wen, J. Tong, Y. Hu, Z. Lin and J. Zhang, "WRF-GS: Wireless Radiation Field Reconstruction with 3D Gaussian Splatting",
2024. `WrfGsConfig.paper()` has the settings of its code: 20,000 Gaussians with fixed means from N(0, (10 m)^2) and opacity
0.1; a network of 8 x 128 from the Gaussian's mean and the transmitter to one amplitude; one path loss; 0.8 L1 + 0.2
(1 - SSIM); 600,000 steps, the network's rate of 8e-4 decaying over 200,000; densification from step 500 to 15,000. Initial
scales, the rates of shapes and densification are those of B. Kerbl, G. Kopanas, T. Leimkuehler and G. Drettakis, "3D
Gaussian Splatting for Real-Time Radiance Field Rendering", 2023.

Changed everywhere: spectra are sums of the projected Gaussians, not blended from front to back, so that
`swiftwrf.rasterize` renders them on any device. Azimuth wraps. Gaussians lie about the centre of the training positions, and
those behind the array are folded up. If the receiver moves, the array moves among the Gaussians, and its position takes the
transmitter's place. The encodings (10 bands), the SSIM's window (7 x 7) and the decay of the rates (along a cosine to 2 %,
those of the shapes, too) are not published and our choice.

Changed in the quick preset, sized for two cores: 500 Gaussians (20,000) without densification, 6 bands, 8 spectra a step (1)
at 90 azimuths (all), 2,000 steps (600,000) at rate 3e-3 (8e-4), averaged parameters (the last), clipped gradients.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.choices import Moving
from swiftwrf.comparison.base import Config, Count, Depth, TrainedModel, Training
from swiftwrf.comparison.network import LinkNetwork, draw_parameters
from swiftwrf.comparison.sphere import on_sphere
from swiftwrf.data.spectra import Spectra
from swiftwrf.metrics import spectrum_loss
from swiftwrf.models.base import FIXED_END
from swiftwrf.models.mlp import SkipMLP, encode
from swiftwrf.models.primitives import min_width
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.runtime.session import State
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, PositiveInt, configuration

FIRST_OPACITY = 0.1
SSIM_WEIGHT = 0.2
CUTOFF = 1e-4
MIN_DISTANCE_M = 1e-3  # between a Gaussian and the array
# densification: steps at which Gaussians are doubled and removed, and opacities reset
GROW_FROM, GROW_UNTIL, GROW_EVERY, RESET_EVERY = 500, 15_000, 100, 3_000
MIN_PULL = 2e-4  # mean gradient of the projected mean from which a Gaussian is doubled
MAX_CLONED = 0.01  # scale relative to the spread; smaller Gaussians are cloned, larger ones split
SPLIT_FACTOR = 1.6  # by which the scale of split Gaussians shrinks
MIN_OPACITY, RESET_OPACITY = 0.005, 0.01


@configuration
class WrfGsSize:
    """Size of the Gaussians and their network.

    Example:
        >>> WrfGsSize(n_gaussians=100).n_gaussians
        100
    """

    n_gaussians: Count = 500
    """initial number of Gaussians"""
    spread: PositiveFloat = 10.0
    """standard deviation of their means [m]"""
    width: Count = 128
    """width of the network's layers"""
    depth: Depth = 8
    """number of the network's layers"""
    bands: Count = 6
    """frequencies of the encodings"""


@configuration
class WrfGsConfig(Config):
    """Options of `WrfGs`.

    Example:
        >>> WrfGs(WrfGsConfig(size=WrfGsSize(n_gaussians=100))).config.size.n_gaussians
        100
    """

    size: WrfGsSize = WrfGsSize()
    steps: PositiveInt = 2000
    batch: PositiveInt = 8
    rate: PositiveFloat = 3e-3
    scale_rate: PositiveFloat = 5e-3
    """learning rate of logarithms of scales"""
    rotation_rate: PositiveFloat = 1e-3
    """learning rate of quaternions"""
    opacity_rate: PositiveFloat = 5e-2
    """learning rate of opacities before the sigmoid"""
    max_azimuths: NonNegativeInt = 90
    """fit to spectra averaged down to at most this number of columns; 0 fits to all pixels"""
    grows: bool = False
    """clone, split and remove Gaussians (densification)"""

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


class WrfGsNetwork(LinkNetwork):
    """Magnitude of the sum of 3D Gaussians, projected onto the sphere of directions."""

    mean: Tensor
    blur: Tensor

    def __init__(self, size: WrfGsSize, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid, moving)
        n, inputs = size.n_gaussians, 2 * 3 * (2 * size.bands + 1)
        self.network, self.signal = SkipMLP(inputs, size.width, size.depth), nn.Linear(size.width, 1)
        self.register_buffer("mean", torch.zeros(n, 3))
        self.register_buffer("blur", torch.ones(2))
        self.log_scale = nn.Parameter(torch.zeros(n, 3))
        self.quaternion = nn.Parameter(torch.zeros(n, 4))
        self.opacity = nn.Parameter(torch.zeros(n))
        self.path_loss = nn.Parameter(torch.ones(()))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw means and network from the generator, and set shapes and opacities."""
        draw_parameters(self, generator)
        self.mean = self.size.spread * torch.randn(self.size.n_gaussians, 3, generator=generator)
        self.blur = min_width(self.grid)
        with torch.no_grad():
            self.log_scale.copy_(_spacing(self.mean).log()[:, None])
            self.quaternion[:, 3] = 1
            self.opacity.fill_(math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)))

    def project(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (P or 1, N, 2) and Cholesky factors (P, N, 3) or (N, 3) [rad] for positions (P, 3) [m]."""
        _, receiver = self.link(position)
        to_array = self.link.rotation.float()  # of rows, from the right
        local = (self.mean - receiver[:, None]) @ to_array
        far = local.norm(dim=-1, keepdim=True) > MIN_DISTANCE_M
        local = torch.where(far, local, local.new_tensor([0.0, 0.0, MIN_DISTANCE_M]))
        factor = to_array.T @ _rotations(self.quaternion) * self.log_scale.exp()[:, None, :]
        mean, cholesky = on_sphere(local, factor, self.blur)
        return mean, cholesky[0] if len(receiver) == 1 else cholesky

    def weight(self, position: Tensor) -> Tensor:
        """Return the amplitudes (P, N, 2) of the Gaussians, with imaginary part 0, for positions (P, 3) [m]."""
        transmitter, receiver = self.link(position)
        end = transmitter if self.link.moving == "transmitter" else receiver
        of_mean = encode(self.mean / self.size.spread, self.size.bands, lowest=1.0)
        of_end = encode(end, self.size.bands, lowest=1.0)
        x = torch.cat(torch.broadcast_tensors(of_mean, of_end[:, None]), dim=-1)
        amplitude = self.path_loss * torch.sigmoid(self.opacity) * self.signal(self.network(x))[..., 0].abs()
        return torch.stack([amplitude, torch.zeros_like(amplitude)], dim=-1)

    def rasterize(self, position: Tensor, mean: Tensor, cholesky: Tensor, grid: AngularGrid) -> Tensor:
        """Return magnitudes (P, H, W) of projected Gaussians."""
        weight = self.weight(position)
        return rasterize_magnitude(mean.expand_as(weight), cholesky, weight, grid, cutoff=CUTOFF)

    def render(self, position: Tensor, grid: AngularGrid, generator: torch.Generator | None = None) -> Tensor:
        return self.rasterize(position, *self.project(position), grid)


def _spacing(mean: Tensor) -> Tensor:
    """Return the root mean square distance of each of the points (N, 3) from its three neighbours, (N,)."""
    distance, _ = KDTree(mean.numpy()).query(mean.numpy(), k=4)
    return torch.from_numpy(distance[:, 1:]).square().mean(dim=1).sqrt().clamp_min(MIN_DISTANCE_M).float()


def _rotations(quaternion: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) of any length but 0."""
    x, y, z, w = functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], dim=-1),
        torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], dim=-1),
        torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


class WrfGsTraining(Training[WrfGsConfig, WrfGsNetwork]):
    """Training of shapes, opacities and network.

    Densification doubles Gaussians with a large gradient and removes those of low opacity (B. Kerbl et al., section 5.2).
    """

    SHAPES = ("log_scale", "quaternion", "opacity")  # in the order of the optimiser's first groups

    def __init__(self, config: WrfGsConfig, train: Spectra, device: torch.device) -> None:
        work = train.at_most(config.max_azimuths)
        model = WrfGsNetwork.of(config.size, work)
        model.initialise(torch.Generator().manual_seed(config.seed))
        model = model.to(device)
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
        predicted = self.model.rasterize(position, mean, cholesky, self.grid)
        return spectrum_loss(predicted, self.spectrum[row.to(predicted.device)], SSIM_WEIGHT)

    def advance(self) -> Tensor:
        loss = super().advance()
        if self.config.grows and self.step <= GROW_UNTIL:
            assert self.projected.grad is not None
            # in units of an image that spans [-1, 1] in both directions, for which the threshold was chosen
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
        pulled, visible = self.pull > MIN_PULL, torch.sigmoid(model.opacity) > MIN_OPACITY
        large = model.log_scale.max(dim=1).values > math.log(MAX_CLONED * model.size.spread)
        stay = (visible & ~(pulled & large)).nonzero()[:, 0]
        clone = (visible & pulled & ~large).nonzero()[:, 0]
        split = (visible & pulled & large).nonzero()[:, 0].repeat(2)
        offset = torch.randn(len(split), 3, generator=self.generator()).to(split.device) * model.log_scale[split].exp()
        offset = (_rotations(model.quaternion[split]) @ offset[..., None])[..., 0]
        self._take(torch.cat([stay, clone, split]), n_old=len(stay))
        if len(split):
            model.mean[-len(split) :] += offset
            model.log_scale[-len(split) :] -= math.log(SPLIT_FACTOR)
        self.average = self.averaged()

    @torch.no_grad()
    def _take(self, row: Tensor, n_old: int) -> None:
        """Replace the Gaussians by these rows; the moments of Adam are kept for the first `n_old` only."""
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


class WrfGs(TrainedModel):
    """3D Gaussian splatting with amplitudes by a network.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> WrfGs(size=WrfGsSize(n_gaussians=20), steps=1).fit(room).predict(room.position).mean.shape
        torch.Size([20, 30, 120])
    """

    name = "wrfgs"
    kind = "wrf-gs model"
    config_type = WrfGsConfig
    network_type = WrfGsNetwork
    requires = (FIXED_END,)
    any_grid = True
    batch = 16
