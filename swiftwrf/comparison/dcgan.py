"""DCGAN: spectra drawn by a generator that a discriminator cannot tell from measured ones.

A. Radford, L. Metz and S. Chintala, "Unsupervised Representation Learning with Deep Convolutional Generative Adversarial
Networks", 2016: its layers, batch normalisation and optimiser. How the papers of this field condition it on the position is
not published; here the noise and the encoded position go through one more layer before the generator, the discriminator is
given the encoded position, and the generator is also held to the measured spectrum by an L1 term, as is usual for paired
data (P. Isola, J.-Y. Zhu, T. Zhou and A. A. Efros, "Image-to-Image Translation with Conditional Adversarial Networks",
2017).
Generator and discriminator step at once, from torch's initial weights (from N(0, 0.02^2) the position is hardly heard).
Without a generator of random numbers a spectrum is drawn from noise 0, its mean.

The quick preset is sized for two cores; `DcganConfig.paper()` has the publication's 1,024 to 128 channels, 100 noise
numbers, rate and batches of 128.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Size, Training
from swiftwrf.comparison.convolution import decoder, encoder
from swiftwrf.comparison.drawing import Drawing, Frame, draw_parameters
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.swiftwrf.encoding import encode


@dataclass(frozen=True)
class DcganSize(Size):
    """Of the networks."""

    noise: int = 16
    """numbers that the position does not tell"""
    width: int = 8
    """channels at the finest stage"""
    hidden: int = 128
    """width of the layer that noise and position go through"""
    bands: int = 5
    """frequencies of the position's encoding"""


@dataclass(frozen=True)
class DcganConfig(Config[DcganSize, "Dcgan"]):
    """How the DCGAN is fitted."""

    size: DcganSize = DcganSize()
    steps: int = 1000
    batch: int = 8
    rate: float = 5e-3
    l1_weight: float = 100.0
    """of the mean absolute error beside the discriminator's verdict"""

    @classmethod
    def paper(cls, **changes: Any) -> DcganConfig:
        paper = cls(
            size=DcganSize(noise=100, width=128, hidden=512),
            steps=50_000,
            batch=128,
            rate=2e-4,
            warm_up=1,
            final_rate=1.0,
            averaging=0.0,
            clip=math.inf,
            check_every=500,
        )
        return replace(paper, **changes)

    def training(self, train: Spectra, device: torch.device) -> DcganTraining:
        return DcganTraining(self, train, device)


class Discriminator(nn.Module):
    """How far a spectrum looks measured at its position, (B,), from spectra (B, H, W) and encoded positions."""

    def __init__(self, grid: AngularGrid, width: int, encoded: int) -> None:
        super().__init__()
        self.features, seen = encoder(grid, width, inputs=1, norm=nn.BatchNorm2d)
        self.verdict = nn.Linear(seen + encoded, 1)

    def forward(self, spectrum: Tensor, encoded: Tensor) -> Tensor:
        verdict: Tensor = self.verdict(torch.cat([self.features(spectrum[:, None]), encoded], dim=-1))
        return verdict[:, 0]


class Dcgan(Drawing):
    """Generator and discriminator.

    Args:
        size, grid: see `Drawing`; spectra are drawn on this grid alone.
    """

    kind: ClassVar[str] = "dcgan model"
    size_type = DcganSize

    def __init__(self, size: DcganSize, grid: AngularGrid) -> None:
        super().__init__(size, grid)
        encoded = 3 * (2 * size.bands + 1)
        self.frame = Frame()
        hidden = nn.Linear(size.noise + encoded, size.hidden)
        self.generator = nn.Sequential(hidden, nn.ReLU(), decoder(grid, size.width, size.hidden, norm=nn.BatchNorm2d))
        self.discriminator = Discriminator(grid, size.width, encoded)

    @classmethod
    def make(cls, size: DcganSize, train: Spectra, generator: torch.Generator) -> Dcgan:
        """At its start."""
        model = cls(size, train.grid)
        model.frame.place(train.position)
        draw_parameters(model, generator)
        return model

    def encoded(self, position: Tensor) -> Tensor:
        """Positions (B, 3) [m] as the networks take them."""
        return encode(self.frame(position), self.size.bands)

    def generate(self, encoded: Tensor, generator: torch.Generator | None) -> Tensor:
        """Magnitudes (B, H, W) from noise of the generator, or from none."""
        noise = torch.zeros(len(encoded), self.size.noise)
        if generator is not None:
            noise = torch.randn(noise.shape, generator=generator)
        drawn: Tensor = self.generator(torch.cat([noise.to(encoded.device), encoded], dim=-1))
        return drawn[:, 0]

    def synthesize(self, position: Tensor, batch: int = 64, generator: torch.Generator | None = None) -> Tensor:
        """Spectra at any positions, on the grid of the fitted ones.

        Args:
            position, batch: as of `SwiftWRF.synthesize`, and so are result and errors.
            generator: draws the noise; without one it is 0.
        """
        return self.drawn(position, self.grid, batch, lambda some: self.generate(self.encoded(some), generator))


class DcganTraining(Training[DcganConfig, Dcgan]):
    """Of both at once: one sum, in which each sees the other's parameters as constants."""

    def __init__(self, config: DcganConfig, train: Spectra, device: torch.device) -> None:
        model = Dcgan.make(config.size, train, torch.Generator().manual_seed(config.seed)).to(device)
        super().__init__(config, model, betas=(0.5, 0.999))
        self.position, self.spectrum = train.position, train.spectrum.to(device)

    def objective(self) -> Tensor:
        generator, model = self.generator(), self.model
        row = torch.randint(len(self.position), (self.config.batch,), generator=generator)
        spectrum, encoded = self.spectrum[row.to(self.spectrum.device)], model.encoded(self.position[row])
        drawn = model.generate(encoded, generator)
        told_apart = functional.softplus(-model.discriminator(spectrum, encoded))
        told_apart = told_apart + functional.softplus(model.discriminator(drawn.detach(), encoded))
        frozen = {name: parameter.detach() for name, parameter in model.discriminator.named_parameters()}
        taken_for_measured = functional.softplus(-functional_call(model.discriminator, frozen, (drawn, encoded)))
        error = (drawn - spectrum).abs().mean()
        return told_apart.mean() + taken_for_measured.mean() + self.config.l1_weight * error
