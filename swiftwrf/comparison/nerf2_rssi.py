"""NeRF2 for RSSI: one field for all receivers, the signal of all rays averaged.

    rssi = 100 (a - 1) dBm,    a = |mean over the rays of S|

with S as in `swiftwrf.comparison.volume` (X. Zhao et al., "NeRF2", 2023). `NeRF2RssiConfig.paper()` has the field of its
code and 36 x 9 rays over the upper half space (the code averages a ninth of them, by a slip of an index); that the mean is
taken before the magnitude, the batch and the number of steps are ours.

Changed in the quick preset, sized for two cores: 32 wide (256), 8 samples (64), 4 frequency bands (10), 6 x 3 rays (36 x 9),
2,400 steps of 32 positions at rate 5e-3 (8e-4) that decays, averaged parameters (the last), gradients clipped, no weight
decay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Training, descend
from swiftwrf.comparison.drawing import chunks, draw_parameters, restored
from swiftwrf.comparison.nerf2 import SAMPLES_AT_ONCE, Field, NeRF2Size, received
from swiftwrf.data.rssi import Rssi
from swiftwrf.positions import check_drawn, check_positions, frame, normalise
from swiftwrf.rssi.prepare import check
from swiftwrf.rssi.state import fingerprint
from swiftwrf.runtime.checkpoint import Header, Saved
from swiftwrf.runtime.session import Record


@dataclass(frozen=True)
class NeRF2RssiSize(NeRF2Size):
    """Of the network and its rays."""

    width: int = 32
    bands: int = 4
    samples: int = 8
    azimuths: int = 6
    """of rays"""
    elevations: int = 3
    """likewise"""


@dataclass(frozen=True)
class NeRF2RssiConfig(Config[NeRF2RssiSize, "NeRF2Rssi"]):
    """How NeRF2 is fitted to RSSI; a batch is of transmitter positions."""

    size: NeRF2RssiSize = NeRF2RssiSize()
    steps: int = 2400
    batch: int = 32
    rate: float = 5e-3
    weight_decay: float = 0.0

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


class NeRF2Rssi(nn.Module, Saved):
    """RSSI at every receiver from the transmitter's position.

    Args:
        size: of the model.
        n_receivers: R.
    """

    kind: ClassVar[str] = "nerf2 rssi model"

    def __init__(self, size: NeRF2RssiSize, n_receivers: int) -> None:
        super().__init__()
        self.size, self.field = size, Field(size)
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("receiver", torch.zeros(n_receivers, 3, dtype=torch.float64))

    centre: Tensor
    receiver: Tensor

    def forward(self, transmitter: Tensor, receiver: Tensor) -> Tensor:
        """Amplitudes a (n, R) with transmitters (n, 3) and receivers (R, 3) [m from the centre]."""
        grid = AngularGrid.hemisphere(self.size.elevations, self.size.azimuths)
        direction = grid.direction.flatten(0, 1).to(receiver)
        signal = received(self.field, self.size, transmitter[:, None, None], receiver[:, None], direction)
        return torch.hypot(*signal.mean(dim=-1))

    def local(self, position: Tensor) -> Tensor:
        """Positions (n, 3) [m] from the centre, float32."""
        return normalise(position.to(self.centre.device), self.centre, 1.0)

    @torch.no_grad()
    def predict(self, position: Tensor) -> Tensor:
        """RSSI [dBm] at every receiver, float64 (n, R), with the transmitter at positions (n, 3) [m].

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position, receiver = check_positions(position), self.local(self.receiver)
        rays = self.size.azimuths * self.size.elevations * self.size.samples * max(len(receiver), 1)
        some = chunks(len(position), max(1, SAMPLES_AT_ONCE // rays))
        parts = [self(self.local(position[part]), receiver).cpu() for part in some]
        return check_drawn(100 * (torch.cat([torch.zeros(0, len(receiver)), *parts]).double() - 1))

    def state(self) -> tuple[dict[str, Tensor], Header]:
        return self.state_dict(), {"size": asdict(self.size)}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> NeRF2Rssi:
        size = NeRF2RssiSize(**header["size"])
        size.check()
        return restored(lambda: cls(size, len(tensors["receiver"])), tensors)


class NeRF2RssiTraining(Training[NeRF2RssiConfig, NeRF2Rssi]):
    """By the squared error of amplitudes where RSSI was heard."""

    def __init__(self, config: NeRF2RssiConfig, train: Rssi, device: torch.device) -> None:
        model = NeRF2Rssi(config.size, len(train.receiver_names))
        draw_parameters(model, torch.Generator().manual_seed(config.seed))
        model.centre, _ = frame(train.transmitter_position)
        model.receiver = train.receiver_position.double()
        super().__init__(config, model.to(device), betas=(0.9, 0.999), weight_decay=config.weight_decay)
        heard = (~train.rssi_dbm.isnan()).any(dim=1)
        self.position = model.local(train.transmitter_position[heard])
        self.amplitude = (1 + train.rssi_dbm[heard] / 100).float().to(device)

    def objective(self) -> Tensor:
        row = torch.randint(len(self.position), (self.config.batch,), generator=self.generator()).to(
            self.position.device
        )
        measured = self.amplitude[row]
        heard = ~measured.isnan()
        predicted = self.model(self.position[row], self.model.local(self.model.receiver))
        return functional.mse_loss(predicted[heard], measured[heard])


def fit_rssi(
    train: Rssi,
    config: NeRF2RssiConfig,
    *,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[Record], None] | None = None,
    progress: bool = True,
) -> NeRF2Rssi:
    """Fits all receivers; arguments as of `swiftwrf.comparison.fit`.

    Raises:
        InputError: fewer than 10 measurements in all, something not finite, or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite, or a fit that ends worse than it began.
    """
    check(train, train)
    training = config.training(train, torch.device(device))
    return descend(training, fingerprint(config, train, train), checkpoint, on_record, progress)
