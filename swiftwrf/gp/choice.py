"""What training spectra choose: the kernel, the number of their components, and where to measure next.

Positions whose spectra resemble each other should move alike. So the kernel is the one under which a Gaussian process on
the spectra's pixels best predicts training spectra that are held out: at random, or a whole region at a time where the
model will be asked for regions nobody measured. Everything follows from the spectra's inner products, hence a candidate
costs a few small linear solves and no rendering (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine
Learning", 2006, chapters 2 and 5).
"""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.data.store import Store
from swiftwrf.gp.kernel import Kernel, candidates
from swiftwrf.gp.process import held_out, held_out_weights
from swiftwrf.runtime.threads import single_thread

NOISES = (1e-3, 1e-2, 1e-1)  # of spectra: little of a measured one is not a function of position
NEGLIGIBLE = 5e-4  # share of the error at held-out positions that components may add which are left out
JITTER = 1e-6  # relative variance below which a place counts as measured
MAX_ROWS = 400  # more do not change the choice, and a candidate costs their number cubed


@single_thread()
def choose_kernel(position: Tensor, spectrum: Tensor | Store, fold: Tensor) -> Kernel:
    """The candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Args:
        position: of the training spectra [m], (n, 3).
        spectrum: the training spectra, (n, H, W).
        fold: number of the part that each is held out with, (n,).
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    gram = inner_products(spectrum)

    def score(kernel: Kernel) -> float:
        total = 0.0
        for out, kept, gain in held_out_weights(kernel, position, fold):
            total -= float(squared_errors(gram, out, kept, gain).clamp_min(1e-12).log().sum())
        return total

    return max(candidates(position, NOISES), key=score)


@single_thread()
def choose_rank(position: Tensor, spectrum: Tensor | Store, fold: Tensor, kernel: Kernel) -> int:
    """How many principal components of the spectra it takes until the variance of the others no longer counts beside the
    error at positions that are held out.

    Args:
        position, spectrum, fold: as for `choose_kernel`.
        kernel: what it chose.
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    variance, vector = torch.linalg.eigh(inner_products(spectrum))
    variance = variance.flip(0).clamp_min(0)
    component = vector.flip(1) * variance.sqrt()  # (n, n), one column a component
    predicted, _ = held_out(kernel, position, fold, component)
    left_out = variance.flip(0).cumsum(0).flip(0)  # by 0, 1, ... components
    enough = left_out <= NEGLIGIBLE * (component - predicted).square().sum()
    return int((~enough).sum())


@single_thread()
def most_informative(kernel: Kernel, known: Tensor, candidate: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Where measuring lowers the mean variance over the candidates most, one after the other (greedy variance reduction;
    Krause, Singh and Guestrin 2008 on its near-optimality).

    Args:
        kernel: of the field, with its noise.
        known: positions (n, 3) that are measured already.
        candidate: positions (m, 3) to choose from, evenly over the region.
        count: how many, at most m.

    Returns:
        Numbers of the chosen candidates in order, (count,), and the mean variance before any and after each of them,
        relative to k(0) = 1, float64 (1 + count,).
    """
    candidate = candidate.double()
    cross = kernel(candidate, known.double())
    covariance = kernel(candidate, candidate) - cross @ torch.linalg.solve(kernel.noisy_gram(known), cross.T)
    chosen: list[int] = []
    left = [covariance.diagonal().mean()]
    for _ in range(count):
        noisy = covariance.diagonal().clamp_min(0) + kernel.noise + JITTER
        lowered = covariance.square().sum(dim=0) / noisy
        lowered[chosen] = -1
        best = int(lowered.argmax())
        covariance -= covariance[:, best, None] * covariance[best] / noisy[best]
        chosen.append(best)
        left.append(covariance.diagonal().mean())
    return torch.tensor(chosen, dtype=torch.int64), torch.stack(left).clamp_min(0)


def thinned(*tensors: Tensor | Store, rows: int = MAX_ROWS) -> list[Tensor]:
    """At most so many rows of each, the same ones, evenly spread."""
    n = len(tensors[0])
    some = torch.linspace(0, n - 1, rows).long() if n > rows else slice(None)
    return [t[some] for t in tensors]


def inner_products(spectrum: Tensor) -> Tensor:
    """Of the spectra's differences from their mean, a pixel, float64 (n, n)."""
    flat = spectrum.flatten(1)
    flat = flat - flat.mean(dim=0, dtype=torch.float64)  # what it takes of memory is this difference
    return flat @ flat.T / flat.shape[1]


def squared_errors(gram: Tensor, out: Tensor, kept: Tensor, weight: Tensor) -> Tensor:
    """Of sums of spectra against spectra that are held out, a pixel, from the inner products of all, (o,).

    Args:
        gram: inner products, (n, n).
        out, kept: which spectra are held out and which are summed, bool (n,).
        weight: of each one kept in each sum, (o, k); the mean spectrum makes up for what the weights lack of 1.
    """
    own = gram.diagonal()[out]
    return own - 2 * (weight * gram[out][:, kept]).sum(1) + ((weight @ gram[kept][:, kept]) * weight).sum(1)
