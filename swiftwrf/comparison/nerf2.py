"""NeRF2: a network that says how space absorbs, turns and emits, and the sum along rays through it.

X. Zhao, Z. An, Q. Pan and L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM MobiCom 2023. `NeRF2Config.paper()`
has the sizes, rates and steps of its code: 690,564 parameters, 64 samples over 5 m, 8,192 single rays a step.

Changed everywhere: positions count from the centre of the training positions, for map coordinates would lose their
millimetres; what the attenuation network says of a point is computed once for all transmitters (the same function);
transmittance is the exponential of a sum, without the 1e-10 that keeps a product from 0; rays start at the moving array
where the receiver moves.

Changed in the quick preset, sized for two cores: 64 wide (256), 24 samples (64), 7 frequency bands (10), a step of 16
spectra that share 64 rays (8,192 of any spectra), 3,000 steps (30,000) at rate 3e-3 (8e-4) that decays once (three times),
averaged parameters (the last), gradients clipped, no weight decay (5e-5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Size, Training
from swiftwrf.comparison.drawing import Link, LinkDrawing, chunks, draw_parameters
from swiftwrf.comparison.layers import Layers
from swiftwrf.comparison.volume import Medium, integrate
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.models.swiftwrf.encoding import encode

SAMPLES_AT_ONCE = 2**19  # samples of the field evaluated at a time, which bounds the memory


@dataclass(frozen=True)
class NeRF2Size(Size):
    """Of the network and its rays."""

    width: int = 64
    """of the layers"""
    depth: int = 8
    """layers of the attenuation network"""
    bands: int = 7
    """frequencies of the encodings"""
    samples: int = 24
    """along a ray"""
    reach: float = 5.0
    """length of a ray [m]"""


@dataclass(frozen=True)
class NeRF2Config(Config[NeRF2Size, "NeRF2"]):
    """How NeRF2 is fitted."""

    size: NeRF2Size = NeRF2Size()
    steps: int = 3000
    batch: int = 16
    rate: float = 3e-3
    check_every: int = 100
    rays: int = 64
    """a spectrum and step"""
    shared_rays: bool = True
    """the spectra of a step have the same rays"""
    weight_decay: float = 0.0
    compiled: bool = False
    """compile the network (torch.compile; takes a C++ compiler, or Triton on a GPU)"""

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
    """Eight layers say how a point absorbs and turns the phase; three more, from what they know of the point, the direction
    and the transmitter, what it emits. Amplitudes are |leaky_relu|, phases 2 pi sigmoid."""

    def __init__(self, size: NeRF2Size) -> None:
        super().__init__()
        self.bands = size.bands
        inputs, width = 3 * (2 * size.bands + 1), size.width
        self.layers = Layers(inputs, width, size.depth)
        self.attenuation = nn.Linear(width, 2)
        self.feature = nn.Linear(width, width)
        self.mixing = nn.Linear(width + 2 * inputs, width)
        self.emission = nn.Sequential(nn.ReLU(), nn.Linear(width, width // 2), nn.ReLU(), nn.Linear(width // 2, 2))

    def forward(self, point: Tensor, direction: Tensor, transmitter: Tensor) -> Medium:
        """The field at points (..., 3) [m] seen along directions (..., 3) from transmitters (..., 3) [m], which broadcast.

        The layer that takes feature, direction and transmitter side by side is the sum of one for each, so that none is
        computed more often than it differs.
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
    """Amplitude and phase of two raw numbers (..., 2)."""
    return functional.leaky_relu(raw[..., 0]).abs(), 2 * math.pi * torch.sigmoid(raw[..., 1])


class NeRF2(LinkDrawing):
    """Magnitude of the sum along a ray from the receiver, in each direction.

    Args:
        size, grid, moving: see `LinkDrawing`.
    """

    kind: ClassVar[str] = "nerf2 model"
    size_type = NeRF2Size

    def __init__(self, size: NeRF2Size, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid, moving)
        self.field = Field(size)

    @classmethod
    def make(cls, size: NeRF2Size, train: Spectra, generator: torch.Generator) -> NeRF2:
        """At its start.

        Raises:
            InputError: the data do not say where the fixed end stands.
        """
        model = cls(size, train.grid, train.moving)
        model.link = Link.of(train)
        draw_parameters(model, generator)
        return model

    def forward(self, transmitter: Tensor, receiver: Tensor, direction: Tensor) -> Tensor:
        """Magnitudes (P, D) at P places of the moving end.

        Args:
            transmitter, receiver: as `Link` gives them, (P or 1, 3).
            direction: of the rays in world coordinates, (P or 1, D, 3).
        """
        return torch.hypot(*received(self.field, self.size, transmitter[:, None], receiver[:, None], direction))

    def synthesize(self, position: Tensor, grid: AngularGrid | None = None, batch: int = 64) -> Tensor:
        """Spectra at any positions; arguments, result and errors as of `SwiftWRF.synthesize`."""
        grid = grid or self.grid
        direction = self.link.to_world(grid.direction.flatten(0, 1).to(self.link.rotation.device))

        def draw(some: Tensor) -> Tensor:
            ends = self.link(some)
            parts = chunks(len(direction), max(1, SAMPLES_AT_ONCE // (len(some) * self.size.samples)))
            return torch.cat([self(*ends, direction[None, part]) for part in parts], dim=1).reshape(-1, *grid.shape)

        return self.drawn(position, grid, batch, draw)


def received(field: Field, size: NeRF2Size, transmitter: Tensor, receiver: Tensor, direction: Tensor) -> Tensor:
    """Real and imaginary part of what rays bring, (2, ...).

    Args:
        field: that they cross.
        size: number of samples and length of a ray.
        transmitter, receiver, direction: of each ray, (..., 3), which broadcast.
    """
    distance = torch.linspace(0, size.reach, size.samples, device=direction.device)
    point = receiver[..., None, :] + distance[:, None] * direction[..., None, :]
    return integrate(field(point, direction[..., None, :], transmitter[..., None, :]), distance)


class NeRF2Training(Training[NeRF2Config, NeRF2]):
    """On single rays: the squared error of magnitudes."""

    def __init__(self, config: NeRF2Config, train: Spectra, device: torch.device) -> None:
        model = NeRF2.make(config.size, train, torch.Generator().manual_seed(config.seed)).to(device)
        super().__init__(config, model, betas=(0.9, 0.999), weight_decay=config.weight_decay)
        if config.compiled:
            model.field.compile()
        self.position, self.spectrum = train.position, train.spectrum.flatten(1).to(device)
        self.direction = model.link.to_world(train.grid.direction.flatten(0, 1).to(device))

    def objective(self) -> Tensor:
        config, generator = self.config, self.generator()
        row = torch.randint(len(self.position), (config.batch,), generator=generator)
        rays = (1 if config.shared_rays else config.batch, config.rays)
        pixel = torch.randint(len(self.direction), rays, generator=generator).to(self.spectrum.device)
        drawn = self.model(*self.model.link(self.position[row]), self.direction[pixel])
        measured = self.spectrum[row.to(pixel.device)[:, None], pixel]
        return functional.mse_loss(drawn, measured)
