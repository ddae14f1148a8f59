"""The motion's prior - its kernel and its rank - chosen from the training spectra alone.

Positions whose spectra resemble each other should move alike. So the kernel is the one under which a Gaussian process on
the spectra's pixels best predicts training spectra that are held out: at random, or a whole region at a time where the
model will be asked for regions nobody measured. Everything follows from the spectra's inner products, hence a candidate
costs a few small linear solves and no rendering.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from swiftwrf.deformation import Kernel

NOISES = (1e-3, 1e-2, 1e-1)  # of spectra: little of a measured one is not a function of position
MIN_RANK, MAX_RANK = 24, 64
EXPLAINED = (
    0.05  # least share of a component's variance that counts as predicted: half of pure noise exceeds 0 by chance
)
MAX_ROWS = 400  # more do not change the choice, and a candidate costs their number cubed


def choose_kernel(position: Tensor, spectrum: Tensor, fold: Tensor) -> Kernel:
    """The candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Args:
        position: of the training spectra [m], (n, 3).
        spectrum: the training spectra, (n, H, W).
        fold: number of the part that each is held out with, (n,).
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    gram = _gram(spectrum)

    def score(kernel: Kernel) -> float:
        total = 0.0
        for out, kept, gain in held_out_weights(kernel, position, fold):
            own = gram.diagonal()[out]
            error = own - 2 * (gain * gram[out][:, kept]).sum(1) + ((gain @ gram[kept][:, kept]) * gain).sum(1)
            total -= float(error.clamp_min(1e-12).log().sum())
        return total

    return max(candidates(position, NOISES), key=score)


def choose_rank(position: Tensor, spectrum: Tensor, fold: Tensor, kernel: Kernel) -> int:
    """How many principal components of the spectra are predicted better than by their mean where they are held out.

    What varies from spectrum to spectrum in other components cannot be known at a position without measuring there, so
    a motion that could draw it would only learn noise.

    Args:
        position, spectrum, fold: as for `choose_kernel`.
        kernel: what it chose.
    """
    position, spectrum, fold = thinned(position, spectrum, fold)
    eigenvalue, eigenvector = torch.linalg.eigh(_gram(spectrum))
    component = eigenvector * eigenvalue.clamp_min(0).sqrt()  # (n, n), one column a component
    missed = torch.zeros_like(component)
    for out, kept, gain in held_out_weights(kernel, position, fold):
        missed[out] = component[out] - gain @ component[kept]
    predicted = missed.square().sum(dim=0) < (1 - EXPLAINED) * component.square().sum(dim=0)
    return int(predicted.sum().clamp(MIN_RANK, MAX_RANK))


def thinned(*tensors: Tensor, rows: int = MAX_ROWS) -> list[Tensor]:
    """At most so many rows of each, the same ones, evenly spread."""
    n = len(tensors[0])
    return [t[torch.linspace(0, n - 1, rows).long()] if n > rows else t for t in tensors]


def _gram(spectrum: Tensor) -> Tensor:
    """Inner products of the spectra's differences from their mean, a pixel, float64 (n, n)."""
    flat = spectrum.flatten(1).double()
    flat = flat - flat.mean(dim=0)
    return flat @ flat.T / flat.shape[1]


def candidates(position: Tensor, noises: Sequence[float]) -> Iterator[Kernel]:
    """Kernels with lengths from the extent of the positions (n, 3) [m] down, with and without a short-range part."""
    extent = float((position.max(0).values - position.min(0).values).max()) or 1.0
    for noise in noises:
        for k in range(5):
            long = extent / 2**k
            yield Kernel(long=long, short=extent, share=1.0, noise=noise)
            yield from (Kernel(long=long, short=extent / 3 / 2**j, share=0.6, noise=noise) for j in range(1, 6))


def held_out_weights(kernel: Kernel, position: Tensor, fold: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For each fold: which rows are out and which are kept, and the weights (out, kept) that predict the former."""
    covariance = kernel(position.double(), position.double())
    noisy = covariance + kernel.noise * torch.eye(len(position), dtype=covariance.dtype)
    for number in fold.unique():
        out, kept = fold == number, fold != number
        yield out, kept, torch.linalg.solve(noisy[kept][:, kept], covariance[kept][:, out]).T
