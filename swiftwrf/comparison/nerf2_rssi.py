"""NeRF2 for RSSI: one field for all receivers, the signal of all rays averaged.

    rssi = 100 (a - 1) dBm,    a = |mean over the rays of S|

with S as in `swiftwrf.comparison.volume` (X. Zhao et al., "NeRF2", 2023). `NeRF2RssiConfig.paper()` has the field of its
code and 36 x 9 rays over the upper half space. (That code averages a ninth of them, by a slip of an index.) The mean before
the magnitude, the batch and the number of steps are not from the publication.

The quick preset is sized for two cores. The values of the publication are in parentheses.

- Width 32 (256), 8 samples (64), 4 frequency bands (10), 6 x 3 rays (36 x 9).
- 2,400 steps of 32 positions at rate 5e-3 (8e-4), which decays, clipped gradients, no weight decay.
- Averaged parameters (the last).
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, Training, descend
from swiftwrf.comparison.nerf2 import MAX_SAMPLES_ON_CPU, Field, NeRF2Size, received
from swiftwrf.comparison.network import chunks, draw_parameters, restored
from swiftwrf.data.rssi import Rssi
from swiftwrf.models.base import check_finite
from swiftwrf.positions import frame, normalise
from swiftwrf.rssi.base import RssiFitContext, RssiPredictor, fingerprint
from swiftwrf.runtime.checkpoint import Header, Saved
from swiftwrf.runtime.options import from_plain
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration


@configuration
class NeRF2RssiSize(NeRF2Size):
    """Size of the network and its rays.

    Example:
        >>> NeRF2RssiSize(azimuths=8).azimuths
        8
    """

    width: Count = 32
    bands: Count = 4
    samples: Count = 8
    azimuths: Count = 6
    """azimuths of the rays"""
    elevations: Count = 3
    """elevations of the rays"""


@configuration
class NeRF2RssiConfig(Config):
    """Options of `NeRF2Rssi`; a batch consists of transmitter positions.

    Example:
        >>> NeRF2Rssi(NeRF2RssiConfig(weight_decay=1e-4)).config.weight_decay
        0.0001
    """

    size: NeRF2RssiSize = NeRF2RssiSize()
    steps: PositiveInt = 2400
    batch: PositiveInt = 32
    rate: PositiveFloat = 5e-3
    weight_decay: NonNegativeFloat = 0.0
    """weight decay of Adam"""

    @classmethod
    def paper(cls, **changes: Any) -> NeRF2RssiConfig:
        paper = cls(
            size=NeRF2RssiSize(width=256, bands=10, samples=64, azimuths=36, elevations=9),
            steps=30_000,
            batch=8,
            rate=8e-4,
            warm_up=1,
            final_rate=1e-6 / 8e-4,
            decay_steps=10_000,
            averaging=0.0,
            clip=math.inf,
            weight_decay=5e-5,
            check_every=500,
        )
        return replace(paper, **changes)

    def training(self, train: Rssi, device: torch.device) -> NeRF2RssiTraining:
        return NeRF2RssiTraining(self, train, device)


class NeRF2RssiNetwork(nn.Module):
    """The field and the positions of the receivers in it.

    Args:
        size: Size of the field and its rays.
        n_receivers: Number of receivers R.
    """

    def __init__(self, size: NeRF2RssiSize, n_receivers: int) -> None:
        super().__init__()
        self.size, self.field = size, Field(size)
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("receiver", torch.zeros(n_receivers, 3, dtype=torch.float64))

    centre: Tensor
    receiver: Tensor

    def forward(self, transmitter: Tensor) -> Tensor:
        """Return amplitudes (n, R) with the transmitter at positions (n, 3) [m from the centre]."""
        grid = AngularGrid.hemisphere(self.size.elevations, self.size.azimuths)
        receiver = self.local(self.receiver)[:, None]
        direction = grid.direction.flatten(0, 1).to(receiver)
        signal = received(self.field, self.size, transmitter[:, None, None], receiver, direction)
        return torch.hypot(*signal.mean(dim=-1))

    def local(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] relative to the centre, float32."""
        return normalise(position.to(self.centre.device), self.centre, 1.0)


class NeRF2Rssi(RssiPredictor, Saved):
    """A neural field for all receivers, its rays averaged; predictions are differentiable in the position.

    Args:
        config: Options as one object. Defaults to `NeRF2RssiConfig()`.
        preset: "quick" for the defaults, "paper" for `NeRF2RssiConfig.paper()`.
        options: Single options, which replace those of `config`.

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

    network: NeRF2RssiNetwork

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        owner = fingerprint(self.config, train, train)
        training = self.config.training(train, context.device)
        self.network = descend(training, owner, context.checkpoint, context.on_record, context.progress).cpu()

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        network = self.network
        rays = network.size.azimuths * network.size.elevations * network.size.samples * max(len(network.receiver), 1)
        some = chunks(len(position), max(1, MAX_SAMPLES_ON_CPU // rays))
        parts = [network(network.local(position[part])) for part in some]
        empty = torch.zeros(0, len(network.receiver))
        return check_finite(100 * (torch.cat([empty, *parts]).double() - 1)), None

    def state(self) -> tuple[dict[str, Tensor], Header]:
        self.check_fitted()
        return self.network.state_dict(), {"options": asdict(self.config), "receiver_names": self.receiver_names}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Self:
        model = cls(from_plain(NeRF2RssiConfig, header["options"]))
        model.receiver_names = tuple(map(str, header["receiver_names"]))
        model.network = restored(lambda: NeRF2RssiNetwork(model.config.size, len(model.receiver_names)), tensors)
        return model


class NeRF2RssiTraining(Training[NeRF2RssiConfig, NeRF2RssiNetwork]):
    """Descent of the squared error of amplitudes where RSSI was detected."""

    def __init__(self, config: NeRF2RssiConfig, train: Rssi, device: torch.device) -> None:
        model = NeRF2RssiNetwork(config.size, len(train.receiver_names))
        draw_parameters(model, torch.Generator().manual_seed(config.seed))
        model.centre, _ = frame(train.transmitter_position)
        model.receiver = train.receiver_position.double()
        super().__init__(config, model.to(device), betas=(0.9, 0.999), weight_decay=config.weight_decay)
        detected = (~train.rssi_dbm.isnan()).any(dim=1)
        self.position = model.local(train.transmitter_position[detected])
        self.amplitude = (1 + train.rssi_dbm[detected] / 100).float().to(device)

    def objective(self) -> Tensor:
        row = torch.randint(len(self.position), (self.config.batch,), generator=self.generator()).to(
            self.position.device
        )
        measured = self.amplitude[row]
        detected = ~measured.isnan()
        return functional.mse_loss(self.model(self.position[row])[detected], measured[detected])
