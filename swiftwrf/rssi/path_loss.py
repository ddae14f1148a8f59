"""Received power without a field: the log-distance path-loss model, and the directivity of a receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.positions import Neighbours, distance

MIN_DISTANCE_M = 0.3  # shorter distances count as this one: the model does not hold in the near field
PLACE_PENALTY = 10.0  # measurements that a place needs for half of its own path-loss model
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
        slope: -10 times the path-loss exponent, of the same shape [dB a decade]. A fitted exponent is at least 0.

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
        The model of each receiver, of shape (R,). Without measurements of one kind, that of the other kind. Receivers of
        unknown position then have the mean level.

    Example:
        >>> distance, rssi = torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.tensor([[-40.0, -70.0], [-60.0, -70.0]])
        >>> fit_shared_path_loss(distance, rssi, torch.tensor([True, False])).slope
        tensor([-20.,   0.])
    """
    own, others = (fit_path_loss(distance[:, kind], rssi[:, kind], shared=True) for kind in (located, ~located))
    own = own.where(~own.level.isnan(), fit_path_loss(distance, rssi, shared=True))
    mean = rssi.nanmean().reshape(1)
    others = others.where(~others.level.isnan(), PathLoss(mean, torch.zeros_like(mean)))
    is_located = located if applied is None else applied
    return PathLoss(*(a.expand(len(is_located)).where(is_located, b) for a, b in zip(own, others, strict=True)))


def fit_path_loss(distance: Tensor, rssi: Tensor, *, shared: bool = False) -> PathLoss:
    """Fit the path-loss model by least squares (Rappaport, "Wireless Communications", 2nd ed., 2002, section 4.9).

    The path-loss exponent is at least 0: a model whose RSSI rises with the distance rises without limit beyond the data.

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
    slope = (mean(offset * (rssi - middle)) / variance).where(variance > 1e-12, 0.0).clamp_max(0.0)
    return PathLoss((middle - slope * centre).reshape(-1), slope.reshape(-1))


@dataclass(frozen=True, eq=False)
class PairPathLoss:
    """The log-distance path-loss model over pairs of positions: one for all receivers, and corrections at some places.

    Args:
        shared: RSSI at 1 m [dBm] and slope [dB a decade] of all receivers, float64 (2,).
        place: Positions of the receivers with a correction, float64 (P, 3) [m].
        correction: What is added to RSSI at 1 m and slope at these places, float64 (P, 2).

    Example:
        >>> pair = torch.tensor([[0.0, 0, 1, 0, 0, 0], [0.0, 0, 10, 0, 0, 0]])
        >>> PairPathLoss.fit(pair, torch.tensor([-40.0, -60.0]), by_place=False)(pair)
        tensor([-40., -60.], dtype=torch.float64)
    """

    shared: Tensor
    place: Tensor
    correction: Tensor

    @classmethod
    def fit(cls, pair: Tensor, rssi: Tensor, by_place: bool) -> Self:
        """Fit the model by least squares, the corrections with a ridge penalty.

        Args:
            pair: Positions of transmitter and receiver, (m, 6) [m].
            rssi: Measurements (m,) [dBm].
            by_place: Whether each position of a receiver has a correction.
        """
        apart = _pair_log_distance(pair)
        shared = torch.cat(fit_path_loss(apart[:, None], rssi[:, None].double()))
        place, row = pair[: len(pair) if by_place else 0, 3:].double().unique(dim=0, return_inverse=True)
        if not len(place):
            return cls(shared, place.reshape(0, 3), torch.zeros(0, 2, dtype=torch.float64))
        centre = apart.mean()
        own = torch.stack([torch.ones_like(apart), apart - centre], dim=1)
        normal = PLACE_PENALTY * torch.eye(2).double().repeat(len(place), 1, 1)
        normal = normal.index_add(0, row, own[:, :, None] * own[:, None])
        residual = rssi - shared[0] - shared[1] * apart
        right = torch.zeros(len(place), 2, dtype=torch.float64).index_add(0, row, own * residual[:, None])
        slope = torch.linalg.solve(normal, right)[:, 1].clamp_max(-shared[1])  # the sum of both slopes is at most 0
        level = (right[:, 0] - normal[:, 0, 1] * slope) / normal[:, 0, 0]
        return cls(shared, place, torch.stack([level - slope * centre, slope], dim=1))

    @cached_property
    def _places(self) -> Neighbours:
        return Neighbours(self.place)

    def __call__(self, pair: Tensor) -> Tensor:
        """Return the RSSI (m,) [dBm] at pairs (m, 6) [m]; at places without a correction by the shared model."""
        values = self.shared.expand(len(pair), 2)
        if len(self.place) and len(pair):
            away, nearest = (found[:, 0] for found in self._places(pair[:, 3:], 1))
            values = values + self.correction[nearest].where(away[:, None] < 1e-3, 0.0)
        return values[:, 0] + values[:, 1] * _pair_log_distance(pair)


def _pair_log_distance(pair: Tensor) -> Tensor:
    """Return the log10 of the distances [m] between the ends of pairs (m, 6), float64 (m,)."""
    squared = (pair[:, :3].double() - pair[:, 3:].double()).square().sum(dim=1)
    return squared.clamp_min(MIN_DISTANCE_M**2).log10() / 2
