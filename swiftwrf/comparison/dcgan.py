"""DCGAN: spectra of a generator that a discriminator cannot distinguish from measured ones.

A. Radford, L. Metz and S. Chintala, "Unsupervised Representation Learning with Deep Convolutional Generative Adversarial
Networks", 2016: its layers, batch normalisation and optimiser. The conditioning on the position that papers of this field
use is not published. Here noise and encoded position pass one more layer before the generator, and the discriminator takes
the encoded position. The generator also has an L1 loss to the measured spectrum, as is usual for paired data (P. Isola,
J.-Y. Zhu, T. Zhou and A. A. Efros, "Image-to-Image Translation with Conditional Adversarial Networks", 2017). Both step at
once, from torch's initial weights; with weights from N(0, 0.02^2) the position has hardly any effect. The prediction
has noise 0.

The quick preset is sized for two cores. `DcganConfig.paper()` has the publication's 1,024 to 128 channels, 100 noise
variables, rate and batches of 128.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, TrainedModel, Training
from swiftwrf.comparison.convolution import decoder, encoder, paired_training
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.mlp import encode
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration

Layer = Callable[[Tensor], Tensor]


@configuration
class DcganConfig(Config):
    """Options of `Dcgan`.

    Example:
        >>> Dcgan(DcganConfig(steps=200), l1_weight=10.0).config.l1_weight
        10.0
    """

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

    width: Count = 8
    """channels at the finest stage"""
    hidden: Count = 128
    """width of the fully connected layer"""
    bands: Count = 5
    """frequencies of the encoding of the position"""
    noise: Count = 16
    """number of noise variables"""
    steps: PositiveInt = 1000
    batch: PositiveInt = 8
    rate: PositiveFloat = 5e-3
    l1_weight: NonNegativeFloat = 100.0
    """weight of the mean absolute error beside the adversarial loss"""


class Dcgan(TrainedModel):
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

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> nn.ModuleDict:
        """Return the generator, and the discriminator's features and head."""
        config, encoded = self.config, 3 * (2 * self.config.bands + 1)
        hidden = nn.Linear(config.noise + encoded, config.hidden)
        images = decoder(self.grid, config.width, config.hidden, norm=nn.BatchNorm2d)
        features, n_features = encoder(self.grid, config.width, norm=nn.BatchNorm2d)
        generator, head = nn.Sequential(hidden, nn.ReLU(), images), nn.Linear(n_features + encoded, 1)
        return nn.ModuleDict({"generator": generator, "features": features, "head": head})

    def training(self, train: Spectra, device: torch.device) -> Training[nn.ModuleDict]:
        return paired_training(self, train, device, self._loss, betas=(0.5, 0.999))

    def _loss(self, network: nn.ModuleDict, spectrum: Tensor, position: Tensor, generator: torch.Generator) -> Tensor:
        """Return one sum of losses for both networks, in which each takes the other's parameters as constants."""
        encoded = encode(self.local(position, spectrum.device), self.config.bands)
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
        encoded = encode(self.local(position, position.device), self.config.bands)
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
