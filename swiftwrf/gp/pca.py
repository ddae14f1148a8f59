"""Principal components of spectra that come by the batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor

OVERSAMPLING = 16  # directions beyond the components that the sketch holds


class Components(NamedTuple):
    """Rows that are nearly mean + score @ component."""

    mean: Tensor  # float32 (P,)
    score: Tensor  # float64 (n, K), each column of length 1, the least component first
    component: Tensor  # float32 (K, P)


def principal_components(batches: Callable[[], Iterable[Tensor]], rank: int, least: float, seed: int = 0) -> Components:
    """The largest principal components of rows, of which a batch at a time is in memory.

    A random sketch of the rows' covariance spans them, after one power iteration (N. Halko, P. G. Martinsson and
    J. A. Tropp, "Finding structure with randomness", SIAM Review 53, 2011, algorithms 4.3 and 5.1). Time grows with the
    number of rows; they are read three times.

    Args:
        batches: gives the rows (b, P) in order, float32, each time the same.
        rank: components at most.
        least: share of the variance below which a component is left out.
        seed: of the sketch.
    """
    total, n = torch.zeros((), dtype=torch.float64), 0
    for batch in batches():
        total, n = total + batch.sum(dim=0, dtype=torch.float64), n + len(batch)
    mean = (total / n).float()
    width = min(rank + OVERSAMPLING, len(mean))
    random = torch.randn(len(mean), width, generator=torch.Generator().manual_seed(seed))
    sketch = torch.zeros(len(mean), width, dtype=torch.float64)
    variance = 0.0
    for batch in batches():
        change = batch - mean
        sketch += (change.T @ (change @ random)).double()
        variance += float(change.square().sum(dtype=torch.float64))
    span = torch.linalg.qr(sketch).Q.float()
    score = torch.cat([(batch - mean) @ span for batch in batches()]).double()
    value, vector = torch.linalg.eigh(score.T @ score)
    kept = (value > least * variance).nonzero()[:, 0][-rank:]
    scale = value[kept].sqrt()
    component = (vector[:, kept] * scale).T.float() @ span.T
    return Components(mean, score @ vector[:, kept] / scale, component)
