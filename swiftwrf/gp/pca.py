"""Principal component analysis of spectra, in memory or by the batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor

N_OVERSAMPLING = 16  # directions of the sketch beyond the components
MIN_VARIANCE = 1e-6  # fraction of the variance below which a component is left out


class Components(NamedTuple):
    """Rows that are nearly mean + score @ component.

    Example:
        >>> found = principal_components(torch.outer(torch.arange(5.0), torch.ones(8)), rank=1)
        >>> (found.mean + found.score.float() @ found.component)[:, 0].round().tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0]
    """

    mean: Tensor  # float32 (P,)
    score: Tensor  # float64 (n, K), each column of length 1, the least component first
    component: Tensor  # float32 (K, P)


def principal_components(
    rows: Tensor | Callable[[], Iterable[Tensor]], rank: int, min_variance: float = MIN_VARIANCE, seed: int = 0
) -> Components:
    """Return the largest principal components of rows.

    The components of a tensor follow from the inner products of its rows. Those of batches follow from a random sketch of
    the covariance after one power iteration (N. Halko, P. G. Martinsson and J. A. Tropp, "Finding structure with
    randomness", SIAM Review 53, 2011, algorithms 4.3 and 5.1), whose time grows with the number of rows.

    Args:
        rows: Rows (n, P), float32, or a function that yields them in order by the batch, equal at each of three calls.
        rank: Maximum number of components.
        min_variance: Fraction of the variance below which a component is left out.
        seed: Seed of the sketch.

    Example:
        >>> rows = torch.outer(torch.arange(5.0), torch.ones(8))
        >>> principal_components(rows, rank=3).component.shape
        torch.Size([1, 8])
    """
    if not isinstance(rows, Tensor):
        return _sketched(rows, rank, min_variance, seed)
    mean = rows.mean(dim=0)
    change = rows - mean
    value, vector = torch.linalg.eigh((change @ change.T).double())
    kept = (value > min_variance * value.sum()).nonzero()[:, 0]
    vector = vector[:, kept[max(len(kept) - rank, 0) :]]
    return Components(mean, vector, vector.T.float() @ change)


def _sketched(batches: Callable[[], Iterable[Tensor]], rank: int, min_variance: float, seed: int) -> Components:
    total, n = torch.zeros((), dtype=torch.float64), 0
    for batch in batches():
        total, n = total + batch.sum(dim=0, dtype=torch.float64), n + len(batch)
    mean = (total / n).float()
    width = min(rank + N_OVERSAMPLING, len(mean))
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
    kept = (value > min_variance * variance).nonzero()[:, 0]
    kept = kept[max(len(kept) - rank, 0) :]
    scale = value[kept].sqrt()
    component = (vector[:, kept] * scale).T.float() @ span.T
    return Components(mean, score @ vector[:, kept] / scale, component)
