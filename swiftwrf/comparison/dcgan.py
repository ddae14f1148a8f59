"""DCGAN: spectra of a generator that a discriminator cannot distinguish from measured ones.

A. Radford, L. Metz and S. Chintala, "Unsupervised Representation Learning with Deep Convolutional Generative Adversarial
Networks", 2016: its layers, batch normalisation and optimiser. The conditioning on the position that papers of this field
use is not published. Here noise and encoded position pass one more layer before the generator, and the discriminator takes
the encoded position. The generator also has an L1 loss to the measured spectrum, as is usual for paired data (P. Isola,
J.-Y. Zhu, T. Zhou and A. A. Efros, "Image-to-Image Translation with Conditional Adversarial Networks", 2017). Both step at
once, from torch's initial weights; with weights from N(0, 0.02^2) the position has hardly any effect. The mean prediction
has noise 0.

The quick preset is sized for two cores. `DcganConfig.paper()` has the publication's 1,024 to 128 channels, 100 noise
variables, rate and batches of 128.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, TrainedModel
from swiftwrf.comparison.convolution import ConvolutionalNetwork, ConvolutionalSize, PairedTraining, decoder, encoder
from swiftwrf.data.spectra import Spectra
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration


@configuration
class DcganSize(ConvolutionalSize):
    """Size of the networks.

    Example:
        >>> DcganSize(noise=8).noise
        8
    """

    noise: Count = 16
    """number of noise variables"""


@configuration
class DcganConfig(Config):
    """Options of `Dcgan`.

    Example:
        >>> Dcgan(DcganConfig(steps=200), l1_weight=10.0).config.l1_weight
        10.0
    """

    size: DcganSize = DcganSize()
    steps: PositiveInt = 1000
    batch: PositiveInt = 8
    rate: PositiveFloat = 5e-3
    l1_weight: NonNegativeFloat = 100.0
    """weight of the mean absolute error beside the adversarial loss"""

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
        return DcganTraining(self, DcganNetwork, train, device, betas=(0.5, 0.999))


class Discriminator(nn.Module):
    """Logit (B,) that a spectrum is measured, from spectra (B, H, W) and encoded positions."""

    def __init__(self, grid: AngularGrid, width: int, encoded: int) -> None:
        super().__init__()
        self.features, features = encoder(grid, width, inputs=1, norm=nn.BatchNorm2d)
        self.head = nn.Linear(features + encoded, 1)

    def forward(self, spectrum: Tensor, encoded: Tensor) -> Tensor:
        logit: Tensor = self.head(torch.cat([self.features(spectrum[:, None]), encoded], dim=-1))
        return logit[:, 0]


class DcganNetwork(ConvolutionalNetwork):
    """Generator and discriminator."""

    def __init__(self, size: DcganSize, grid: AngularGrid) -> None:
        super().__init__(size, grid)
        hidden = nn.Linear(size.noise + self.n_encoded, size.hidden)
        self.generator = nn.Sequential(hidden, nn.ReLU(), decoder(grid, size.width, size.hidden, norm=nn.BatchNorm2d))
        self.discriminator = Discriminator(grid, size.width, self.n_encoded)

    def generate(self, encoded: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return magnitudes (B, H, W) of encoded positions, from random noise if there is a generator."""
        noise = torch.zeros(len(encoded), self.size.noise)
        if generator is not None:
            noise = torch.randn(noise.shape, generator=generator)
        generated: Tensor = self.generator(torch.cat([noise.to(encoded.device), encoded], dim=-1))
        return generated[:, 0]

    def render(self, position: Tensor, grid: AngularGrid, generator: torch.Generator | None = None) -> Tensor:
        return self.generate(self.encoded(position), generator)


class DcganTraining(PairedTraining[DcganConfig, DcganNetwork]):
    """Training of both networks at once: one sum of losses, in which each takes the other's parameters as constants."""

    def objective(self) -> Tensor:
        generator, model = self.generator(), self.model
        spectrum, encoded = self.pairs(generator)
        generated = model.generate(encoded, generator)
        discriminator = functional.softplus(-model.discriminator(spectrum, encoded))
        discriminator = discriminator + functional.softplus(model.discriminator(generated.detach(), encoded))
        frozen = {name: parameter.detach() for name, parameter in model.discriminator.named_parameters()}
        adversarial = functional.softplus(-functional_call(model.discriminator, frozen, (generated, encoded)))
        error = (generated - spectrum).abs().mean()
        return discriminator.mean() + adversarial.mean() + self.config.l1_weight * error


class Dcgan(TrainedModel):
    """Conditional generative adversarial network; a sample generates a spectrum from random noise.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> Dcgan(steps=1).fit(room).sample(room.position, generator=torch.Generator()).shape
        torch.Size([20, 30, 120])
    """

    name = "dcgan"
    kind = "dcgan model"
    config_type = DcganConfig
    network_type = DcganNetwork
    samples = True
