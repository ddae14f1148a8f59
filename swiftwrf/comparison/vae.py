"""VAE: spectra decoded from the position and from a few latent numbers that the position does not tell.

D. P. Kingma and M. Welling, "Auto-Encoding Variational Bayes", 2014, conditioned as by K. Sohn, H. Lee and X. Yan, "Learning
Structured Output Representation using Deep Conditional Generative Models", 2015. Which layers and which conditioning the
papers of this field compare with is not published; these are ours. An encoder sees spectrum and position, a prior the
position alone, both give mean and variance of the latent numbers, and a convolutional decoder draws from them and the
position. Without a generator a spectrum is drawn from the prior's mean, the latent numbers' conditional one.

The quick preset is sized for two cores; `VaeConfig.paper()` has eight times the channels, more latent numbers and steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Size, Training
from swiftwrf.comparison.convolution import decoder, encoder
from swiftwrf.comparison.drawing import Drawing, Frame, draw_parameters
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.swiftwrf.encoding import encode


@dataclass(frozen=True)
class VaeSize(Size):
    """Of the networks."""

    latent: int = 16
    """numbers that the position does not tell"""
    width: int = 8
    """channels at the finest stage"""
    hidden: int = 128
    """width of the layer that the position and the encoded spectrum go through"""
    bands: int = 5
    """frequencies of the position's encoding"""


@dataclass(frozen=True)
class VaeConfig(Config[VaeSize, "Vae"]):
    """How the VAE is fitted."""

    size: VaeSize = VaeSize()
    steps: int = 1000
    batch: int = 16
    rate: float = 2e-3
    noise: float = 0.5
    """standard deviation of a pixel about what is decoded; as if pixels were independent, hence so much: a smaller one lets
    the latent numbers stray from their prior"""

    @classmethod
    def paper(cls, **changes: Any) -> VaeConfig:
        paper = cls(size=VaeSize(latent=64, width=64, hidden=512), steps=50_000, batch=64, rate=1e-3, check_every=500)
        return replace(paper, **changes)

    def training(self, train: Spectra, device: torch.device) -> VaeTraining:
        return VaeTraining(self, train, device)


class Normal(NamedTuple):
    """Independent normal distributions of latent numbers."""

    mean: Tensor  # (B, latent)
    log_variance: Tensor  # likewise

    @classmethod
    def of(cls, raw: Tensor) -> Normal:
        """From twice as many raw numbers."""
        mean, log_variance = raw.chunk(2, dim=-1)
        return cls(mean, log_variance.clamp(-10, 10))

    def sample(self, generator: torch.Generator) -> Tensor:
        """One draw each."""
        noise = torch.randn(self.mean.shape, generator=generator).to(self.mean.device)
        return self.mean + noise * (0.5 * self.log_variance).exp()

    def divergence(self, other: Normal) -> Tensor:
        """Kullback-Leibler divergence from `other`, (B,)."""
        apart = (self.mean - other.mean).square() + self.log_variance.exp()
        each = other.log_variance - self.log_variance + apart * torch.exp(-other.log_variance) - 1
        return 0.5 * each.sum(dim=-1)


class Vae(Drawing):
    """Decoder, encoder and prior.

    Args:
        size, grid: see `Drawing`; spectra are drawn on this grid alone.
    """

    kind: ClassVar[str] = "vae model"
    size_type = VaeSize

    def __init__(self, size: VaeSize, grid: AngularGrid) -> None:
        super().__init__(size, grid)
        encoded, hidden, latent = 3 * (2 * size.bands + 1), size.hidden, size.latent
        self.frame = Frame()
        self.encoder, seen = encoder(grid, size.width, inputs=1)
        self.posterior = nn.Sequential(nn.Linear(seen + encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent))
        self.prior = nn.Sequential(nn.Linear(encoded, hidden), nn.ReLU(), nn.Linear(hidden, 2 * latent))
        self.hidden = nn.Sequential(nn.Linear(latent + encoded, hidden), nn.ReLU())
        self.decoder = decoder(grid, size.width, hidden)

    @classmethod
    def make(cls, size: VaeSize, train: Spectra, generator: torch.Generator) -> Vae:
        """At its start."""
        model = cls(size, train.grid)
        model.frame.place(train.position)
        draw_parameters(model, generator)
        return model

    def encoded(self, position: Tensor) -> Tensor:
        """Positions (B, 3) [m] as the networks take them."""
        return encode(self.frame(position), self.size.bands)

    def decode(self, latent: Tensor, encoded: Tensor) -> Tensor:
        """Magnitudes (B, H, W)."""
        drawn: Tensor = self.decoder(self.hidden(torch.cat([latent, encoded], dim=-1)))
        return drawn[:, 0]

    def synthesize(self, position: Tensor, batch: int = 64, generator: torch.Generator | None = None) -> Tensor:
        """Spectra at any positions, on the grid of the fitted ones.

        Args:
            position, batch: as of `SwiftWRF.synthesize`, and so are result and errors.
            generator: draws the latent numbers from their prior; without one they take its mean.
        """

        def draw(some: Tensor) -> Tensor:
            encoded = self.encoded(some)
            prior = Normal.of(self.prior(encoded))
            return self.decode(prior.mean if generator is None else prior.sample(generator), encoded)

        return self.drawn(position, self.grid, batch, draw)


class VaeTraining(Training[VaeConfig, Vae]):
    """By the evidence lower bound, a pixel and in units of the squared error."""

    def __init__(self, config: VaeConfig, train: Spectra, device: torch.device) -> None:
        model = Vae.make(config.size, train, torch.Generator().manual_seed(config.seed)).to(device)
        super().__init__(config, model)
        self.position, self.spectrum = train.position, train.spectrum.to(device)

    def objective(self) -> Tensor:
        generator, model = self.generator(), self.model
        row = torch.randint(len(self.position), (self.config.batch,), generator=generator)
        spectrum, encoded = self.spectrum[row.to(self.spectrum.device)], model.encoded(self.position[row])
        seen = torch.cat([model.encoder(spectrum[:, None]), encoded], dim=-1)
        posterior, prior = Normal.of(model.posterior(seen)), Normal.of(model.prior(encoded))
        drawn = model.decode(posterior.sample(generator), encoded)
        kept = posterior.divergence(prior).mean() / spectrum[0].numel()
        return (drawn - spectrum).square().mean() + 2 * self.config.noise**2 * kept
