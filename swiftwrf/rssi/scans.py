"""Scans: probability that one has receivers beyond a threshold, and the correlation of the errors of its receivers."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

CORRELATION = 0.2  # of the errors of a scan, where folds do not choose it; by `benchmarks/rssi.py coverage`


def passing(values: Tensor, threshold_dbm: float, number: int = 1, below: bool = False) -> Tensor:
    """Return which scans have at least a number of R values above a threshold, or `below` it, bool (n,).

    Args:
        values: Measured values (n, R), nan where there is none.
        threshold_dbm: Threshold, in the unit of the values.
        number: Number of receivers, from 1.
        below: True where smaller is better.

    Example:
        >>> passing(torch.tensor([[20.0, 60.0], [70.0, torch.nan]]), 50.0, below=True)
        tensor([ True, False])
    """
    return ((values < threshold_dbm) if below else (values > threshold_dbm)).sum(dim=1) >= number


def at_least(
    number: int,
    mean: Tensor,
    std: Tensor,
    detection: Tensor,
    threshold_dbm: float,
    correlation: float = CORRELATION,
    below: bool = False,
) -> Tensor:
    """Return the probability that a scan has at least a number of R receivers above a threshold, float64 (...).

    Args:
        number: Number of receivers, from 1.
        mean: Mean of detected packets (R, ...) [dBm].
        std: Their standard deviation (R, ...) [dB].
        detection: Probability of a detection (R, ...).
        threshold_dbm: Threshold.
        correlation: Correlation of the errors of a scan, as `choose_correlation` finds it.
        below: True where smaller is better: probability of values below the threshold.

    Example:
        >>> at_least(1, torch.tensor([-75.0]), torch.tensor([4.0]), torch.tensor([0.8]), -75.0).round(decimals=3)
        tensor(0.4000, dtype=torch.float64)
    """
    z = (-1 if below else 1) * (mean.double() - threshold_dbm) / std.double().clamp_min(1e-6)
    score = torch.special.ndtri(detection.double() * torch.special.ndtr(z))
    total = torch.zeros_like(score[0])
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)  # of the factor that the errors share
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        given = torch.special.ndtr((score + math.sqrt(correlation) * node) / math.sqrt(1 - correlation))
        total += weight * (1 - _fewer_than(number, given))
    return total


def _fewer_than(number: int, above: Tensor) -> Tensor:
    """Return the probability (...) that fewer than a number of R independent events occur, of probabilities (R, ...)."""
    if number == 1:  # without a loop over receivers, of which there may be hundreds
        return (1 - above).prod(dim=0)
    counts = [torch.ones_like(above[0]), *(torch.zeros_like(above[0]) for _ in range(number - 1))]
    for each in above:  # probabilities of 0 to number - 1 events
        fewer = [torch.zeros_like(each), *counts[:-1]]
        counts = [count * (1 - each) + less * each for count, less in zip(counts, fewer, strict=True)]
    return torch.stack(counts).sum(dim=0)


def choose_correlation(
    mean: Tensor,
    std: Tensor,
    detection: Tensor,
    measured: Tensor,
    *,
    candidates: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    min_rows: int = 100,
    max_rows: int = 400,
) -> float:
    """Return the correlation of the errors of a scan with the highest held-out likelihood of coverage.

    It is that of whether any receiver is above four quantiles of the strongest values of rows. Numbers of rows and the
    quantiles are not studied.

    Args:
        mean: Held-out mean of detected values (n, R) [dBm].
        std: Their standard deviation (n, R) [dB].
        detection: Probability of a detection (n, R).
        measured: Values (n, R) [dBm], nan where there is none.
        candidates: Compared correlations.
        min_rows: Number of rows below which the default is taken.
        max_rows: Number of equally spaced rows that are used.

    Example:
        >>> factor, own = torch.randn(400, 1).double(), torch.randn(400, 6).double()
        >>> mean = torch.full((400, 6), -70.0).double()
        >>> choose_correlation(mean, 0 * mean + 4, 0 * mean + 1, mean + 4 * (0.8**0.5 * factor + 0.2**0.5 * own)) > 0.5
        True
    """
    if len(measured) < min_rows or measured.shape[1] == 1:
        return CORRELATION
    chosen = torch.linspace(0, len(measured) - 1, min(len(measured), max_rows)).long()
    (means, stds, detections), rssi = (each[chosen].T for each in (mean, std, detection)), measured[chosen]
    strongest = rssi.nan_to_num(-math.inf).amax(dim=1)
    thresholds = strongest[strongest.isfinite()].quantile(torch.tensor([0.1, 0.3, 0.5, 0.7], dtype=rssi.dtype)) - 0.5

    def score(correlation: float) -> float:
        total = 0.0
        for threshold in thresholds.tolist():
            p = at_least(1, means, stds, detections, threshold, correlation).clamp(1e-4, 1 - 1e-4)
            total += float(torch.where(passing(rssi, threshold), p, 1 - p).log().mean())
        return total

    return max(candidates, key=score)
