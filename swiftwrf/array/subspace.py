"""Direction of arrival of one source from array snapshots: MUSIC, ESPRIT and maximum likelihood.

A snapshot of K elements is h = a(u) s + noise, with the steering vector a(u) = exp(j 2 pi x u), the positions x of the
elements in wavelengths and the direction cosines u of the source. All methods use the covariance R of the snapshots of one
position:

    MUSIC:   maximum of |e^H a|^2, with the eigenvector e of the largest eigenvalue of R
             (R. O. Schmidt, "Multiple emitter location and signal parameter estimation", IEEE Trans. AP 34, 1986)
    ESPRIT:  phase of e between displaced groups of elements
             (R. Roy and T. Kailath, IEEE Trans. ASSP 37, 1989)
    maximum likelihood: maximum of a^H R a, that of the Bartlett beamformer
             (I. Ziskind and M. Wax, IEEE Trans. ASSP 36, 1988)
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.array.beamforming import covariance
from swiftwrf.array.planar import PlanarArray, differences, pairs
from swiftwrf.errors import InputError

Method = Callable[[PlanarArray, Tensor], Tensor]  # (array, covariance (n, K, K)) to direction cosines (n, d)

EDGE = 1e-9  # distance of direction cosines from the unit circle within which they are on it
BATCH_ROWS = 256  # covariances at a time


def music(array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the direction of the source by MUSIC.

    Args:
        array: The K elements and the wavelength.
        channel: Snapshots of n positions, complex (n, S, K).

    Returns:
        Unit vectors in array coordinates, float64 (n, 3), folded as `PlanarArray.folded`.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> music(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[0.6, 0.64, 0.48]]
    """
    return _directions(_music, array, channel)


def esprit(array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the direction of the source by ESPRIT, with arguments and result of `music`.

    The array must have elements at most half a wavelength apart, along two directions or, if it is linear, along its axis.

    Raises:
        InputError: An array without such elements.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> esprit(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[0.6, 0.64, 0.48]]
    """
    return _directions(_esprit, array, channel)


def maximum_likelihood(array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the direction of the source by maximum likelihood, with arguments and result of `music`.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> maximum_likelihood(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[0.6, 0.64, 0.48]]
    """
    return _directions(_maximum, array, channel)


def _directions(method: Method, array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the directions that a method finds; see `music`."""
    found = torch.empty(len(channel), 3, dtype=torch.float64)
    for rows in torch.arange(len(channel)).split(BATCH_ROWS):
        cosine = method(array, covariance(channel[rows]))
        z = (1 - cosine.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()
        found[rows] = torch.cat([cosine @ _axes(array).T, z], dim=-1)
    return found


def _axes(array: PlanarArray) -> Tensor:
    """Return the directions along which the array extends, float64 (2, d): d is 1 for a linear array, otherwise 2."""
    return torch.eye(2, dtype=torch.float64) if array.axis is None else array.axis[:2, None].double()


def _signal(matrix: Tensor) -> Tensor:
    """Return the eigenvector of the largest eigenvalue of each covariance, (n, K)."""
    largest: Tensor = torch.linalg.eigh(matrix).eigenvectors[..., -1]
    return largest


def _music(array: PlanarArray, matrix: Tensor) -> Tensor:
    signal = _signal(matrix)
    return _maximum(array, signal[..., None] @ signal[:, None].conj())


def _esprit(array: PlanarArray, matrix: Tensor) -> Tensor:
    signal = _signal(matrix)
    shift, groups = _shifts(array)
    turned = [(signal[:, b].conj() * signal[:, a]).sum(-1).angle() for a, b in groups]
    cosine: Tensor = torch.stack(turned, dim=-1) / math.tau @ torch.linalg.inv(shift).T
    inside: Tensor = cosine / cosine.norm(dim=-1, keepdim=True).clamp_min(1)
    return inside


def _shifts(array: PlanarArray) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Return d shifts (d, d) [wavelengths] along the axes, and for each the pairs of elements a = b + shift.

    Of the shifts up to half a wavelength those with most pairs are taken, the shorter of two.
    """
    lag = differences(array) @ _axes(array)
    first, second, number = pairs(array)
    n_pairs = number.bincount(minlength=len(lag))
    usable = lag.norm(dim=1) <= 0.51  # beyond, phases are ambiguous, not only near the plane or the axis
    order = sorted(usable.nonzero()[:, 0].tolist(), key=lambda n: (-int(n_pairs[n]), float(lag[n].norm())))
    chosen = order[:1]
    if lag.shape[1] == 2 and chosen:
        unit = lag / lag.norm(dim=1, keepdim=True)
        chosen += [n for n in order if abs(float(torch.linalg.det(unit[[chosen[0], n]]))) > 0.5][:1]
    if len(chosen) < lag.shape[1]:
        raise InputError(
            "ESPRIT needs pairs of elements with one shift of at most half a wavelength, along "
            f"{'two directions' if lag.shape[1] == 2 else 'the axis'}; use MUSIC"
        )
    return lag[chosen], [(first[number == n], second[number == n]) for n in chosen]


def _maximum(array: PlanarArray, matrix: Tensor) -> Tensor:
    """Return the direction cosines (n, d) at which a^H N a is largest, for Hermitian matrices N (n, K, K).

    The largest value on a grid is refined by Newton steps. Elements half a wavelength apart do not distinguish the two ends
    of an axis on the grid. A maximum at the edge is refined from the opposite end, too, and the larger one is returned.
    """
    coefficient, lag = array.coefficients(matrix), differences(array) @ _axes(array)
    element = array.element.double() @ _axes(array) / array.wavelength
    # 8 points along the width of a beam of the whole array
    step = 1 / (8 * float((element.amax(dim=0) - element.amin(dim=0)).max()))
    axis = torch.linspace(-1, 1, 2 * math.ceil(1 / step) + 1, dtype=torch.float64)
    grid = torch.cartesian_prod(*[axis] * lag.shape[1]).reshape(-1, lag.shape[1])
    grid = grid[grid.norm(dim=1) <= 1]
    parts = grid.split(max(1, 2**24 // coefficient.shape[1]))
    start = grid[torch.cat([coefficient @ _basis(lag, part).T for part in parts], dim=1).argmax(dim=1)]
    found, value = _ascended(coefficient, lag, start, step)
    is_edge = found.norm(dim=-1) > 1 - EDGE
    if not bool(is_edge.any()):
        return found
    opposite, other = _ascended(coefficient, lag, -found, step)
    return torch.where((is_edge & (other > value))[:, None], opposite, found)


def _basis(lag: Tensor, cosine: Tensor) -> Tensor:
    """Return the functions of direction cosines (m, d) whose sum by the coefficients is a^H N a, (m, 1 + 2 P)."""
    phase = math.tau * cosine @ lag.T
    return torch.cat([torch.ones_like(phase[:, :1]), phase.cos(), phase.sin()], dim=1)


def _ascended(coefficient: Tensor, lag: Tensor, cosine: Tensor, largest: float) -> tuple[Tensor, Tensor]:
    """Return local maxima from direction cosines (n, d), by Newton steps of at most `largest`, and their values (n,)."""
    _, even, odd = coefficient.split([1, len(lag), len(lag)], dim=-1)
    for _ in range(12):
        phase = math.tau * cosine @ lag.T
        gradient = math.tau * (odd * phase.cos() - even * phase.sin()) @ lag
        hessian = -(math.tau**2) * torch.einsum("np,pi,pj->nij", even * phase.cos() + odd * phase.sin(), lag, lag)
        curvature, axes = torch.linalg.eigh(hessian)
        along = (gradient[:, None] @ axes)[:, 0] / curvature.abs().clamp_min(1e-12)
        step = (axes @ along[..., None])[..., 0]
        cosine = cosine + step * (largest / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1)
        cosine = cosine / cosine.norm(dim=-1, keepdim=True).clamp_min(1)
    return cosine, (coefficient * _basis(lag, cosine)).sum(dim=1)
