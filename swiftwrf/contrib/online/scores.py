"""Prequential scores and sequential tests of them.

Each measurement is predicted before the model learns it (A. P. Dawid, JRSS A 147, 1984). Cumulative sums of many
standardised series have a common rate of false alarms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from scipy.optimize import brentq
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.metrics import LEVEL
from swiftwrf.models.base import FieldModel
from swiftwrf.models.interpolator import Interpolator
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.validation import PositiveInt, checked

# standard deviations per measurement that a series may exceed its mean; detects changes of twice as much
ALLOWANCE = 0.5
Model = TypeVar("Model", bound=FieldModel | RssiPredictor)


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of n measurements by a model that had not learnt them.

    Args:
        position: Positions of the moving end, (n, 3) [m].
        error: Root mean square error of each spectrum, or mean absolute error of each row of RSSI [dB], (n,).
        innovation: Standardized innovations: error over expected error of each spectrum up to a constant factor, (n, 1), or
            measured minus predicted RSSI over its standard deviation, (n, R), nan where not detected.
        covered: Fraction of pixels or receivers inside their 80 % interval, (n,), nan without intervals.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> score(swiftwrf.make_model("coarray").fit(train), test).error.shape
        torch.Size([10])
    """

    position: Tensor
    error: Tensor
    innovation: Tensor
    covered: Tensor

    def __len__(self) -> int:
        return len(self.error)

    @classmethod
    def joined(cls, parts: list[Scores]) -> Scores:
        """Return the scores of all parts in order."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))


@torch.no_grad()
def score(model: FieldModel | RssiPredictor, new: Spectra | Rssi) -> Scores:
    """Return the scores of measurements that a model has not learnt.

    Raises:
        InputError: As `aligned` of the model.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> score(swiftwrf.make_model("coarray").fit(train), test).innovation.shape
        torch.Size([10, 1])
    """
    new = model.aligned(new)  # type: ignore[arg-type]  # measurements of the model's kind
    if isinstance(model, RssiPredictor):
        assert isinstance(new, Rssi)
        position, measured = new.transmitter_position, new.rssi_dbm
        predicted = model.predict(position)
        miss = measured - predicted.mean
        error, innovation = miss.abs().nanmean(dim=1), torch.full_like(miss, torch.nan)
        if predicted.std is not None:
            innovation = miss / predicted.std
    else:
        assert isinstance(new, Spectra)
        position, measured = new.position, new.store[:].to(model.device)
        predicted = model.predict(position)
        miss = measured - predicted.mean
        error = miss.square().mean(dim=(1, 2)).sqrt().double()
        expected = model.expected_error(position) if isinstance(model, Interpolator) else torch.ones_like(error)
        innovation = (error / expected)[:, None]
    covered = torch.full_like(miss, torch.nan)
    if predicted.std is not None:
        low, high = predicted.interval(LEVEL)
        covered = ((low <= measured) & (measured <= high)).double().where(~miss.isnan(), torch.nan)
    return Scores(position, error.cpu(), innovation.cpu(), covered.flatten(1).nanmean(dim=1).cpu())


def learnt(model: Model, new: Spectra | Rssi) -> Model:
    """Return the model after an update with measurements of its kind."""
    update: Any = model.update
    found: Model = update(new)
    return found


@checked
def prequential(model: Model, new: Spectra | Rssi, batch: PositiveInt = 1) -> tuple[Scores, Model]:
    """Score measurements in order, each before the model learns it.

    Args:
        model: Fitted model with `update`.
        new: Measurements in the order in which they were taken.
        batch: Number of measurements that are predicted and then learnt together.

    Returns:
        Scores, and the model that has learnt all measurements.

    Raises:
        InputError: As `update`.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.rssi_room(n=80)
        >>> model = swiftwrf.RssiModel().fit(data.subset(torch.arange(60)))
        >>> scores, model = prequential(model, data.subset(torch.arange(60, 80)), batch=5)
        >>> len(scores), len(model.region())
        (20, 80)
    """
    parts = []
    for rows in torch.arange(len(new)).split(batch):
        some = new.subset(rows)
        parts.append(score(model, some))
        model = learnt(model, some)
    return Scores.joined(parts), model


def alarm_threshold(rate: float, n_series: int = 1) -> float:
    """Return the cumulative sum at which a false alarm among standard normal series has a given rate.

    By Siegmund's approximation of the average run length (D. Siegmund, "Sequential Analysis", 1985, eq. 2.56), with equal
    shares of the rate for all series.

    Args:
        rate: False alarms a measurement, above 0 and below 1.
        n_series: Number of series that are tested together.

    Example:
        >>> round(alarm_threshold(1 / 930), 1)  # the run length of a threshold of 5 is 930
        5.0
    """
    length = max(n_series / rate, 2.0)

    def excess(threshold: float) -> float:
        b = 2 * ALLOWANCE * (threshold + 1.166)
        return math.log((math.expm1(b) - b) / (2 * ALLOWANCE**2)) - math.log(length)

    return float(brentq(excess, 0.0, 600.0)) if excess(0.0) < 0 else 0.0


@dataclass(frozen=True)
class Alarm:
    """A series that exceeded its threshold.

    Args:
        series: Number of the series.
        at: Number of the measurement that raised the alarm, counted from 0.
        since: Number of the first measurement of the cumulative sum: the estimated beginning of the change.
    """

    series: int
    at: int
    since: int
