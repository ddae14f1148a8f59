"""The kernel of the motion's prior, chosen from the training spectra alone.

Positions whose spectra resemble each other should move alike. So the kernel is the one under which a Gaussian process on
the spectra's pixels best predicts training spectra that are held out: at random, or a whole region at a time where the
model will be asked for regions nobody measured. Everything follows from the spectra's inner products, hence a candidate
costs a few small linear solves and no rendering.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from swiftwrf.deformation import Kernel

MAX_ROWS = 400  # more do not change the choice, and a candidate costs their number cubed


def choose_kernel(position: Tensor, spectrum: Tensor, fold: Tensor) -> Kernel:
    """The candidate with the highest mean logarithm of 1 / MSE over held-out spectra.

    Args:
        position: of the training spectra [m], (n, 3).
        spectrum: the training spectra, (n, H, W).
        fold: number of the part that each is held out with, (n,).
    """
    if len(position) > MAX_ROWS:
        rows = torch.linspace(0, len(position) - 1, MAX_ROWS).long()
        position, spectrum, fold = position[rows], spectrum[rows], fold[rows]
    flat = spectrum.flatten(1).double()
    flat = flat - flat.mean(dim=0)
    gram = flat @ flat.T / flat.shape[1]
    extent = float((position.max(0).values - position.min(0).values).max()) or 1.0
    return max(_candidates(extent), key=lambda kernel: _score(kernel, position.double(), gram, fold))


def _candidates(extent: float) -> Iterator[Kernel]:
    for noise in (1e-3, 1e-2, 1e-1):
        for k in range(5):
            long = extent / 2**k
            yield Kernel(long=long, short=extent, share=1.0, noise=noise)
            yield from (Kernel(long=long, short=extent / 3 / 2**j, share=0.6, noise=noise) for j in range(1, 6))


def _score(kernel: Kernel, position: Tensor, gram: Tensor, fold: Tensor) -> float:
    covariance = kernel(position, position)
    noisy = covariance + kernel.noise * torch.eye(len(position), dtype=covariance.dtype)
    score = 0.0
    for number in fold.unique():
        out = fold == number
        kept = ~out
        gain = torch.linalg.solve(noisy[kept][:, kept], covariance[kept][:, out]).T  # prediction = gain @ kept spectra
        error = gram.diagonal()[out] - 2 * (gain * gram[out][:, kept]).sum(1) + ((gain @ gram[kept][:, kept]) * gain).sum(1)
        score -= float(error.clamp_min(1e-12).log().sum())
    return score
