"""Generative networks of convolutions that halve and double spectra, periodic in azimuth: VAE and DCGAN.

VAE: spectra decoded from the position and from latent variables that the position does not determine. D. P. Kingma and
M. Welling, "Auto-Encoding Variational Bayes", 2014, conditioned as by K. Sohn, H. Lee and X. Yan, "Learning Structured
Output Representation using Deep Conditional Generative Models", 2015. The layers and the conditioning that papers of this
field compare with are not published; these are our choice. An encoder takes spectrum and position, a prior takes the
position. Both return mean and variance of the latent variables. A convolutional decoder takes a latent sample and the
position. The prediction decodes the mean of the prior.

DCGAN: spectra of a generator that a discriminator cannot distinguish from measured ones. A. Radford, L. Metz and
S. Chintala, "Unsupervised Representation Learning with Deep Convolutional Generative Adversarial Networks", 2016: its
layers, batch normalisation and optimiser. The conditioning on the position that papers of this field use is not published.
Here noise and encoded position pass one more layer before the generator, and the discriminator takes the encoded position.
The generator also has an L1 loss to the measured spectrum, as is usual for paired data (P. Isola, J.-Y. Zhu, T. Zhou and
A. A. Efros, "Image-to-Image Translation with Conditional Adversarial Networks", 2017). Both step at once, from torch's
initial weights; with weights from N(0, 0.02^2) the position has hardly any effect. The prediction has noise 0.

The quick presets are sized for two cores. `VaeConfig.paper()` has eight times the channels, more latent variables and steps.
`DcganConfig.paper()` has the publication's 1,024 to 128 channels, 100 noise variables, rate and batches of 128.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.func import functional_call
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.contrib.published.base import Config, Count, TrainedModel, Training
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.models.mlp import draw_parameters, encode
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration

MIN_HALVED_PIXELS = 4  # rows or columns that are still halved

Shape = tuple[int, int]
Layer = Callable[[Tensor], Tensor]
Norm = Callable[[int], nn.Module]


def stages(grid: AngularGrid) -> list[Shape]:
    """Return rows and columns of the spectra and of each halving, the smallest last.

    Raises:
        InputError: The spectra are too small.
    """
    shapes = [grid.shape]
    while len(shapes) <= 4 and min(shapes[-1]) >= MIN_HALVED_PIXELS:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    if len(shapes) == 1:
        least, found = MIN_HALVED_PIXELS, " x ".join(map(str, grid.shape))
        raise InputError(f"convolutions need spectra of at least {least} x {least} pixels, got {found}")
    return shapes


def halve(inputs: int, outputs: int, shape: Shape) -> nn.Sequential:
    """Return a convolution from (B, inputs, H, W) = (B, inputs, *shape) to (B, outputs, ceil(H / 2), ceil(W / 2))."""
    height, width = shape
    wrapped, padded = nn.CircularPad2d((1, 1 + width % 2, 0, 0)), nn.ZeroPad2d((0, 0, 1, 1 + height % 2))
    return nn.Sequential(wrapped, padded, nn.Conv2d(inputs, outputs, kernel_size=4, stride=2))


def double(inputs: int, outputs: int, before: Shape, after: Shape) -> nn.Sequential:
    """Return a transposed convolution from (B, inputs, *before) to (B, outputs, *after), where after is at most doubled."""
    upwards = nn.ConvTranspose2d(inputs, outputs, kernel_size=4, stride=2, padding=(1, 3))
    cropped = nn.ZeroPad2d((0, after[1] - 2 * before[1], 0, after[0] - 2 * before[0]))
    return nn.Sequential(nn.CircularPad2d((1, 1, 0, 0)), upwards, cropped)


def encoder(grid: AngularGrid, width: int, norm: Norm = nn.Identity) -> tuple[nn.Sequential, int]:
    """Return a network from spectra (B, 1, H, W) to (B, features), and the number of features.

    Args:
        grid: Grid of the spectra.
        width: Channels after the first halving; each further halving doubles them.
        norm: Normalisation of a number of channels, after each layer but the first.
    """
    shapes = stages(grid)
    channels = [1, *(width * 2**i for i in range(len(shapes) - 1))]
    layers: list[nn.Module] = []
    for i, ((before, after), shape) in enumerate(zip(pairwise(channels), shapes, strict=False)):
        layers += [halve(before, after, shape), *([norm(after)] if i else []), nn.LeakyReLU(0.2)]
    height, breadth = shapes[-1]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * height * breadth


def decoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> nn.Sequential:
    """Return a network from (B, inputs) to magnitudes (B, 1, H, W) in [0, 1]; see `encoder` for the other arguments."""
    shapes = stages(grid)
    channels = [width * 2**i for i in reversed(range(len(shapes) - 1))]
    height, breadth = shapes[-1]
    first = nn.Linear(inputs, channels[0] * height * breadth)
    layers: list[nn.Module] = [first, nn.Unflatten(1, (channels[0], height, breadth)), norm(channels[0]), nn.ReLU()]
    for (before, after), (small, large) in zip(pairwise(channels), pairwise(shapes[:0:-1]), strict=True):
        layers += [double(before, after, small, large), norm(after), nn.ReLU()]
    return nn.Sequential(*layers, double(channels[-1], 1, shapes[1], shapes[0]), nn.Sigmoid())


@configuration
class ConvolutionalConfig(Config):
    """Options of `Vae` and `Dcgan`."""

    width: Count = 8
    """channels at the finest stage"""
    hidden: Count = 128
    """width of the fully connected layer"""
    bands: Count = 5
    """frequencies of the encoding of the position"""


class Convolutional(TrainedModel):
    """Base class of networks that are trained on pairs of spectrum and position."""

    betas: ClassVar[tuple[float, float]] = (0.9, 0.99)
    """option of Adam"""

    @abstractmethod
    def _loss(self, network: nn.ModuleDict, spectrum: Tensor, encoded: Tensor, generator: torch.Generator) -> Tensor:
        """Return the loss of spectra (B, H, W) at encoded positions (B, features)."""

    def training(self, train: Spectra, device: torch.device) -> Training[Any]:
        network = self.blank()
        draw_parameters(network, torch.Generator().manual_seed(self.config.seed))
        position, spectrum = train.position, train.spectrum.to(device)

        def loss(network: nn.ModuleDict, generator: torch.Generator) -> Tensor:
            row = torch.randint(len(position), (self.config.batch,), generator=generator)
            return self._loss(network, spectrum[row.to(device)], self._encoded(position[row], device), generator)

        return Training(self.config, network.to(device), loss, betas=self.betas)

    def _encoded(self, position: Tensor, device: torch.device) -> Tensor:
        return encode(self.local(position, device), self.config.bands)


@configuration
class VaeConfig(ConvolutionalConfig):
    """Options of `Vae`."""

    published: ClassVar[dict[str, Any]] = {
        "latent": 64,
        "width": 64,
        "hidden": 512,
        "steps": 50_000,
        "batch": 64,
        "rate": 1e-3,
        "check_every": 500,
    }

    latent: Count = 16
    """number of latent variables"""
    rate: PositiveFloat = 2e-3
    noise: PositiveFloat = 0.5
    """standard deviation of a pixel about the decoded spectrum, large because the loss treats pixels as independent; with a
    smaller one the latent variables leave their prior"""
    steps: PositiveInt = 1000


class Vae(Convolutional):
    """Conditional variational autoencoder.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Vae(steps=1).fit(room).predict(room.position).mean.shape
        torch.Size([20, 30, 120])
    """

    name = "vae"
    kind = "vae model"
    config_type = VaeConfig

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> nn.ModuleDict:
        """Return decoder, encoder and prior."""
        config, encoded = self.config, 3 * (2 * self.config.bands + 1)
        hidden, latent = config.hidden, config.latent
        front, features = encoder(self.grid, config.width)
        return nn.ModuleDict(
            {
                "encoder": front,
                "posterior": nn.Sequential(
                    nn.Linear(features + encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent)
                ),
                "prior": nn.Sequential(nn.Linear(encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent)),
                "hidden": nn.Sequential(nn.Linear(latent + encoded, hidden), nn.ReLU()),
                "decoder": decoder(self.grid, config.width, hidden),
            }
        )

    def _loss(self, network: nn.ModuleDict, spectrum: Tensor, encoded: Tensor, generator: torch.Generator) -> Tensor:
        """Return the negative evidence lower bound, per pixel and in units of the squared error."""
        posterior = normal(network["posterior"](torch.cat([network["encoder"](spectrum[:, None]), encoded], dim=-1)))
        noise = torch.randn(posterior.mean.shape, generator=generator).to(encoded.device)
        decoded = _decode(network, posterior.mean + noise * posterior.stddev, encoded)
        apart = kl_divergence(posterior, normal(network["prior"](encoded))).sum(dim=-1).mean() / spectrum[0].numel()
        loss: Tensor = (decoded - spectrum).square().mean() + 2 * self.config.noise**2 * apart
        return loss

    def render(self, network: nn.ModuleDict, position: Tensor, grid: AngularGrid) -> Tensor:
        encoded = self._encoded(position, position.device)
        return _decode(network, normal(network["prior"](encoded)).mean, encoded)


def _decode(network: nn.ModuleDict, latent: Tensor, encoded: Tensor) -> Tensor:
    """Return magnitudes (B, H, W) of latent variables and encoded positions."""
    decoded: Tensor = network["decoder"](network["hidden"](torch.cat([latent, encoded], dim=-1)))
    return decoded[:, 0]


def normal(raw: Tensor) -> Normal:
    """Return the independent normal distributions whose means and log variances are raw outputs (B, 2 latent)."""
    mean, log_variance = raw.chunk(2, dim=-1)
    return Normal(mean, (0.5 * log_variance.clamp(-10, 10)).exp(), validate_args=False)


@configuration
class DcganConfig(ConvolutionalConfig):
    """Options of `Dcgan`."""

    published: ClassVar[dict[str, Any]] = {
        "noise": 100,
        "width": 128,
        "hidden": 512,
        "steps": 50_000,
        "batch": 128,
        "rate": 2e-4,
        "warm_up": 1,
        "final_rate": 1.0,
        "averaging": 0.0,
        "clip": math.inf,
        "check_every": 500,
    }

    noise: Count = 16
    """number of noise variables"""
    steps: PositiveInt = 1000
    batch: PositiveInt = 8
    rate: PositiveFloat = 5e-3
    l1_weight: NonNegativeFloat = 100.0
    """weight of the mean absolute error beside the adversarial loss"""


class Dcgan(Convolutional):
    """Conditional generative adversarial network.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Dcgan(steps=1).fit(room).predict(room.position).mean.shape
        torch.Size([20, 30, 120])
    """

    name = "dcgan"
    kind = "dcgan model"
    config_type = DcganConfig
    betas = (0.5, 0.999)

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> nn.ModuleDict:
        """Return the generator, and the discriminator's features and head."""
        config, encoded = self.config, 3 * (2 * self.config.bands + 1)
        hidden = nn.Linear(config.noise + encoded, config.hidden)
        images = decoder(self.grid, config.width, config.hidden, norm=nn.BatchNorm2d)
        features, n_features = encoder(self.grid, config.width, norm=nn.BatchNorm2d)
        generator, head = nn.Sequential(hidden, nn.ReLU(), images), nn.Linear(n_features + encoded, 1)
        return nn.ModuleDict({"generator": generator, "features": features, "head": head})

    def _loss(self, network: nn.ModuleDict, spectrum: Tensor, encoded: Tensor, generator: torch.Generator) -> Tensor:
        """Return one sum of losses for both networks, in which each takes the other's parameters as constants."""
        noise = torch.randn(len(encoded), self.config.noise, generator=generator).to(encoded.device)
        generated = network["generator"](torch.cat([noise, encoded], dim=-1))[:, 0]
        features, head = network["features"], network["head"]
        discriminator = functional.softplus(-_logit(features, head, spectrum, encoded))
        discriminator = discriminator + functional.softplus(_logit(features, head, generated.detach(), encoded))
        adversarial = functional.softplus(-_logit(_frozen(features), _frozen(head), generated, encoded))
        error = (generated - spectrum).abs().mean()
        loss: Tensor = discriminator.mean() + adversarial.mean() + self.config.l1_weight * error
        return loss

    def render(self, network: nn.ModuleDict, position: Tensor, grid: AngularGrid) -> Tensor:
        encoded = self._encoded(position, position.device)
        noise = encoded.new_zeros(len(encoded), self.config.noise)
        generated: Tensor = network["generator"](torch.cat([noise, encoded], dim=-1))
        return generated[:, 0]


def _logit(features: Layer, head: Layer, spectrum: Tensor, encoded: Tensor) -> Tensor:
    """Return the logit (B,) that a spectrum (B, H, W) is measured, with its position encoded."""
    return head(torch.cat([features(spectrum[:, None]), encoded], dim=-1))[:, 0]


def _frozen(module: nn.Module) -> Layer:
    """Return the function of a module with its parameters as constants."""
    constants = {name: parameter.detach() for name, parameter in module.named_parameters()}
    return lambda x: functional_call(module, constants, (x,))
