"""VAE: spectra decoded from the position and from latent variables that the position does not determine.

D. P. Kingma and M. Welling, "Auto-Encoding Variational Bayes", 2014, conditioned as by K. Sohn, H. Lee and X. Yan, "Learning
Structured Output Representation using Deep Conditional Generative Models", 2015. The layers and the conditioning that papers
of this field compare with are not published; these are our choice. An encoder takes spectrum and position, a prior takes the
position. Both return mean and variance of the latent variables. A convolutional decoder takes a latent sample and the
position. The mean prediction decodes the mean of the prior.

The quick preset is sized for two cores. `VaeConfig.paper()` has eight times the channels, more latent variables and steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, TrainedModel
from swiftwrf.comparison.convolution import ConvolutionalNetwork, ConvolutionalSize, PairedTraining, decoder, encoder
from swiftwrf.data.spectra import Spectra
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, configuration


@configuration
class VaeSize(ConvolutionalSize):
    """Size of the networks.

    Example:
        >>> VaeSize(latent=8).latent
        8
    """

    latent: Count = 16
    """number of latent variables"""


@configuration
class VaeConfig(Config):
    """Options of `Vae`.

    Example:
        >>> Vae(VaeConfig(size=VaeSize(latent=8))).config.size.latent
        8
    """

    size: VaeSize = VaeSize()
    steps: PositiveInt = 1000
    batch: PositiveInt = 16
    rate: PositiveFloat = 2e-3
    noise: PositiveFloat = 0.5
    """standard deviation of a pixel about the decoded spectrum, large because the loss treats pixels as independent; with a
    smaller one the latent variables leave their prior"""

    @classmethod
    def paper(cls, **changes: Any) -> VaeConfig:
        paper = cls(size=VaeSize(latent=64, width=64, hidden=512), steps=50_000, batch=64, rate=1e-3, check_every=500)
        return replace(paper, **changes)

    def training(self, train: Spectra, device: torch.device) -> VaeTraining:
        return VaeTraining(self, VaeNetwork, train, device)


class Normal(NamedTuple):
    """Independent normal distributions of latent variables."""

    mean: Tensor  # (B, latent)
    log_variance: Tensor  # (B, latent)

    @classmethod
    def of(cls, raw: Tensor) -> Normal:
        """Return the distributions of raw outputs (B, 2 latent)."""
        mean, log_variance = raw.chunk(2, dim=-1)
        return cls(mean, log_variance.clamp(-10, 10))

    def sample(self, generator: torch.Generator) -> Tensor:
        """Return one sample of each distribution."""
        noise = torch.randn(self.mean.shape, generator=generator).to(self.mean.device)
        return self.mean + noise * (0.5 * self.log_variance).exp()

    def divergence(self, other: Normal) -> Tensor:
        """Return the Kullback-Leibler divergence from `other`, (B,)."""
        spread = (self.mean - other.mean).square() + self.log_variance.exp()
        each = other.log_variance - self.log_variance + spread * torch.exp(-other.log_variance) - 1
        return 0.5 * each.sum(dim=-1)


class VaeNetwork(ConvolutionalNetwork):
    """Decoder, encoder and prior."""

    def __init__(self, size: VaeSize, grid: AngularGrid) -> None:
        super().__init__(size, grid)
        encoded, hidden, latent = self.n_encoded, size.hidden, size.latent
        self.encoder, features = encoder(grid, size.width, inputs=1)
        self.posterior = nn.Sequential(nn.Linear(features + encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent))
        self.prior = nn.Sequential(nn.Linear(encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent))
        self.hidden = nn.Sequential(nn.Linear(latent + encoded, hidden), nn.ReLU())
        self.decoder = decoder(grid, size.width, hidden)

    def decode(self, latent: Tensor, encoded: Tensor) -> Tensor:
        """Return magnitudes (B, H, W)."""
        decoded: Tensor = self.decoder(self.hidden(torch.cat([latent, encoded], dim=-1)))
        return decoded[:, 0]

    def render(self, position: Tensor, grid: AngularGrid, generator: torch.Generator | None = None) -> Tensor:
        encoded = self.encoded(position)
        prior = Normal.of(self.prior(encoded))
        return self.decode(prior.mean if generator is None else prior.sample(generator), encoded)


class VaeTraining(PairedTraining[VaeConfig, VaeNetwork]):
    """Maximisation of the evidence lower bound, per pixel and in units of the squared error."""

    def objective(self) -> Tensor:
        generator, model = self.generator(), self.model
        spectrum, encoded = self.pairs(generator)
        posterior = Normal.of(model.posterior(torch.cat([model.encoder(spectrum[:, None]), encoded], dim=-1)))
        decoded = model.decode(posterior.sample(generator), encoded)
        divergence = posterior.divergence(Normal.of(model.prior(encoded))).mean() / spectrum[0].numel()
        return (decoded - spectrum).square().mean() + 2 * self.config.noise**2 * divergence


class Vae(TrainedModel):
    """Conditional variational autoencoder; a sample decodes latent variables sampled from their prior.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Vae(steps=1).fit(room).predict(room.position).mean.shape
        torch.Size([20, 30, 120])
    """

    name = "vae"
    kind = "vae model"
    config_type = VaeConfig
    network_type = VaeNetwork
    samples = True
