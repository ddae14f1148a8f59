"""NeRF2 for RSSI: one field for all receivers, the signal of all rays averaged.

    rssi = 100 (a - 1) dBm,    a = |mean over the rays of S|

with S as in `swiftwrf.comparison.nerf2` (X. Zhao et al., "NeRF2", 2023). `NeRF2RssiConfig.paper()` has the field of its
code and 36 x 9 rays over the upper half space. (That code averages a ninth of them, by a slip of an index.) The mean before
the magnitude, the batch and the number of steps are not from the publication.

The quick preset is sized for two cores. The values of the publication are in parentheses.

- Width 32 (256), 8 samples (64), 4 frequency bands (10), 6 x 3 rays (36 x 9).
- 2,400 steps of 32 positions at rate 5e-3 (8e-4), which decays, clipped gradients, no weight decay.
- Averaged parameters (the last).
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Config, Count, Depth, Training, draw_parameters, restored
from swiftwrf.comparison.nerf2 import MAX_SAMPLES_ON_CPU, Field, received
from swiftwrf.data.rssi import Rssi
from swiftwrf.models.base import CPU, check_finite
from swiftwrf.positions import frame, normalise
from swiftwrf.rssi.base import RssiPredictor, fingerprint
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.validation import NonNegativeFloat, PositiveFloat, PositiveInt, configuration, from_plain


@configuration
class NeRF2RssiConfig(Config):
    """Options of `NeRF2Rssi`; a batch consists of transmitter positions.

    Example:
        >>> NeRF2Rssi(NeRF2RssiConfig(weight_decay=1e-4)).config.weight_decay
        0.0001
    """

    published: ClassVar[dict[str, Any]] = {
        "width": 256,
        "bands": 10,
        "samples": 64,
        "azimuths": 36,
        "elevations": 9,
        "steps": 30_000,
        "batch": 8,
        "rate": 8e-4,
        "warm_up": 1,
        "final_rate": 1e-6 / 8e-4,
        "decay_steps": 10_000,
        "averaging": 0.0,
        "clip": math.inf,
        "weight_decay": 5e-5,
        "check_every": 500,
    }

    width: Count = 32
    """width of the layers"""
    depth: Depth = 8
    """layers of the attenuation network"""
    bands: Count = 4
    """frequencies of the encodings"""
    samples: Count = 8
    """samples along a ray"""
    reach: PositiveFloat = 5.0
    """length of a ray [m]"""
    azimuths: Count = 6
    """azimuths of the rays"""
    elevations: Count = 3
    """elevations of the rays"""
    steps: PositiveInt = 2400
    batch: PositiveInt = 32
    rate: PositiveFloat = 5e-3
    weight_decay: NonNegativeFloat = 0.0
    """weight decay of Adam"""


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

    field: Field
    centre: Tensor
    """centre of the box around the training positions, (3,) [m]"""
    receiver: Tensor
    """positions of the receivers, (R, 3) [m]"""

    def _fit(self, train: Rssi, *, device: torch.device = CPU, **arguments: Any) -> None:
        self.centre, self.receiver = frame(train.transmitter_position)[0], train.receiver_position.double()
        owner = fingerprint(self.config, train, train)
        self.field = self._training(train, device).trained(owner, **arguments).cpu()

    def _training(self, train: Rssi, device: torch.device) -> Training[Field]:
        """Return the descent of the squared error of amplitudes where RSSI was detected."""
        config, field = self.config, self._blank()
        draw_parameters(field, torch.Generator().manual_seed(config.seed))
        detected = (~train.rssi_dbm.isnan()).any(dim=1)
        position = train.transmitter_position[detected]
        amplitude = (1 + train.rssi_dbm[detected] / 100).float().to(device)

        def loss(field: Field, generator: torch.Generator) -> Tensor:
            row = torch.randint(len(position), (config.batch,), generator=generator)
            measured = amplitude[row.to(device)]
            known = ~measured.isnan()
            return functional.mse_loss(self._amplitude(field, position[row].to(device))[known], measured[known])

        return Training(config, field.to(device), loss, betas=(0.9, 0.999), weight_decay=config.weight_decay)

    def _blank(self) -> Field:
        return Field(self.config.width, self.config.depth, self.config.bands)

    def _amplitude(self, field: Field, position: Tensor) -> Tensor:
        """Return amplitudes (n, R) with the transmitter at positions (n, 3) [m]."""
        config, centre = self.config, self.centre.to(position.device)
        transmitter, receiver = (normalise(x.to(centre), centre, 1.0) for x in (position, self.receiver))
        direction = AngularGrid.hemisphere(config.elevations, config.azimuths).direction.flatten(0, 1).to(receiver)
        ends = transmitter[:, None, None], receiver[:, None]
        return torch.hypot(*received(field, config.reach, config.samples, *ends, direction).mean(dim=-1))

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        config, n_receivers = self.config, len(self.receiver)
        n_samples = config.azimuths * config.elevations * config.samples * max(n_receivers, 1)
        some = position.split(max(1, MAX_SAMPLES_ON_CPU // n_samples))
        amplitude = torch.cat([self._amplitude(self.field, part) for part in some])
        return check_finite(100 * (amplitude.double() - 1)), None

    def state(self) -> tuple[dict[str, Tensor], Header]:
        self.check_fitted()
        tensors = self.field.state_dict() | {"centre": self.centre, "receiver": self.receiver}
        return tensors, {"options": asdict(self.config), "receiver_names": self.receiver_names}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Self:
        model = cls(from_plain(NeRF2RssiConfig, header["options"]))
        model.receiver_names = tuple(map(str, header["receiver_names"]))
        ends = {name: tensors.pop(name) for name in ("centre", "receiver")}
        expect(ends, {"centre": (3,), "receiver": (len(model.receiver_names), 3)})
        model.centre, model.receiver = (end.double() for end in ends.values())
        model.field = restored(model._blank, tensors)
        return model
