"""Choices that training spectra make: kernel, principal components and their number, and where to measure next.

The kernel is that of the pixel Gaussian process with the smallest error at held-out training spectra: held out at random, or
a region at a time if the model has to predict unmeasured regions. All errors follow from the inner products of the spectra,
so a candidate costs a few small linear solves (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine
Learning", 2006, chapters 2 and 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from swiftwrf.data.splits import each_fold
from swiftwrf.data.store import Store
from swiftwrf.gp.process import Kernel, candidates, held_out_errors, leave_folds_out_locally
from swiftwrf.positions import distance
from swiftwrf.runtime.threads import single_thread

MIN_ERROR = 1e-12  # squared error, for logarithms
MAX_ROWS = 400  # spectra that choose; a candidate costs their number cubed
MAX_LOCAL_ROWS = 200  # spectra that are held out among more, each predicted from its neighbours
MIN_VARIANCE = 1e-6  # fraction of the variance below which a principal component is left out


@single_thread()
def choose_kernel(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Kernel:
    """Return the candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Among more than 400 spectra, 200 are held out, and each is predicted from its nearest neighbours in other folds. A
    random sample would be less dense, and its best kernel would have a shorter length and more noise.

    Args:
        position: Positions of the training spectra (n, 3) [m].
        spectrum: Training spectra (n, H, W).
        fold: Number of the group that each is held out with, (n,).

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
        >>> choose_kernel(data.position, data.store, torch.arange(40) % 5).noise > 0
        True
    """
    errors = _held_out_errors if len(position) <= MAX_ROWS else _local_errors
    evaluate = errors(position, spectrum, fold)

    def score(kernel: Kernel) -> float:
        return -float(evaluate(kernel).clamp_min(MIN_ERROR).log().sum())

    return max(candidates(position, (1e-3, 1e-2, 1e-1)), key=score)


def _held_out_errors(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Callable[[Kernel], Tensor]:
    """Return the function from a kernel to the squared errors (n,) of all spectra, each predicted without its fold."""
    gram, apart = inner_products(spectrum[:]), distance(position.double(), position.double())
    groups = [out for out, _ in each_fold(fold)]

    def evaluate(kernel: Kernel) -> Tensor:
        precision = torch.linalg.inv(kernel.at(apart) + kernel.noise * torch.eye(len(apart)))
        # weights of all rows in the error of each row: 1 of the row itself, negative ones of those that predict it
        weight = torch.cat([held_out_errors(precision, precision, out) for out in groups])
        return ((weight @ gram) * weight).sum(1)

    return evaluate


def _local_errors(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Callable[[Kernel], Tensor]:
    """Return the function from a kernel to the squared errors of some spectra, each predicted from its neighbours."""
    position = position.double()
    (out,) = subsample(torch.arange(len(position)), rows=MAX_LOCAL_ROWS)
    near, weights = leave_folds_out_locally(position, fold, out)
    mean = subsample(spectrum)[0].flatten(1).mean(dim=0)
    rows = torch.cat([out[:, None], near], dim=1)
    flat = (spectrum[some].flatten(1) - mean for some in rows)
    gram = torch.stack([some @ some.T for some in flat]).double() / len(mean)

    def evaluate(kernel: Kernel) -> Tensor:
        weight, _ = weights(kernel)
        full = torch.cat([weight.new_full((len(weight), 1), -1.0), weight], dim=1)  # predicted minus held-out
        return torch.einsum("mi,mij,mj->m", full, gram, full)

    return evaluate


@single_thread()
def choose_rank(position: Tensor, spectrum: Tensor | Store, fold: Tensor, kernel: Kernel) -> int:
    """Return the number of principal components whose omitted variance is negligible beside the error at held-out positions.

    The arguments are those of `choose_kernel`, and the kernel that it chose.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
        >>> fold = torch.arange(40) % 5
        >>> 1 <= choose_rank(data.position, data.store, fold, choose_kernel(data.position, data.store, fold)) <= 40
        True
    """
    position, spectrum, fold = subsample(position, spectrum, fold)
    error = _held_out_errors(position, spectrum, fold)(kernel).sum()
    variance = torch.linalg.eigvalsh(inner_products(spectrum)).clamp_min(0)  # ascending
    left_out = variance.cumsum(0).flip(0)  # by 0, 1, ... components
    return int((left_out > 5e-4 * error).sum())  # the rest is negligible beside it


@single_thread()
def most_informative(
    kernel: Kernel, known: Tensor, candidate: Tensor, count: int, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Choose positions whose measurement lowers the mean posterior variance most, one after the other.

    Greedy variance reduction is nearly optimal (Krause, Singh and Guestrin 2008).

    Args:
        kernel: Kernel of the field, with its noise.
        known: Measured positions (n, 3).
        candidate: Positions (m, 3) to choose from, evenly over the region.
        count: Number of positions to choose, at most m.
        weight: Weights of the candidates' variances in the mean, (m,). Defaults to equal ones.

    Returns:
        Numbers of the chosen candidates in order, (count,), and the mean variance before the first and after each of them,
        relative to k(0) = 1, float64 (1 + count,).

    Example:
        >>> known, candidate = torch.zeros(1, 3), torch.tensor([[0.1, 0, 0], [2.0, 0, 0]])
        >>> most_informative(Kernel(noise=0.01), known, candidate, count=1)[0]
        tensor([1])
    """
    candidate = candidate.double()
    weight = torch.ones(len(candidate)) if weight is None else weight
    weight = weight.double() / weight.double().mean()
    cross = kernel(candidate, known.double())
    covariance = kernel(candidate, candidate) - cross @ torch.linalg.solve(kernel.covariance(known), cross.T)
    chosen: list[int] = []
    left = [(weight * covariance.diagonal()).mean()]
    for _ in range(count):
        noisy = covariance.diagonal().clamp_min(0) + kernel.noise + 1e-6  # also at a measured position
        lowered = (weight @ covariance.square()) / noisy
        lowered[chosen] = -1
        best = int(lowered.argmax())
        covariance -= covariance[:, best, None] * covariance[best] / noisy[best]
        chosen.append(best)
        left.append((weight * covariance.diagonal()).mean())
    return torch.tensor(chosen, dtype=torch.int64), torch.stack(left).clamp_min(0)


def subsample(*tensors: Tensor | Store, rows: int = MAX_ROWS) -> list[Tensor]:
    """Return at most `rows` evenly spread rows of each tensor, the same rows of all.

    Example:
        >>> subsample(torch.arange(100), rows=3)
        [tensor([ 0, 49, 99])]
    """
    n = len(tensors[0])
    some = torch.linspace(0, n - 1, rows).long() if n > rows else slice(None)
    return [t[some] for t in tensors]


def inner_products(spectrum: Tensor) -> Tensor:
    """Return the inner products of the spectra's differences from their mean, per pixel, float64 (n, n).

    Example:
        >>> inner_products(torch.tensor([[0.0, 0.0], [2.0, 2.0]]))
        tensor([[ 1., -1.],
                [-1.,  1.]], dtype=torch.float64)
    """
    flat = spectrum.flatten(1)
    flat = flat - flat.mean(dim=0, dtype=torch.float64)  # the largest tensor in memory
    return flat @ flat.T / flat.shape[1]


def principal_components(
    rows: Tensor | Callable[[], Iterable[Tensor]], rank: int, min_variance: float = MIN_VARIANCE
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the largest principal components of rows.

    The components of a tensor follow from the inner products of its rows. Those of batches follow from a random sketch of
    the covariance after one power iteration (N. Halko, P. G. Martinsson and J. A. Tropp, "Finding structure with
    randomness", SIAM Review 53, 2011, algorithms 4.3 and 5.1), whose time grows with the number of rows.

    Args:
        rows: Rows (n, P), float32, or a function that yields them in order by the batch, equal at each of three calls.
        rank: Maximum number of components.
        min_variance: Fraction of the variance below which a component is left out.

    Returns:
        Mean (P,), scores (n, K), float64 and each column of length 1, and components (K, P), the least component first. Rows
        are nearly mean + score @ component.

    Example:
        >>> rows = torch.outer(torch.arange(5.0), torch.ones(8))
        >>> mean, score, component = principal_components(rows, rank=3)
        >>> component.shape, (mean + score.float() @ component)[:, 0].round().tolist()
        (torch.Size([1, 8]), [0.0, 1.0, 2.0, 3.0, 4.0])
    """
    if not isinstance(rows, Tensor):
        return _sketched(rows, rank, min_variance)
    mean = rows.mean(dim=0)
    change = rows - mean
    value, vector = torch.linalg.eigh((change @ change.T).double())
    kept = (value > min_variance * value.sum()).nonzero()[:, 0]
    vector = vector[:, kept[max(len(kept) - rank, 0) :]]
    return mean, vector, vector.T.float() @ change


def _sketched(batches: Callable[[], Iterable[Tensor]], rank: int, min_variance: float) -> tuple[Tensor, Tensor, Tensor]:
    total, n = torch.zeros((), dtype=torch.float64), 0
    for batch in batches():
        total, n = total + batch.sum(dim=0, dtype=torch.float64), n + len(batch)
    mean = (total / n).float()
    width = min(rank + 16, len(mean))  # more directions are more exact
    random = torch.randn(len(mean), width, generator=torch.Generator().manual_seed(0))
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
    return mean, score @ vector[:, kept] / scale, component
