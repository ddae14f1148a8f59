"""NeRF2: a network of absorption, phase shift and emission in space, integrated along rays, for spectra and for RSSI.

X. Zhao, Z. An, Q. Pan and L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM MobiCom 2023. `NeRF2Config.paper()`
has the sizes, rates and steps of its code: 690,564 parameters, 64 samples over 5 m, 8,192 single rays a step.

    S = sum_i a_i exp(j phi_i) g(r_(i+1)) prod_(k < i) exp(-alpha_k d_k) exp(j (1 + sum_(k < i) beta_k d_k))

with samples at distances r_i from the receiver, d_i = r_(i+1) - r_i, g(r) = 0.025 / r, absorption alpha [1/m], phase
change beta [rad/m], emitted amplitude a and phase phi. The last sample has no next one and contributes nothing.

Changed everywhere: positions are relative to the centre of the training positions, so that map coordinates keep their
millimetres. The attenuation network is evaluated once for all transmitters (the same function). Transmittance is the
exponential of a sum, without the 1e-10 that keeps a product from 0. Rays start at the moving array if the receiver moves.

For RSSI all receivers have one field, and the signal of all rays is averaged:

    rssi = 100 (a - 1) dBm,    a = |mean over the rays of S|

`NeRF2RssiConfig.paper()` has the field of the publication's code and 36 x 9 rays over the upper half space. (That code
averages a ninth of them, by a slip of an index.) The mean before the magnitude, the batch and the number of steps are not
from the publication.

The quick presets are sized for two cores. The values of the publication are in parentheses.

- Width 64, for RSSI 32 (256), 24 and 8 samples (64), 7 and 4 frequency bands (10).
- 3,000 steps (30,000) of 16 spectra that share 64 rays (8,192 of any spectra), or 2,400 steps of 32 positions at 6 x 3 rays.
- Rate 3e-3 and 5e-3 (8e-4), which decays once (three times), clipped gradients, no weight decay (5e-5).
- Averaged parameters (the last).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.contrib.published.base import Config, Count, Depth, TrainedModel, Training
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.models.base import CPU, FIXED_END, check_predicted
from swiftwrf.models.mlp import SkipMLP, draw_parameters, encode
from swiftwrf.positions import centre_and_half_side, normalise
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration

MAX_SAMPLES = {
    "cpu": 2**16,
    "cuda": 2**19,
}  # of all rays at a time: layers of more leave the caches, or fill the memory
PATH_GAIN = 0.025  # [m] amplitude times distance, from the publication's code
FIRST_PHASE = 1.0  # [rad], from the publication's code

Medium = tuple[Tensor, Tensor, Tensor, Tensor]
"""absorption [1/m], phase change [rad/m], emitted amplitude and phase [rad] at samples (..., S) along rays"""


@configuration
class NeuralFieldConfig(Config):
    """Options of a neural field."""

    published: ClassVar[dict[str, Any]] = {
        "width": 256,
        "bands": 10,
        "samples": 64,
        "steps": 30_000,
        "rate": 8e-4,
        "warm_up": 1,
        "final_rate": 1e-6 / 8e-4,
        "decay_steps": 10_000,  # a cosine: the rate rises again until 20,000
        "averaging": 0.0,
        "clip": math.inf,
        "weight_decay": 5e-5,
        "check_every": 500,
    }

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
    weight_decay: NonNegativeFloat = 0.0
    """weight decay of Adam"""


@configuration
class NeRF2Config(NeuralFieldConfig):
    """Options of `NeRF2`."""

    published = NeuralFieldConfig.published | {"batch": 8192, "rays": 1, "shared_rays": False}

    steps: PositiveInt = 3000
    rate: PositiveFloat = 3e-3
    check_every: PositiveInt = 100
    rays: PositiveInt = 64
    """rays per spectrum and step"""
    shared_rays: bool = True
    """the spectra of a step share their rays"""


@configuration
class NeRF2RssiConfig(NeuralFieldConfig):
    """Options of `NeRF2Rssi`; a batch consists of transmitter positions."""

    published = NeuralFieldConfig.published | {"azimuths": 36, "elevations": 9, "batch": 8}

    width: Count = 32
    bands: Count = 4
    samples: Count = 8
    azimuths: Count = 6
    """azimuths of the rays"""
    elevations: Count = 3
    """elevations of the rays"""
    steps: PositiveInt = 2400
    batch: PositiveInt = 32
    rate: PositiveFloat = 5e-3


class Field(nn.Module):
    """Networks of the attenuation and of the emission at a point.

    A network of `depth` layers predicts absorption and phase change. A three-layer network on its features, the ray's
    direction and the transmitter's position predicts the emission. Amplitudes are |leaky_relu|, phases 2 pi sigmoid.

    Args:
        width, depth, bands: See `NeRF2Config`.
    """

    def __init__(self, width: int, depth: int, bands: int) -> None:
        super().__init__()
        self.bands = bands
        inputs = 3 * (2 * bands + 1)
        self.layers = SkipMLP(inputs, width, depth)
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
        return absorption, turning, *_polar(self.emission(mixed))


def _polar(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Return amplitude and phase of raw outputs (..., 2)."""
    return functional.leaky_relu(raw[..., 0]).abs(), 2 * math.pi * torch.sigmoid(raw[..., 1])


def received(
    field: nn.Module, reach: float, samples: int, transmitter: Tensor, receiver: Tensor, direction: Tensor
) -> Tensor:
    """Return real and imaginary part of the signal of rays, (2, ...).

    Args:
        field: Field that the rays cross.
        reach: Length of a ray [m].
        samples: Number of samples of a ray.
        transmitter: Position of the transmitter, (..., 3). All three broadcast.
        receiver: Start of each ray, (..., 3).
        direction: Direction of each ray, (..., 3).
    """
    distance = torch.linspace(0, reach, samples, device=direction.device)
    point = receiver[..., None, :] + distance[:, None] * direction[..., None, :]
    return integrate(field(point, direction[..., None, :], transmitter[..., None, :]), distance)


def integrate(medium: Medium, distance: Tensor) -> Tensor:
    """Return real and imaginary part of the signal of each ray, (2, ...).

    Args:
        medium: Medium at samples (..., S).
        distance: Distances of the samples from the receiver [m], ascending, (S,).
    """
    step = distance.diff()
    # the last sample neither attenuates another one nor emits
    absorption, turning, amplitude, phase = (value[..., :-1] for value in medium)
    depth, turned = absorption * step, turning * step
    before = torch.cumsum(depth, dim=-1) - depth
    arriving = amplitude * (PATH_GAIN / distance[1:]) * torch.exp(-before)
    angle = phase + FIRST_PHASE + torch.cumsum(turned, dim=-1) - turned
    return torch.stack([(arriving * torch.cos(angle)).sum(dim=-1), (arriving * torch.sin(angle)).sum(dim=-1)])


class NeRF2(TrainedModel):
    """Neural radio-frequency radiance field: the magnitude of the integral along the ray of each direction.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20)
        >>> NeRF2(width=8, samples=6, steps=1).fit(room).predict(room.position[:2]).mean.shape
        torch.Size([2, 30, 120])
    """

    name = "nerf2"
    kind = "nerf2 model"
    config_type = NeRF2Config
    requires = (FIXED_END,)
    any_grid = True

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> Field:
        return Field(self.config.width, self.config.depth, self.config.bands)

    def training(self, train: Spectra, device: torch.device) -> Training[Field]:
        """Return the descent of the squared error of magnitudes on random rays."""
        config, field = self.config, self.blank()
        draw_parameters(field, torch.Generator().manual_seed(config.seed))
        position, spectrum = train.position, train.spectrum.flatten(1).to(device)
        direction = self._to_world(train.grid, device)

        def loss(field: Field, generator: torch.Generator) -> Tensor:
            row = torch.randint(len(position), (config.batch,), generator=generator)
            rays = (1 if config.shared_rays else config.batch, config.rays)
            pixel = torch.randint(len(direction), rays, generator=generator).to(device)
            predicted = self._magnitude(field, *self.ends(position[row], device), direction[pixel])
            return functional.mse_loss(predicted, spectrum[row.to(device)[:, None], pixel])

        return Training(config, field.to(device), loss, betas=(0.9, 0.999), weight_decay=config.weight_decay)

    def render(self, network: Field, position: Tensor, grid: AngularGrid) -> Tensor:
        ends, direction = self.ends(position, position.device), self._to_world(grid, position.device)
        samples = max(1, len(position)) * self.config.samples
        parts = direction.split(max(1, MAX_SAMPLES[direction.device.type] // samples))
        magnitudes = [self._magnitude(network, *ends, part[None]) for part in parts]
        return torch.cat(magnitudes, dim=1).reshape(-1, *grid.shape)

    def _magnitude(self, field: Field, transmitter: Tensor, receiver: Tensor, direction: Tensor) -> Tensor:
        """Return magnitudes (P, D) at P positions of the moving end for rays (P or 1, D, 3) in world coordinates."""
        ends = transmitter[:, None], receiver[:, None]
        return torch.hypot(*received(field, self.config.reach, self.config.samples, *ends, direction))

    def _to_world(self, grid: AngularGrid, device: torch.device) -> Tensor:
        """Return the directions of the pixels in world coordinates, float32 (H W, 3)."""
        return (grid.direction.flatten(0, 1).to(device, torch.float64) @ self.rotation.T.to(device)).float()


class NeRF2Rssi(RssiPredictor, Saved):
    """A neural field for all receivers, its rays averaged; predictions are differentiable in the position.

    Example:
        >>> import swiftwrf
        >>> model = NeRF2Rssi(steps=1, batch=4).fit(swiftwrf.rssi_room(n=20))
        >>> model.predict(torch.zeros(1, 3)).mean.shape
        torch.Size([1, 12])
    """

    kind: ClassVar[str] = "nerf2 rssi model"
    name = "nerf2"
    config_type = NeRF2RssiConfig
    requires_receiver_position = True
    slow = True

    saved = "field centre"
    field: Field
    centre: Annotated[Tensor, "float64 3"]
    """centre of the box around the training positions [m]"""

    def _fit(self, train: Rssi, *, device: torch.device = CPU, progress: bool = False, **_: Any) -> None:
        """Descend the squared error of amplitudes where RSSI was detected."""
        self.centre = centre_and_half_side(train.transmitter_position)[0]
        config, field = self.config, self.blank()
        draw_parameters(field, torch.Generator().manual_seed(config.seed))
        detected = (~train.rssi_dbm.isnan()).any(dim=1)
        position = train.transmitter_position[detected]
        amplitude = (1 + train.rssi_dbm[detected] / 100).float().to(device)

        def loss(field: Field, generator: torch.Generator) -> Tensor:
            row = torch.randint(len(position), (config.batch,), generator=generator)
            measured = amplitude[row.to(device)]
            known = ~measured.isnan()
            return functional.mse_loss(self._amplitude(field, position[row].to(device))[known], measured[known])

        training = Training(config, field.to(device), loss, betas=(0.9, 0.999), weight_decay=config.weight_decay)
        self.field = training.run("", progress=progress).cpu()

    def blank(self, saved: Mapping[str, Tensor] | None = None) -> Field:
        return Field(self.config.width, self.config.depth, self.config.bands)

    def _amplitude(self, field: Field, position: Tensor) -> Tensor:
        """Return amplitudes (n, R) with the transmitter at positions (n, 3) [m]."""
        config, centre = self.config, self.centre.to(position.device)
        transmitter, receiver = (normalise(x.to(centre), centre, 1.0) for x in (position, self.receiver_position))
        direction = AngularGrid.hemisphere(config.elevations, config.azimuths).direction.flatten(0, 1).to(receiver)
        ends = transmitter[:, None, None], receiver[:, None]
        return torch.hypot(*received(field, config.reach, config.samples, *ends, direction).mean(dim=-1))

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        config, n_receivers = self.config, len(self.receiver_names)
        n_samples = config.azimuths * config.elevations * config.samples * max(n_receivers, 1)
        some = position.split(max(1, MAX_SAMPLES["cpu"] // n_samples))
        amplitude = torch.cat([self._amplitude(self.field, part) for part in some])
        return check_predicted(self, 100 * (amplitude.double() - 1), amplitude.shape), None
