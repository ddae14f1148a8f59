"""NeRF2: a network of absorption, phase shift and emission in space, integrated along rays.

X. Zhao, Z. An, Q. Pan and L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM MobiCom 2023. `NeRF2Config.paper()`
has the sizes, rates and steps of its code: 690,564 parameters, 64 samples over 5 m, 8,192 single rays a step.

Changed everywhere: positions are relative to the centre of the training positions, so that map coordinates keep their
millimetres. The attenuation network is evaluated once for all transmitters (the same function). Transmittance is the
exponential of a sum, without the 1e-10 that keeps a product from 0. Rays start at the moving array if the receiver moves.

The quick preset is sized for two cores. The values of the publication are in parentheses.

- Width 64 (256), 24 samples (64), 7 frequency bands (10).
- 3,000 steps (30,000) of 16 spectra that share 64 rays (8,192 of any spectra).
- Rate 3e-3 (8e-4), which decays once (three times), clipped gradients, no weight decay (5e-5).
- Averaged parameters (the last).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.choices import Moving
from swiftwrf.comparison.base import Config, Count, Depth, TrainedModel, Training
from swiftwrf.comparison.network import LinkNetwork, chunks, draw_parameters
from swiftwrf.comparison.volume import Medium, integrate
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.base import FIXED_END
from swiftwrf.models.mlp import SkipMLP, encode
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration

MAX_SAMPLES_AT_ONCE = 2**19  # samples of the field evaluated at a time, which bounds the memory
MAX_SAMPLES_ON_CPU = 2**16  # the same on a CPU: layers of more samples leave its caches


@configuration
class NeRF2Size:
    """Size of the network and its rays.

    Example:
        >>> NeRF2Size(width=32, samples=12).width
        32
    """

    width: Count = 64
    """width of the layers"""
    depth: Depth = 8
    """layers of the attenuation network"""
    bands: Count = 7
    """frequencies of the encodings"""
    samples: Count = 24
    """samples along a ray"""
    reach: PositiveFloat = 5.0
    """length of a ray [m]"""


@configuration
class NeRF2Config(Config):
    """Options of `NeRF2`.

    Example:
        >>> NeRF2(NeRF2Config(size=NeRF2Size(width=32), rays=128)).config.rays
        128
    """

    size: NeRF2Size = NeRF2Size()
    steps: PositiveInt = 3000
    batch: PositiveInt = 16
    rate: PositiveFloat = 3e-3
    check_every: PositiveInt = 100
    rays: PositiveInt = 64
    """rays per spectrum and step"""
    shared_rays: bool = True
    """the spectra of a step share their rays"""
    weight_decay: NonNegativeFloat = 0.0
    """weight decay of Adam"""
    compiled: bool = False
    """compile the network with torch.compile, which needs a C++ compiler, or Triton on a GPU"""

    @classmethod
    def paper(cls, **changes: Any) -> NeRF2Config:
        paper = cls(
            size=NeRF2Size(width=256, bands=10, samples=64),
            steps=30_000,
            batch=8192,
            rays=1,
            shared_rays=False,
            rate=8e-4,
            warm_up=1,
            final_rate=1e-6 / 8e-4,
            decay_steps=10_000,  # a cosine: the rate rises again until 20,000
            averaging=0.0,
            clip=math.inf,
            weight_decay=5e-5,
            check_every=500,
        )
        return replace(paper, **changes)

    def training(self, train: Spectra, device: torch.device) -> NeRF2Training:
        return NeRF2Training(self, train, device)


class Field(nn.Module):
    """Networks of the attenuation and of the emission at a point.

    An eight-layer network predicts absorption and phase shift. A three-layer network on its features, the ray's direction
    and the transmitter's position predicts the emission. Amplitudes are |leaky_relu|, phases 2 pi sigmoid.
    """

    def __init__(self, size: NeRF2Size) -> None:
        super().__init__()
        self.bands = size.bands
        inputs, width = 3 * (2 * size.bands + 1), size.width
        self.layers = SkipMLP(inputs, width, size.depth)
        self.attenuation = nn.Linear(width, 2)
        self.feature = nn.Linear(width, width)
        self.mixing = nn.Linear(width + 2 * inputs, width)
        self.emission = nn.Sequential(nn.ReLU(), nn.Linear(width, width // 2), nn.ReLU(), nn.Linear(width // 2, 2))

    def forward(self, point: Tensor, direction: Tensor, transmitter: Tensor) -> Medium:
        """Return the medium at points (..., 3) [m] for directions (..., 3) and transmitters (..., 3) [m]; these broadcast.

        The layer on the concatenation of feature, direction and transmitter is computed as a sum of three layers, so that
        each is evaluated for its own shape before broadcasting.
        """
        x = encode(point, self.bands, lowest=1.0)
        h = self.layers(x)
        absorption, turning = _polar(self.attenuation(h))
        sizes = [h.shape[-1], x.shape[-1], x.shape[-1]]
        of_feature, of_direction, of_transmitter = self.mixing.weight.split(sizes, dim=1)
        mixed = functional.linear(self.feature(h), of_feature, self.mixing.bias)
        mixed = mixed + functional.linear(encode(direction, self.bands, lowest=1.0), of_direction)
        mixed = mixed + functional.linear(encode(transmitter, self.bands, lowest=1.0), of_transmitter)
        return Medium(absorption, turning, *_polar(self.emission(mixed)))


def _polar(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Return amplitude and phase of raw outputs (..., 2)."""
    return functional.leaky_relu(raw[..., 0]).abs(), 2 * math.pi * torch.sigmoid(raw[..., 1])


class NeRF2Network(LinkNetwork):
    """Magnitude of the integral along a ray from the receiver, for each direction."""

    def __init__(self, size: NeRF2Size, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid, moving)
        self.field = Field(size)

    def forward(self, transmitter: Tensor, receiver: Tensor, direction: Tensor) -> Tensor:
        """Return magnitudes (P, D) at P positions of the moving end.

        Args:
            transmitter: Positions (P or 1, 3), see `Link`.
            receiver: Positions (P or 1, 3).
            direction: Directions of the rays in world coordinates, (P or 1, D, 3).
        """
        return torch.hypot(*received(self.field, self.size, transmitter[:, None], receiver[:, None], direction))

    def render(self, position: Tensor, grid: AngularGrid, generator: torch.Generator | None = None) -> Tensor:
        ends = self.link(position)
        direction = self.link.to_world(grid.direction.flatten(0, 1).to(position.device))
        samples = MAX_SAMPLES_ON_CPU if direction.device.type == "cpu" else MAX_SAMPLES_AT_ONCE
        parts = chunks(len(direction), max(1, samples // (len(position) * self.size.samples)))
        return torch.cat([self(*ends, direction[None, part]) for part in parts], dim=1).reshape(-1, *grid.shape)


def received(field: Field, size: NeRF2Size, transmitter: Tensor, receiver: Tensor, direction: Tensor) -> Tensor:
    """Return real and imaginary part of the signal of rays, (2, ...).

    Args:
        field: Field that the rays cross.
        size: Number of samples and length of a ray.
        transmitter: Position of the transmitter, (..., 3). All three broadcast.
        receiver: Start of each ray, (..., 3).
        direction: Direction of each ray, (..., 3).
    """
    distance = torch.linspace(0, size.reach, size.samples, device=direction.device)
    point = receiver[..., None, :] + distance[:, None] * direction[..., None, :]
    return integrate(field(point, direction[..., None, :], transmitter[..., None, :]), distance)


class NeRF2Training(Training[NeRF2Config, NeRF2Network]):
    """Minimisation of the squared error of magnitudes on random rays."""

    def __init__(self, config: NeRF2Config, train: Spectra, device: torch.device) -> None:
        model = NeRF2Network.of(config.size, train)
        draw_parameters(model, torch.Generator().manual_seed(config.seed))
        super().__init__(config, model.to(device), betas=(0.9, 0.999), weight_decay=config.weight_decay)
        if config.compiled:
            model.field.compile()
        self.position, self.spectrum = train.position, train.spectrum.flatten(1).to(device)
        self.direction = model.link.to_world(train.grid.direction.flatten(0, 1).to(device))

    def objective(self) -> Tensor:
        config, generator = self.config, self.generator()
        row = torch.randint(len(self.position), (config.batch,), generator=generator)
        rays = (1 if config.shared_rays else config.batch, config.rays)
        pixel = torch.randint(len(self.direction), rays, generator=generator).to(self.spectrum.device)
        predicted = self.model(*self.model.link(self.position[row]), self.direction[pixel])
        measured = self.spectrum[row.to(pixel.device)[:, None], pixel]
        return functional.mse_loss(predicted, measured)


class NeRF2(TrainedModel):
    """Neural radio-frequency radiance field.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> NeRF2(size=NeRF2Size(width=8, samples=6), steps=1).fit(room).predict(room.position[:2]).mean.shape
        torch.Size([2, 30, 120])
    """

    name = "nerf2"
    kind = "nerf2 model"
    config_type = NeRF2Config
    network_type = NeRF2Network
    requires = (FIXED_END,)
    any_grid = True
