"""Surveys of few places: each place is predicted by all others, since a test part would leave too few rows to fit."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.splits import MIN_PLACES, MIN_SPLIT_ROWS, places
from swiftwrf.errors import InputError
from swiftwrf.models.prediction import Prediction
from swiftwrf.positions import distance
from swiftwrf.rssi.base import RssiPredictor

LEAVE_ONE_OUT = "leave-one-out"  # as the name of a split


def is_small(data: Rssi, split: str) -> bool:
    """Return whether the places of the data are held out one at a time instead of a random part.

    Raises:
        InputError: Fewer than 5 places.

    Example:
        >>> import swiftwrf
        >>> is_small(swiftwrf.rssi_room(n=12), "random")
        True
    """
    if len(data) >= MIN_SPLIT_ROWS or split != "random" or split in data.named_splits or data.receiver_moves:
        return False
    count = int(places(data.transmitter_position).max()) + 1
    if count < MIN_PLACES:
        raise InputError(f"{data.name} has {count} different positions; measure at {MIN_PLACES} or more")
    return True


def predict_each_place(fit: Callable[[Rssi, Rssi], RssiPredictor], data: Rssi, pool: Rssi) -> tuple[Prediction, Tensor]:
    """Return how rows of all other places predict detected values, and the probability of a detection, (n, R).

    Args:
        fit: Function that fits a predictor to rows, given the same rows at all receivers.
        data: All n rows.
        pool: The same rows at all receivers.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.rssi_room(n=8)
        >>> predict_each_place(lambda rows, pool: swiftwrf.RssiModel().fit(rows, pool=pool), data, data)[0].mean.shape
        torch.Size([8, 12])
    """
    place, probability = places(data.transmitter_position), torch.empty(data.rssi_dbm.shape, dtype=torch.float64)
    mean, std = torch.empty_like(probability), torch.full_like(probability, torch.nan)
    for number in place.unique():
        out, kept = ((place == number).nonzero()[:, 0], (place != number).nonzero()[:, 0])
        rows, predictor = data.subset(out), fit(data.subset(kept), pool.subset(kept))
        offset = 0.0 if data.offsets is None else data.offsets.of(rows)[:, None]
        found = predictor.predict_detected(rows)
        mean[out], probability[out] = (
            found.mean.double(),
            predictor.predict_detection(rows.transmitter_position, offset),
        )
        if found.std is not None:
            std[out] = found.std.double()
    return Prediction(mean, None if bool(std.isnan().all()) else std), probability


def distances_to_others(position: Tensor) -> Tensor:
    """Return the distance from each position (n, 3) to the nearest one of another place, (n,).

    Example:
        >>> distances_to_others(torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [3.0, 0, 0]]))
        tensor([3., 3., 3.])
    """
    place = places(position)
    return distance(position, position).where(place[:, None] != place, torch.inf).amin(dim=1)
