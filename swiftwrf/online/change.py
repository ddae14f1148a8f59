"""Sequential tests: cumulative sums of many standardized series, with a common rate of false alarms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.optimize import brentq
from torch import Tensor

ALLOWANCE = (
    0.5  # standard deviations per measurement that a series may exceed its mean; detects changes of twice as much
)


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

    Example:
        >>> alarm = Alarm(series=0, at=14, since=9)
        >>> alarm.at - alarm.since
        5
    """

    series: int
    at: int
    since: int


@dataclass(frozen=True, eq=False)
class Cusum:
    """One-sided cumulative sums (E. S. Page, Biometrika 41, 1954) of C series.

    Args:
        value: Cumulative sums (C,).
        since: Number of the first measurement of each sum, int64 (C,).
        count: Number of measurements so far.

    Example:
        >>> test = Cusum.start(1)
        >>> for value in (0.0, 2.0, 2.0, 2.0, 2.0):
        ...     test, alarms = test.updated(torch.tensor([value]), threshold=5.0)
        >>> alarms
        [Alarm(series=0, at=4, since=1)]
    """

    value: Tensor
    since: Tensor
    count: int

    @classmethod
    def start(cls, n_series: int) -> Cusum:
        """Return sums of 0."""
        return cls(torch.zeros(n_series, dtype=torch.float64), torch.zeros(n_series, dtype=torch.int64), 0)

    def updated(self, series: Tensor, threshold: float, allowance: float = ALLOWANCE) -> tuple[Cusum, list[Alarm]]:
        """Return the sums with one more value of each series (C,), nan for none, and the alarms, largest sum first.

        A sum that raises an alarm starts again at 0.
        """
        added = (self.value + (series.double() - allowance).nan_to_num(0.0)).clamp_min(0)
        since = self.since.where(self.value > 0, self.count)
        over = (added > threshold).nonzero()[:, 0]
        over = over[added[over].argsort(descending=True)]
        alarms = [Alarm(int(c), self.count, int(since[c])) for c in over]
        return Cusum(added.where(added <= threshold, 0.0), since, self.count + 1), alarms
