"""What is known of received power before any field: it falls with distance, and depends on the direction."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.positions import distance

NEAREST = 0.3  # [m] distances below it count as it: the law ends somewhere
HARMONICS = 8  # real spherical harmonics of degree 1 and 2


def log_distance(position: Tensor, receiver: Tensor) -> Tensor:
    """log10 of the distances [m] from positions (n, 3) to receivers (R, 3), float64 (n, R).

    0 for a receiver whose position is unknown (nan): there a law has a level and no slope.
    """
    return distance(position.double(), receiver.double()).clamp_min(NEAREST).log10().nan_to_num(0.0)


def harmonics(position: Tensor, receiver: Tensor) -> Tensor:
    """Harmonics of degree 1 and 2 of the direction from receivers (R, 3) to positions (n, 3), (n, R, 8), each of unit mean
    square over all directions; 0 for a receiver whose position is unknown (nan)."""
    x, y, z = functional.normalize(position[:, None] - receiver, dim=-1).unbind(-1)
    first = [math.sqrt(3) * c for c in (x, y, z)]
    second = [math.sqrt(15) * c for c in (x * y, y * z, z * x, (x * x - y * y) / 2)]
    return torch.stack([*first, *second, math.sqrt(5) / 2 * (3 * z * z - 1)], dim=-1).nan_to_num(0.0)


class Law(NamedTuple):
    """rssi = level + slope log10 d, for each of R receivers, or one for all."""

    level: Tensor  # float64 (R,) or (1,) [dBm] at 1 m
    slope: Tensor  # float64 (R,) or (1,), -10 gamma [dB a decade]

    def __call__(self, distance: Tensor) -> Tensor:
        """RSSI [dBm] at log10 distances (n, R)."""
        return self.level + self.slope * distance

    def where(self, usable: Tensor, other: Law) -> Law:
        """This law for usable (R,) receivers, another for the rest."""
        return Law(self.level.where(usable, other.level), self.slope.where(usable, other.slope))


def fit_law(distance: Tensor, rssi: Tensor, *, pooled: bool = False) -> Law:
    """The law by least squares (Rappaport, "Wireless Communications", 2nd ed., 2002, section 4.9).

    A receiver whose measurements are all equally far has a level and no slope; one never heard has nan.

    Args:
        distance: log10 of the distances [m], (n, R).
        rssi: (n, R) [dBm], nan where not heard.
        pooled: one law for all receivers.
    """
    heard = ~rssi.isnan()
    along = (0, 1) if pooled else (0,)
    count = heard.sum(along)

    def mean(x: Tensor) -> Tensor:
        return x.where(heard, 0.0).sum(along) / count

    middle, centre = mean(rssi), mean(distance)
    away = distance - centre
    variance = mean(away.square())
    slope = (mean(away * (rssi - middle)) / variance).where(variance > 1e-12, 0.0)
    level = middle - slope * centre
    return Law(level.reshape(-1), slope.reshape(-1))
