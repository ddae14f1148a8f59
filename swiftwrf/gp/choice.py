"""Choices that training spectra make: kernel, principal components and their number, and where to measure next.

The kernel is that of the pixel Gaussian process with the smallest error at held-out training spectra: held out at random, or
a region at a time if the model has to predict unmeasured regions. All errors follow from the inner products of the spectra,
so a candidate costs a few small linear solves (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine
Learning", 2006, chapters 2 and 5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
MIN_VARIANCE = 1e-6  # fraction of the variance below which a principal component is rounding


@single_thread()
def choose_kernel(
    position: Tensor, spectrum: Tensor | Store, fold: Tensor, noises: Sequence[float] = (1e-3, 1e-2, 1e-1)
) -> Kernel:
    """Return the candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Among more than 400 spectra, 200 are held out, and each is predicted from its nearest neighbours in other folds. A
    random sample would be less dense, and its best kernel would have a shorter length and more noise.

    Args:
        position: Positions of the training spectra (n, 3) [m].
        spectrum: Training spectra (n, H, W).
        fold: Number of the group that each is held out with, (n,).
        noises: Candidates of the noise variance. Not studied.

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

    return max(candidates(position, noises), key=score)


def _held_out_errors(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Callable[[Kernel], Tensor]:
    """Return the function from a kernel to the squared errors (n,) of all spectra, each predicted without its fold."""
    gram, separation = inner_products(spectrum[:]), distance(position.double(), position.double())
    groups = [out for out, _ in each_fold(fold)]

    def evaluate(kernel: Kernel) -> Tensor:
        precision = torch.linalg.inv(kernel.at(separation) + kernel.noise * torch.eye(len(separation)))
        # weights of all rows in the error of each row: 1 of the row itself, negative ones of those that predict it
        weight = torch.cat([held_out_errors(precision, precision, out) for out in groups])
        return ((weight @ gram) * weight).sum(1)

    return evaluate


def _local_errors(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Callable[[Kernel], Tensor]:
    """Return the function from a kernel to the squared errors of some spectra, each predicted from its neighbours."""
    position = position.double()
    (out,) = subsample(torch.arange(len(position)), rows=MAX_LOCAL_ROWS)
    neighbours, weights = leave_folds_out_locally(position, fold, out)
    mean = subsample(spectrum)[0].flatten(1).mean(dim=0)
    rows = torch.cat([out[:, None], neighbours], dim=1)
    changes = (spectrum[group].flatten(1) - mean for group in rows)
    gram = torch.stack([change @ change.T for change in changes]).double() / len(mean)

    def evaluate(kernel: Kernel) -> Tensor:
        weight, _ = weights(kernel)
        full = torch.cat([weight.new_full((len(weight), 1), -1.0), weight], dim=1)  # predicted minus held-out
        return torch.einsum("mi,mij,mj->m", full, gram, full)

    return evaluate


@single_thread()
def principal_components(
    position: Tensor,
    spectrum: Tensor | Store,
    fold: Tensor,
    kernel: Kernel,
    omitted: float = 1e-4,
    most: int = MAX_ROWS,
    rows: int = 1000,
) -> Tensor:
    """Return the mean spectrum and those principal components that matter beside the errors at held-out positions.

    Args:
        position: As `choose_kernel`.
        spectrum: As `choose_kernel`.
        fold: As `choose_kernel`.
        kernel: Kernel that it chose.
        omitted: Variance of all omitted components, relative to the mean squared error at held-out positions.
        most: Maximum number of components.
        rows: Maximum number of spectra, evenly chosen, that determine the components. Not studied.

    Returns:
        Mean and K components, the least one first, float32 (1 + K, H, W). Components are orthogonal, and as long as the
        standard deviation along them.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
        >>> fold = torch.arange(40) % 5
        >>> principal_components(data.position, data.store, fold, Kernel(), most=8).shape
        torch.Size([9, 6, 12])
    """
    error = _held_out_errors(*subsample(position, spectrum, fold))(kernel).mean()
    (chosen,) = subsample(spectrum, rows=rows)
    mean = chosen.mean(dim=0)
    change = (chosen - mean).flatten(1)
    value, vector = torch.linalg.eigh((change @ change.T).double() / len(change))  # ascending
    matters = value.clamp_min(0).cumsum(0) > omitted * error * change.shape[1]
    kept = (matters & (value > MIN_VARIANCE * value.sum())).nonzero()[-most:, 0]
    component = (vector[:, kept] / len(change) ** 0.5).T.to(change) @ change
    return torch.cat([mean[None], component.unflatten(1, mean.shape)]).float()


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
    chosen = torch.linspace(0, n - 1, rows).long() if n > rows else slice(None)
    return [t[chosen] for t in tensors]


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
