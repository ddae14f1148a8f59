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

The projection is of first order: the image of a Gaussian of covariance S under the map f from a point to its direction is
one of covariance J S J^T about f(mean), J = df (M. Zwicker, H. Pfister, J. van Baar and M. Gross, "EWA splatting", IEEE
TVCG 8(3), 2002, there for a camera). With rho = |(x, y)| and r = |(x, y, z)|

    d azimuth = (-y, x, 0) / rho^2,    d elevation = (-x |z|, -y |z|, sign(z) rho^2) / (rho r^2)

because a planar array cannot distinguish z from -z and folds the half space behind it. At the pole d azimuth diverges: a
Gaussian there is flat over all azimuths, which are one direction at an elevation of 90 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, cast

import torch
from annotated_types import Ge, Le
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid, to_angles
from swiftwrf.contrib.published.base import Config, Count, Depth, TrainedModel, Training
from swiftwrf.data.spectra import Spectra
from swiftwrf.metrics import spectrum_loss
from swiftwrf.models.base import FIXED_END
from swiftwrf.models.mlp import SkipMLP, draw_parameters, encode
from swiftwrf.models.primitives import MAX_WIDTH_RAD, min_width
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.runtime.checkpoint import Header
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, PositiveInt, configuration

SHAPES = ("log_scale", "quaternion", "opacity")  # of the Gaussians, in the order of the optimiser's first groups
FIRST_OPACITY = 0.1
MIN_DISTANCE_M = 1e-3  # between a Gaussian and the array
# densification: steps at which Gaussians are doubled and removed, and opacities reset
GROW_FROM, GROW_UNTIL, GROW_EVERY, RESET_EVERY = 500, 15_000, 100, 3_000
MIN_PULL = 2e-4  # mean gradient of the projected mean from which a Gaussian is doubled
MAX_CLONED = 0.01  # scale relative to the spread; smaller Gaussians are cloned, larger ones split
SPLIT_FACTOR = 1.6  # by which the scale of split Gaussians shrinks
MIN_OPACITY, RESET_OPACITY = 0.005, 0.01


@configuration
class WrfGsConfig(Config):
    """Options of `WrfGs`."""

    published: ClassVar[dict[str, Any]] = {
        "n_gaussians": 20_000,
        "bands": 10,
        "steps": 600_000,
        "batch": 1,
        "rate": 8e-4,
        "warm_up": 1,
        "decay_steps": 200_000,
        "averaging": 0.0,
        "clip": math.inf,
        "max_azimuths": 0,
        "grows": True,
        "check_every": 1000,
    }

    n_gaussians: Annotated[int, Ge(4), Le(2**24)] = 500
    """initial number of Gaussians, each of which is as wide as its three neighbours are far"""
    spread: PositiveFloat = 10.0
    """standard deviation of their means [m]"""
    width: Count = 128
    """width of the network's layers"""
    depth: Depth = 8
    """number of the network's layers"""
    bands: Count = 6
    """frequencies of the encodings"""
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


class WrfGs(TrainedModel):
    """3D Gaussian splatting with amplitudes by a network.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> WrfGs(n_gaussians=20, steps=1).fit(room).predict(room.position).mean.shape
        torch.Size([20, 30, 120])
    """

    name = "wrfgs"
    kind = "wrf-gs model"
    config_type = WrfGsConfig
    requires = (FIXED_END,)
    any_grid = True
    batch = 16

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> nn.ModuleDict:
        """Return the Gaussians, the network of their features and the layer of their amplitudes."""
        config = self.config
        n = config.n_gaussians if saved is None else len(saved["gaussians.mean"])  # densification changes the number
        gaussians = {
            "log_scale": nn.Parameter(torch.zeros(n, 3)),
            "quaternion": nn.Parameter(torch.zeros(n, 4)),
            "opacity": nn.Parameter(torch.zeros(n)),
            "path_loss": nn.Parameter(torch.ones(())),
            "mean": nn.Parameter(torch.zeros(n, 3), requires_grad=False),
            "blur": nn.Parameter(torch.ones(2), requires_grad=False),
        }
        features = SkipMLP(2 * 3 * (2 * config.bands + 1), config.width, config.depth)
        signal = nn.Linear(config.width, 1)
        return nn.ModuleDict({"gaussians": nn.ParameterDict(gaussians), "features": features, "signal": signal})

    def training(self, train: Spectra, device: torch.device) -> GaussianTraining:
        work = train.at_most(self.config.max_azimuths)
        network, generator = self.blank(), torch.Generator().manual_seed(self.config.seed)
        draw_parameters(network, generator)
        mean = self.config.spread * torch.randn(self.config.n_gaussians, 3, generator=generator)
        gaussians = _gaussians(network)
        with torch.no_grad():
            gaussians["mean"].copy_(mean)
            gaussians["blur"].copy_(min_width(work.grid))
            gaussians["log_scale"].copy_(_spacing(mean).log()[:, None])
            gaussians["quaternion"][:, 3] = 1
            gaussians["opacity"].fill_(math.log(FIRST_OPACITY / (1 - FIRST_OPACITY)))
        return GaussianTraining(self, network.to(device), work)

    def render(self, network: nn.ModuleDict, position: Tensor, grid: AngularGrid) -> Tensor:
        return self.rasterize(network, position, *self.project(network, position), grid)

    def project(self, network: nn.ModuleDict, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (P or 1, N, 2) and Cholesky factors (P, N, 3) or (N, 3) [rad] for positions (P, 3) [m]."""
        gaussians = _gaussians(network)
        _, receiver = self.ends(position, gaussians["mean"].device)
        to_array = self.rotation.to(receiver)  # of rows, from the right
        local = (gaussians["mean"] - receiver[:, None]) @ to_array
        far = local.norm(dim=-1, keepdim=True) > MIN_DISTANCE_M
        local = torch.where(far, local, local.new_tensor([0.0, 0.0, MIN_DISTANCE_M]))
        factor = to_array.T @ _rotations(gaussians["quaternion"]) * gaussians["log_scale"].exp()[:, None, :]
        mean, cholesky = on_sphere(local, factor, gaussians["blur"])
        return mean, cholesky[0] if len(receiver) == 1 else cholesky

    def rasterize(
        self, network: nn.ModuleDict, position: Tensor, mean: Tensor, cholesky: Tensor, grid: AngularGrid
    ) -> Tensor:
        """Return magnitudes (P, H, W) of projected Gaussians, whose network predicts amplitudes for positions (P, 3) [m]."""
        gaussians, bands = _gaussians(network), self.config.bands
        transmitter, receiver = self.ends(position, mean.device)
        end = transmitter if self.moving == "transmitter" else receiver
        of_mean = encode(gaussians["mean"] / self.config.spread, bands, lowest=1.0)
        of_end = encode(end, bands, lowest=1.0)
        x = torch.cat(torch.broadcast_tensors(of_mean, of_end[:, None]), dim=-1)
        signal = network["signal"](network["features"](x))[..., 0].abs()
        amplitude = gaussians["path_loss"] * torch.sigmoid(gaussians["opacity"]) * signal
        weight = torch.stack([amplitude, torch.zeros_like(amplitude)], dim=-1)
        return rasterize_magnitude(mean.expand_as(weight), cholesky, weight, grid)


def on_sphere(mean: Tensor, factor: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """Return means (..., N, 2) and Cholesky factors (..., N, 3) [rad] for `swiftwrf.rasterize`.

    Args:
        mean: Means of the Gaussians in array coordinates, relative to the array, (..., N, 3), not 0.
        factor: F with covariance F F^T in array coordinates, (N, 3, 3).
        blur: Standard deviations in azimuth and elevation [rad], (2,), that are added in quadrature, so that no Gaussian
            falls between pixels.
    """
    x, y, z = mean.unbind(-1)
    r, flat = mean.norm(dim=-1), torch.hypot(x, y)
    rho = torch.maximum(flat, 1e-6 * r)  # limits d azimuth near the axis
    cosine = torch.where(flat > 0, x / rho, torch.ones_like(x))  # at the pole the azimuth is arbitrary
    sine, up = y / rho, torch.where(z < 0, -1.0, 1.0)
    turn = torch.stack([-sine, cosine, torch.zeros_like(z)], dim=-1) / rho[..., None]
    rise = torch.stack([-cosine * z.abs(), -sine * z.abs(), up * flat], dim=-1) / r.square()[..., None]
    image = torch.einsum("...nak,nkl->...nal", torch.stack([turn, rise], dim=-2), factor)
    variance = image.square().sum(dim=-1) + blur.square()
    shrink = torch.rsqrt(1 + variance / MAX_WIDTH_RAD**2)  # limits the width, which would overflow
    l1 = variance[..., 0].sqrt() * shrink[..., 0]
    l2 = (image[..., 0, :] * image[..., 1, :]).sum(dim=-1) * shrink.prod(dim=-1) / l1
    # positive because of the blur, except for rounding
    l3 = (variance[..., 1] * shrink[..., 1].square() - l2.square()).clamp_min((blur[1] * 0.5).square()).sqrt()
    return torch.stack(to_angles(mean), dim=-1), torch.stack([l1, l2, l3], dim=-1)


def _gaussians(network: nn.ModuleDict) -> nn.ParameterDict:
    """Return the parameters of the Gaussians."""
    return cast(nn.ParameterDict, network["gaussians"])


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


class GaussianTraining(Training[nn.ModuleDict]):
    """Training of shapes, opacities and network.

    Densification doubles Gaussians with a large gradient and removes those of low opacity (B. Kerbl et al., section 5.2).
    The network is initialised, on its device.
    """

    def __init__(self, owner: WrfGs, network: nn.ModuleDict, train: Spectra) -> None:
        config, self.gaussians = owner.config, _gaussians(network)
        rates = (config.scale_rate, config.rotation_rate, config.opacity_rate)
        groups = [{"params": [self.gaussians[n]], "peak": rate} for n, rate in zip(SHAPES, rates, strict=True)]
        rest = [*network["features"].parameters(), *network["signal"].parameters(), self.gaussians["path_loss"]]
        super().__init__(
            config, network, self._loss, [*groups, {"params": rest, "peak": config.rate}], betas=(0.9, 0.999)
        )
        device = self.gaussians["mean"].device
        self.owner, self.grid = owner, train.grid
        self.position, self.spectrum = train.position, train.spectrum.to(device)
        self.pull = torch.zeros(len(self.gaussians["mean"]), device=device)

    def rate(self, step: int) -> float:
        return super().rate(min(step, self.config.decay_steps or step))  # stays low once it has decayed

    def _loss(self, network: nn.ModuleDict, generator: torch.Generator) -> Tensor:
        row = torch.randint(len(self.position), (self.config.batch,), generator=generator)
        position = self.position[row]
        mean, cholesky = self.owner.project(network, position)
        self.projected = mean.requires_grad_(self.owner.config.grows)
        predicted = self.owner.rasterize(network, position, mean, cholesky, self.grid)
        return spectrum_loss(predicted, self.spectrum[row.to(predicted.device)], 0.2)

    def advance(self) -> Tensor:
        loss = super().advance()
        if self.owner.config.grows and self.step <= GROW_UNTIL:
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
                    self.gaussians["opacity"].clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        return loss

    @torch.no_grad()
    def _grow(self) -> None:
        shape, spread = self.gaussians, self.owner.config.spread
        pulled, visible = self.pull > MIN_PULL, torch.sigmoid(shape["opacity"]) > MIN_OPACITY
        large = shape["log_scale"].max(dim=1).values > math.log(MAX_CLONED * spread)
        stay = (visible & ~(pulled & large)).nonzero()[:, 0]
        clone = (visible & pulled & ~large).nonzero()[:, 0]
        split = (visible & pulled & large).nonzero()[:, 0].repeat(2)
        noise = torch.randn(len(split), 3, generator=self.generator()).to(split.device)
        offset = _rotations(shape["quaternion"][split]) @ (noise * shape["log_scale"][split].exp())[..., None]
        self._take(torch.cat([stay, clone, split]), n_old=len(stay))
        if len(split):
            shape["mean"][-len(split) :] += offset[..., 0]
            shape["log_scale"][-len(split) :] -= math.log(SPLIT_FACTOR)
        self.average = self.averaged()

    @torch.no_grad()
    def _take(self, row: Tensor, n_old: int) -> None:
        """Replace the Gaussians by these rows; the moments of Adam are kept for the first `n_old` only."""
        fresh = torch.arange(len(row), device=row.device) >= n_old
        self.gaussians["mean"] = nn.Parameter(self.gaussians["mean"][row], requires_grad=False)
        for name, group in zip(SHAPES, self.optimiser.param_groups, strict=False):
            (old,) = group["params"]
            new = nn.Parameter(old[row])
            if old in self.optimiser.state:
                state = self.optimiser.state.pop(old)
                moments = {key: state[key][row] for key in ("exp_avg", "exp_avg_sq")}
                for moment in moments.values():
                    moment[fresh] = 0
                self.optimiser.state[new] = state | moments
            group["params"] = [new]
            self.gaussians[name] = new
        self.pull = self.pull.new_zeros(len(row))

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        n = len(tensors["model.gaussians.mean"])
        self._take(torch.zeros(n, dtype=torch.int64, device=self.pull.device), n_old=0)
        self.average = self.averaged()
        super()._restore(tensors, header)
