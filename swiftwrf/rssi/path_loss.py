"""Received power without a field: the log-distance path-loss model, and the directivity of a receiver."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.positions import distance

MIN_DISTANCE_M = 0.3  # shorter distances count as this one: the model does not hold in the near field
N_HARMONICS = 8  # real spherical harmonics of degree 1 and 2


def log_distance(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the log10 of distances [m] from positions to receivers.

    Args:
        position: Positions of the transmitter, (n, 3) [m].
        receiver: Positions of the receivers, (R, 3) [m], nan where unknown.

    Returns:
        float64 (n, R). 0 for a receiver of unknown position, whose path-loss model is then its level.

    Example:
        >>> log_distance(torch.tensor([[0.0, 0.0, 10.0]]), torch.zeros(1, 3))
        tensor([[1.]], dtype=torch.float64)
    """
    return distance(position.double(), receiver.double()).clamp_min(MIN_DISTANCE_M).log10().nan_to_num(0.0)


def harmonics(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the spherical harmonics of degree 1 and 2 of the directions from receivers (R, 3) to positions (n, 3).

    Returns:
        (n, R, 8), each of unit mean square over all directions. 0 for a receiver of unknown position (nan).
    """
    x, y, z = functional.normalize(position[:, None] - receiver, dim=-1).unbind(-1)
    first = [math.sqrt(3) * c for c in (x, y, z)]
    second = [math.sqrt(15) * c for c in (x * y, y * z, z * x, (x * x - y * y) / 2)]
    return torch.stack([*first, *second, math.sqrt(5) / 2 * (3 * z * z - 1)], dim=-1).nan_to_num(0.0)


class PathLoss(NamedTuple):
    """The log-distance path-loss model, rssi = level + slope log10 d, for each of R receivers or one for all.

    Args:
        level: RSSI at 1 m, float64 (..., R) or (..., 1) [dBm].
        slope: -10 times the path-loss exponent, of the same shape [dB a decade].

    Example:
        >>> model = PathLoss(torch.tensor([-40.0]), torch.tensor([-20.0]))
        >>> model(torch.tensor([[0.0], [1.0]]))  # at 1 m and 10 m
        tensor([[-40.],
                [-60.]])
    """

    level: Tensor
    slope: Tensor

    def __call__(self, distance: Tensor) -> Tensor:
        """Return the RSSI (..., n, R) [dBm] at log10 distances (n, R)."""
        return self.level[..., None, :] + self.slope[..., None, :] * distance

    def where(self, usable: Tensor, other: PathLoss) -> PathLoss:
        """Return this model for the usable receivers (R,), and another model for the rest."""
        return PathLoss(self.level.where(usable, other.level), self.slope.where(usable, other.slope))


def fit_shared_path_loss(distance: Tensor, rssi: Tensor, located: Tensor, applied: Tensor | None = None) -> PathLoss:
    """Fit one path-loss model to all receivers of known position, and one level to all others.

    Args:
        distance: log10 of the distances [m], (n, P).
        rssi: Measurements (n, P) [dBm], nan where not detected.
        located: Whether the position of each receiver is known, bool (P,).
        applied: The same for the R receivers that the model is for. Defaults to `located`.

    Returns:
        The model of each receiver, of shape (R,). Without measurements of one kind, the model of the other kind.

    Example:
        >>> distance, rssi = torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.tensor([[-40.0, -70.0], [-60.0, -70.0]])
        >>> fit_shared_path_loss(distance, rssi, torch.tensor([True, False])).slope
        tensor([-20.,   0.])
    """
    models = [fit_path_loss(distance[:, kind], rssi[:, kind], shared=True) for kind in (located, ~located)]
    every = fit_path_loss(distance, rssi, shared=True)
    own, others = (model.where(~model.level.isnan(), every) for model in models)
    is_located = located if applied is None else applied
    return PathLoss(*(a.expand(len(is_located)).where(is_located, b) for a, b in zip(own, others, strict=True)))


def fit_path_loss(distance: Tensor, rssi: Tensor, *, shared: bool = False) -> PathLoss:
    """Fit the path-loss model by least squares (Rappaport, "Wireless Communications", 2nd ed., 2002, section 4.9).

    Args:
        distance: log10 of the distances [m], (n, R).
        rssi: Measurements (n, R) [dBm], nan where not detected.
        shared: Fit one model for all receivers.

    Returns:
        A model of shape (R,), or (1,) if shared. The slope is 0 for a receiver measured at one distance only. A receiver
        without measurements has nan.

    Example:
        >>> fit_path_loss(torch.tensor([[0.0], [1.0]]), torch.tensor([[-40.0], [-60.0]])).slope
        tensor([-20.])
    """
    detected = ~rssi.isnan()
    along = (0, 1) if shared else (0,)
    count = detected.sum(along)

    def mean(x: Tensor) -> Tensor:
        return x.where(detected, 0.0).sum(along) / count

    middle, centre = mean(rssi), mean(distance)
    offset = distance - centre
    variance = mean(offset.square())
    slope = (mean(offset * (rssi - middle)) / variance).where(variance > 1e-12, 0.0)
    return PathLoss((middle - slope * centre).reshape(-1), slope.reshape(-1))
