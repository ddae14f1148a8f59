"""VAE: spectra decoded from the position and from latent variables that the position does not determine.

D. P. Kingma and M. Welling, "Auto-Encoding Variational Bayes", 2014, conditioned as by K. Sohn, H. Lee and X. Yan, "Learning
Structured Output Representation using Deep Conditional Generative Models", 2015. The layers and the conditioning that papers
of this field compare with are not published; these are our choice. An encoder takes spectrum and position, a prior takes the
position. Both return mean and variance of the latent variables. A convolutional decoder takes a latent sample and the
position. The prediction decodes the mean of the prior.

The quick preset is sized for two cores. `VaeConfig.paper()` has eight times the channels, more latent variables and steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, TrainedModel, Training
from swiftwrf.comparison.convolution import decoder, encoder, paired_training
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.mlp import encode
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, configuration

Normal = tuple[Tensor, Tensor]
"""mean and log variance (B, latent) of independent normal distributions"""


@configuration
class VaeConfig(Config):
    """Options of `Vae`.

    Example:
        >>> Vae(VaeConfig(latent=8)).config.latent
        8
    """

    published: ClassVar[dict[str, Any]] = {
        "latent": 64,
        "width": 64,
        "hidden": 512,
        "steps": 50_000,
        "batch": 64,
        "rate": 1e-3,
        "check_every": 500,
    }

    width: Count = 8
    """channels at the finest stage"""
    hidden: Count = 128
    """width of the fully connected layer"""
    bands: Count = 5
    """frequencies of the encoding of the position"""
    latent: Count = 16
    """number of latent variables"""
    rate: PositiveFloat = 2e-3
    noise: PositiveFloat = 0.5
    """standard deviation of a pixel about the decoded spectrum, large because the loss treats pixels as independent; with a
    smaller one the latent variables leave their prior"""
    steps: PositiveInt = 1000


class Vae(TrainedModel):
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

    def training(self, train: Spectra, device: torch.device) -> Training[nn.ModuleDict]:
        return paired_training(self, train, device, self._loss)

    def _loss(self, network: nn.ModuleDict, spectrum: Tensor, position: Tensor, generator: torch.Generator) -> Tensor:
        """Return the negative evidence lower bound, per pixel and in units of the squared error."""
        encoded = self._encoded(position, spectrum.device)
        posterior = normal(network["posterior"](torch.cat([network["encoder"](spectrum[:, None]), encoded], dim=-1)))
        mean, log_variance = posterior
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        decoded = _decode(network, mean + noise * (0.5 * log_variance).exp(), encoded)
        apart = divergence(posterior, normal(network["prior"](encoded))).mean() / spectrum[0].numel()
        loss: Tensor = (decoded - spectrum).square().mean() + 2 * self.config.noise**2 * apart
        return loss

    def render(self, network: nn.ModuleDict, position: Tensor, grid: AngularGrid) -> Tensor:
        encoded = self._encoded(position, position.device)
        return _decode(network, normal(network["prior"](encoded))[0], encoded)

    def _encoded(self, position: Tensor, device: torch.device) -> Tensor:
        return encode(self.local(position, device), self.config.bands)


def _decode(network: nn.ModuleDict, latent: Tensor, encoded: Tensor) -> Tensor:
    """Return magnitudes (B, H, W) of latent variables and encoded positions."""
    decoded: Tensor = network["decoder"](network["hidden"](torch.cat([latent, encoded], dim=-1)))
    return decoded[:, 0]


def normal(raw: Tensor) -> Normal:
    """Return the normal distributions of raw outputs (B, 2 latent)."""
    mean, log_variance = raw.chunk(2, dim=-1)
    return mean, log_variance.clamp(-10, 10)


def divergence(one: Normal, other: Normal) -> Tensor:
    """Return the Kullback-Leibler divergence of one normal distribution from another, (B,)."""
    (mean, log_variance), (other_mean, other_log_variance) = one, other
    spread = (mean - other_mean).square() + log_variance.exp()
    each = other_log_variance - log_variance + spread * torch.exp(-other_log_variance) - 1
    return 0.5 * each.sum(dim=-1)
