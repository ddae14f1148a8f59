"""Phase retrieval: the phase of each element from the spectra, up to one phase for each spectrum.

A squared spectrum is the Fourier transform of the channel's autocorrelation over the co-array, of a channel whose elements
have modulus 1. A 4 x 4 array gives 48 real numbers for 15 unknown phases, so two-dimensional phase retrieval has a solution
(R. H. T. Bates, "Fourier phase problems are uniquely solvable in more than one dimension", Optik 61, 1982). The common phase
remains unknown. A rotation of the array by half a turn with all phases reversed gives the same spectrum.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray, basis, pairs
from swiftwrf.data.spectra import Spectra

MAX_PIXELS = 6000  # of a spectrum, for its few dozen coefficients


def autocorrelation(channel: Tensor, array: PlanarArray) -> Tensor:
    """Return r(l) = sum of h_a conj(h_b) over the pairs with difference l, divided by K^2, (..., K) to (..., P)."""
    a, b, lag = pairs(array)
    element = channel.movedim(-1, 0).contiguous()
    conjugate = element.conj().resolve_conj()
    total = element.new_zeros(int(lag.max()) + 1, *element.shape[1:])
    for first, second, number in zip(a.tolist(), b.tolist(), lag.tolist(), strict=True):
        total[number].addcmul_(element[first], conjugate[second])
    return total.movedim(0, -1) / channel.shape[-1] ** 2


def correlations(spectra: Spectra) -> Tensor:
    """Return the co-array numbers of spectra with a known array, complex128 (n, P)."""
    assert spectra.array is not None
    return coarray_numbers(spectra.store.batches(), spectra.array, spectra.grid)


def coarray_numbers(spectra: Iterable[Tensor], array: PlanarArray, grid: AngularGrid) -> Tensor:
    """Return r(l) of each spectrum by least squares on its square, complex128 (n, P).

    Args:
        spectra: Batches (b, H, W) of magnitudes, of which at most 6000 evenly chosen pixels are used.
        array: Array of the spectra.
        grid: Directions of the pixels.
    """
    functions = basis(array, grid)
    stride = max(1, functions.shape[1] // MAX_PIXELS) | 1  # odd: an even one would keep to every other column
    inverse = torch.linalg.pinv(functions[:, ::stride])
    coefficient = torch.cat([part.flatten(1)[:, ::stride].double().square() @ inverse for part in spectra])
    half = (coefficient.shape[1] - 1) // 2
    return torch.complex(coefficient[:, 1 : 1 + half], coefficient[:, 1 + half :]) / 2


def retrieve_phases(observed: Tensor, array: PlanarArray, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return unit-modulus channels with the observed autocorrelation, by Gauss-Newton steps from several starts.

    Args:
        observed: r(l) of each spectrum, complex128 (n, P).
        array: Antenna array of the spectra.
        seed: Seed of the random starts.

    Returns:
        Channels, complex128 (n, K), and the relative error of each autocorrelation, (n,).
    """
    a, b, lag = pairs(array)
    n, k = len(observed), len(array.element)
    generator = torch.Generator().manual_seed(seed)
    scale = observed.abs().square().sum(1).sqrt().clamp_min(1e-12)
    toeplitz = torch.eye(k, dtype=torch.complex128).repeat(n, 1, 1) / k
    count = torch.bincount(lag).double()
    toeplitz[:, a, b] = observed[:, lag] * k**2 / count[lag] / k
    toeplitz[:, b, a] = toeplitz[:, a, b].conj()
    phase = torch.linalg.eigh(toeplitz).eigenvectors[..., -1].angle()  # close to the solution if one path dominates
    best, error = phase.clone(), torch.full((n,), math.inf, dtype=torch.float64)
    for start in range(20):
        rows = (error > 5e-3).nonzero()[:, 0]
        if not len(rows):
            break
        x = phase[rows] + min(0.7 * start, 2.1) * torch.randn(len(rows), k, dtype=torch.float64, generator=generator)
        x, miss = _descend(x, observed[rows], a, b, lag)
        better = miss / scale[rows] < error[rows]
        best[rows[better]], error[rows[better]] = x[better], (miss / scale[rows])[better]
    return torch.polar(torch.ones_like(best), best), error


def _descend(phase: Tensor, observed: Tensor, a: Tensor, b: Tensor, lag: Tensor) -> tuple[Tensor, Tensor]:
    """Return phases (n, K) after Levenberg-Marquardt steps, and the norms of the residuals (n,)."""
    n, k = phase.shape
    difference = torch.zeros(len(a), k, dtype=torch.float64)
    difference[torch.arange(len(a)), a], difference[torch.arange(len(a)), b] = 1, -1
    gather = torch.zeros(int(lag.max()) + 1, len(a), dtype=torch.float64)
    gather[lag, torch.arange(len(a))] = 1 / k**2
    slope = (gather.T[:, :, None] * difference[:, None]).flatten(1)  # from products to derivatives by each phase

    def residual(x: Tensor) -> tuple[Tensor, Tensor]:
        product = torch.polar(torch.ones(n, len(a), dtype=torch.float64), x @ difference.T)
        return product, torch.view_as_real(product @ gather.T.to(product.dtype) - observed).flatten(1)

    damping = torch.full((n,), 1e-2, dtype=torch.float64)
    product, missed = residual(phase)
    for _ in range(40):
        jacobian = torch.view_as_real(1j * product).mT @ slope
        jacobian = jacobian.unflatten(2, (-1, k)).transpose(1, 2).flatten(1, 2)
        normal = jacobian.mT @ jacobian
        normal = normal + (damping * normal.diagonal(dim1=1, dim2=2).mean(1) + 1e-15)[:, None, None] * torch.eye(k)
        step = -torch.linalg.solve(normal, (jacobian.mT @ missed[..., None]))[..., 0]
        trial, after = residual(phase + step)
        better = after.square().sum(1) < missed.square().sum(1)
        phase = torch.where(better[:, None], phase + step, phase)
        missed, product = torch.where(better[:, None], after, missed), torch.where(better[:, None], trial, product)
        damping = torch.where(better, damping * 0.3, damping * 5).clamp(1e-9, 1e4)
    return phase, missed.norm(dim=1)
