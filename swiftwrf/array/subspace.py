"""Directions of arrival from array snapshots: MUSIC, ESPRIT and maximum likelihood.

A snapshot of K elements is h = A s + noise. The columns of A are steering vectors a(u) = exp(j 2 pi x u), with the positions
x of the elements in wavelengths and the direction cosines u of a source. All methods use the covariance R of the snapshots
of one position:

    MUSIC:   maxima of |E^H a|^2, with the eigenvectors E of the q largest eigenvalues of R
             (R. O. Schmidt, "Multiple emitter location and signal parameter estimation", IEEE Trans. AP 34, 1986)
    ESPRIT:  phases of the eigenvalues of the shift between displaced groups of elements
             (R. Roy and T. Kailath, IEEE Trans. ASSP 37, 1989)
    maximum likelihood: maximum of tr(P R), with the projection P onto the columns of A, by alternating projection
             (I. Ziskind and M. Wax, IEEE Trans. ASSP 36, 1988)

Maximum likelihood is the deterministic one. For one source it is also the stochastic one and the maximum of the Bartlett
beamformer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.beamforming import covariance
from swiftwrf.array.planar import PlanarArray, differences, pairs
from swiftwrf.errors import InputError

Sources = int | Literal["mdl", "aic"]
Method = Callable[[PlanarArray, Tensor, int], Tensor]  # (array, covariance (n, K, K), q) to direction cosines (n, q, d)

POINTS_PER_BEAM = 8  # of the search, along the width of a beam of the whole array
NEWTON_STEPS = 12
EDGE = 1e-9  # distance of direction cosines from the unit circle within which they are on it
ALTERNATIONS = 8  # over all sources, of alternating projection
MIN_NORM = 1e-2  # of a steering vector outside the span of the others, squared, relative to its norm
MAX_ESPRIT_SHIFT = 0.51  # wavelengths, beyond which phases are ambiguous, not only near the plane or the axis
BATCH_ROWS, BATCH_VALUES = 256, 2**24  # covariances at a time, and basis values at a time


def music(array: PlanarArray, channel: Tensor, sources: Sources = 1, *, forward_backward: bool = False) -> Tensor:
    """Return the directions of the sources by MUSIC.

    Args:
        array: The K elements and the wavelength.
        channel: Snapshots of n positions, complex (n, S, K).
        sources: Number of sources of each position, from 1 to K - 1, or the criterion that determines it: "mdl" or "aic".
        forward_backward: Average the covariance with that of the array turned by 180 degrees. It separates two coherent
            paths, which otherwise count as one source. The array must have point symmetry.

    Returns:
        Unit vectors in array coordinates, the strongest source first, float64 (n, q, 3), folded as `PlanarArray.folded`.
        q is the largest number of sources. Rows with fewer end in nan.

    Raises:
        InputError: A number of sources that the array cannot separate, too few snapshots for the criterion, or an array
            without point symmetry for `forward_backward`.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> music(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[[0.6, 0.64, 0.48]]]
    """
    return _directions(_music, array, channel, sources, forward_backward)


def esprit(array: PlanarArray, channel: Tensor, sources: Sources = 1, *, forward_backward: bool = False) -> Tensor:
    """Return the directions of the sources by ESPRIT, with arguments and errors as `music`.

    The array must have elements at most half a wavelength apart, along two directions or, if it is linear, along its axis.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> esprit(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[[0.6, 0.64, 0.48]]]
    """
    return _directions(_esprit, array, channel, sources, forward_backward)


def maximum_likelihood(
    array: PlanarArray, channel: Tensor, sources: Sources = 1, *, forward_backward: bool = False
) -> Tensor:
    """Return the directions of the sources by deterministic maximum likelihood, with arguments and errors as `music`.

    Unlike MUSIC it also separates coherent paths.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48]], dtype=torch.float64)
        >>> maximum_likelihood(array, torch.exp(1j * array.phase(towards))[:, None]).round(decimals=6).tolist()
        [[[0.6, 0.64, 0.48]]]
    """
    return _directions(_maximum_likelihood, array, channel, sources, forward_backward)


def count_sources(channel: Tensor, criterion: Literal["mdl", "aic"] = "mdl") -> Tensor:
    """Return the number of sources in the snapshots of each position, int64 (n,), from 1 to K - 1.

    Coherent paths count as one source (M. Wax and T. Kailath, IEEE Trans. ASSP 33, 1985).

    Args:
        channel: Snapshots, complex (n, S, K).
        criterion: Minimum description length, or Akaike's information criterion, which overestimates more often.

    Raises:
        InputError: Not more snapshots than elements.

    Example:
        >>> noise = 0.01 * torch.randn(1, 50, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
        >>> count_sources(torch.randn(1, 50, 1, dtype=torch.complex128) + noise).tolist()
        [1]
    """
    snapshots, elements = channel.shape[1:]
    if snapshots <= elements:
        raise InputError(
            f"{criterion} needs more snapshots than elements, got {snapshots} of {elements} elements; give the number of "
            "sources"
        )
    eigenvalue = torch.linalg.eigvalsh(covariance(channel)).clamp_min(1e-300)  # ascending
    smallest = torch.arange(elements, 0, -1)  # number of noise eigenvalues for 0, 1, ... sources
    log_geometric = eigenvalue.log().cumsum(1)[:, smallest - 1] / smallest
    log_arithmetic = (eigenvalue.cumsum(1)[:, smallest - 1] / smallest).log()
    misfit = snapshots * smallest * (log_arithmetic - log_geometric)
    number = elements - smallest
    parameters = number * (2 * elements - number)
    penalty = parameters / 2 * math.log(snapshots) if criterion == "mdl" else parameters
    found: Tensor = (misfit + penalty).argmin(dim=1).clamp_min(1)
    return found


def _directions(
    method: Method, array: PlanarArray, channel: Tensor, sources: Sources, forward_backward: bool
) -> Tensor:
    """Return the directions that a method finds, strongest first; see `music`."""
    elements = len(array.element)
    counts = count_sources(channel, sources) if isinstance(sources, str) else torch.full((len(channel),), sources)
    if len(counts) and not 1 <= int(counts.min()) <= int(counts.max()) < elements:
        raise InputError(f"an array of {elements} elements separates 1 to {elements - 1} sources, got {sources}")
    opposite = array.opposite if forward_backward else None
    if forward_backward and opposite is None:
        raise InputError("forward-backward averaging needs an array with point symmetry")
    found = torch.full((len(channel), int(counts.max()) if len(counts) else 0, 3), torch.nan, dtype=torch.float64)
    for count in counts.unique().tolist():
        for rows in (counts == count).nonzero()[:, 0].split(BATCH_ROWS):
            matrix = covariance(channel[rows])
            if opposite is not None:
                matrix = (matrix + matrix[:, opposite][:, :, opposite].conj()) / 2
            cosine = _strongest_first(array, matrix, method(array, matrix, count))
            z = (1 - cosine.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()
            found[rows, :count] = torch.cat([cosine @ _axes(array).T, z], dim=-1)
    return found


def _axes(array: PlanarArray) -> Tensor:
    """Return the directions along which the array extends, float64 (2, d): d is 1 for a linear array, otherwise 2."""
    return torch.eye(2, dtype=torch.float64) if array.axis is None else array.axis[:2, None].double()


def _steering(array: PlanarArray, cosine: Tensor) -> Tensor:
    """Return steering vectors as columns, complex128 (n, K, q), of direction cosines (n, q, d)."""
    phase = array.phase(cosine @ _axes(array).T).mT
    return torch.polar(torch.ones_like(phase), phase)


def _strongest_first(array: PlanarArray, matrix: Tensor, cosine: Tensor) -> Tensor:
    """Return direction cosines (n, q, d) by descending power of the least-squares amplitudes."""
    inverse = torch.linalg.pinv(_steering(array, cosine))
    power = (inverse @ matrix @ inverse.mH).diagonal(dim1=1, dim2=2).real
    return cosine.take_along_dim(power.argsort(dim=1, descending=True)[..., None], dim=1)


def _music(array: PlanarArray, matrix: Tensor, count: int) -> Tensor:
    vectors = torch.linalg.eigh(matrix).eigenvectors[..., -count:]
    objective = _Quotient(array, vectors @ vectors.mH)
    return objective.refine(objective.peaks(count))


def _maximum_likelihood(array: PlanarArray, matrix: Tensor, count: int) -> Tensor:
    """Alternating projection: a source adds b^H R b / |b|^2 to tr(P R), with the part b of a that the others do not span."""

    def beyond(others: Tensor) -> _Quotient:
        steering = _steering(array, others)
        rest = torch.eye(len(array.element), dtype=torch.complex128) - steering @ torch.linalg.pinv(steering)
        return _Quotient(array, rest @ matrix @ rest, rest)

    found = _Quotient(array, matrix).peaks(1)
    for _ in range(count - 1):
        found = torch.cat([found, beyond(found).peaks(1)], dim=1)
    for _ in range(ALTERNATIONS if count > 1 else 1):
        for number in range(count):
            others = [other for other in range(count) if other != number]
            objective = beyond(found[:, others]) if others else _Quotient(array, matrix)
            found[:, [number]] = objective.refine(found[:, [number]])
    return found


def _esprit(array: PlanarArray, matrix: Tensor, count: int) -> Tensor:
    signal = torch.linalg.eigh(matrix).eigenvectors[..., -count:]
    shift, groups = _shifts(array, count)
    rotations = [torch.linalg.pinv(signal[:, b]) @ signal[:, a] for a, b in groups]
    # one eigenbasis for both shifts pairs their eigenvalues; a sum of unequal parts has no double eigenvalue in general
    basis = torch.linalg.eig(rotations[0] + 0.6 * rotations[-1]).eigenvectors
    values = [(torch.linalg.inv(basis) @ rotation @ basis).diagonal(dim1=1, dim2=2) for rotation in rotations]
    cosine: Tensor = torch.stack([value.angle() for value in values], dim=-1) / math.tau @ torch.linalg.inv(shift).T
    inside: Tensor = cosine / cosine.norm(dim=-1, keepdim=True).clamp_min(1)
    return inside


def _shifts(array: PlanarArray, count: int) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Return d shifts (d, d) [wavelengths] along the axes, and for each the pairs of elements a = b + shift.

    Of the shifts up to half a wavelength those with most pairs are taken, the shorter of two.
    """
    lag = differences(array) @ _axes(array)
    first, second, number = pairs(array)
    n_pairs = number.bincount(minlength=len(lag))
    usable = (lag.norm(dim=1) <= MAX_ESPRIT_SHIFT) & (n_pairs >= count)
    order = sorted(usable.nonzero()[:, 0].tolist(), key=lambda n: (-int(n_pairs[n]), float(lag[n].norm())))
    chosen = order[:1]
    if lag.shape[1] == 2 and chosen:
        unit = lag / lag.norm(dim=1, keepdim=True)
        chosen += [n for n in order if abs(float(torch.linalg.det(unit[[chosen[0], n]]))) > 0.5][:1]
    if len(chosen) < lag.shape[1]:
        raise InputError(
            f"ESPRIT needs {count} or more pairs of elements with one shift of at most half a wavelength, along "
            f"{'two directions' if lag.shape[1] == 2 else 'the axis'}; use MUSIC"
        )
    return lag[chosen], [(first[number == n], second[number == n]) for n in chosen]


class _Quotient:
    """The function a^H N a / a^H D a of direction cosines, for n Hermitian matrices.

    Args:
        array: The elements.
        numerator: Matrices N, (n, K, K).
        denominator: Matrices D, (n, K, K), of which a^H D a is at most K. Defaults to the unit matrix.
    """

    def __init__(self, array: PlanarArray, numerator: Tensor, denominator: Tensor | None = None) -> None:
        unit = torch.eye(len(array.element), dtype=torch.complex128)[None]
        self.elements = len(array.element)
        self.lag = differences(array) @ _axes(array)
        self.numerator = array.coefficients(numerator)
        self.denominator = array.coefficients(unit if denominator is None else denominator).expand_as(self.numerator)
        element = array.element.double() @ _axes(array) / array.wavelength
        self.step = 1 / (POINTS_PER_BEAM * float((element.amax(dim=0) - element.amin(dim=0)).max()))

    def peaks(self, count: int) -> Tensor:
        """Return the `count` largest local maxima on a grid, (n, count, d)."""
        side = 2 * math.ceil(1 / self.step) + 1
        dimensions = self.lag.shape[1]
        axis = torch.linspace(-1, 1, side, dtype=torch.float64)
        grid = torch.cartesian_prod(*[axis] * dimensions).reshape(-1, dimensions)
        inside = grid.norm(dim=1) <= 1
        value = torch.full((len(self.numerator), len(grid)), -torch.inf, dtype=torch.float64)
        value[:, inside] = torch.cat(
            [self._on_grid(some) for some in grid[inside].split(max(1, BATCH_VALUES // self.numerator.shape[1]))], dim=1
        )
        image = value.reshape(-1, 1, *[side] * dimensions)
        pool = functional.max_pool2d if dimensions == 2 else functional.max_pool1d
        is_peak = (image == pool(image, 3, stride=1, padding=1)).flatten(1) & value.isfinite()
        largest = value.amax(dim=1, keepdim=True) - value[:, inside].amin(dim=1, keepdim=True) + 1
        ranked = value - largest * ~is_peak  # any local maximum before any other point
        return grid[ranked.topk(count, dim=1).indices]

    def _on_grid(self, cosine: Tensor) -> Tensor:
        phase = math.tau * cosine @ self.lag.T
        basis = torch.cat([torch.ones_like(phase[:, :1]), phase.cos(), phase.sin()], dim=1).T
        norm = self.denominator @ basis
        least = MIN_NORM * self.elements
        return (self.numerator @ basis / norm.clamp_min(least)).where(norm > least, 0)

    def refine(self, cosine: Tensor) -> Tensor:
        """Return local maxima from direction cosines (n, m, d), by Newton steps of at most one grid step.

        Elements half a wavelength apart do not distinguish the two ends of an axis on the grid. A maximum at the edge is
        refined from the opposite end, too, and the larger one is returned.
        """
        found = self._ascended(cosine)
        is_edge = found.norm(dim=-1) > 1 - EDGE
        if not bool(is_edge.any()):
            return found
        opposite = self._ascended(-cosine)
        is_larger = self._value(opposite) > self._value(found)
        return torch.where((is_edge & is_larger)[..., None], opposite, found)

    def _value(self, cosine: Tensor) -> Tensor:
        norm = self._derivatives(self.denominator, cosine)[0]
        return self._derivatives(self.numerator, cosine)[0] / norm.clamp_min(MIN_NORM * self.elements)

    def _ascended(self, cosine: Tensor) -> Tensor:
        for _ in range(NEWTON_STEPS):
            value, gradient, hessian = self._derivatives(self.numerator, cosine)
            norm, norm_gradient, norm_hessian = self._derivatives(self.denominator, cosine)
            quotient = value / norm.clamp_min(MIN_NORM * self.elements)
            gradient = gradient - quotient[..., None] * norm_gradient
            hessian = hessian - quotient[..., None, None] * norm_hessian
            curvature, axes = torch.linalg.eigh(hessian)
            along = (gradient[..., None, :] @ axes)[..., 0, :] / curvature.abs().clamp_min(1e-12 * self.elements)
            step = (axes @ along[..., None])[..., 0]
            cosine = cosine + step * (self.step / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1)
            cosine = cosine / cosine.norm(dim=-1, keepdim=True).clamp_min(1)
        return cosine

    def _derivatives(self, coefficient: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return value (n, m), gradient (n, m, d) and Hessian (n, m, d, d) of a co-array sum."""
        phase = math.tau * cosine @ self.lag.T
        constant, even, odd = coefficient[:, None].split([1, len(self.lag), len(self.lag)], dim=-1)
        wave = even * phase.cos() + odd * phase.sin()
        slope = odd * phase.cos() - even * phase.sin()
        hessian = -(math.tau**2) * torch.einsum("nmp,pi,pj->nmij", wave, self.lag, self.lag)
        return constant[..., 0] + wave.sum(-1), math.tau * slope @ self.lag, hessian
