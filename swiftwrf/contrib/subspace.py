"""Direction of arrival from array snapshots: MUSIC, ESPRIT and maximum likelihood of one source, and of the earliest path.

A snapshot of K elements is h = a(u) s + noise, with the steering vector a(u) = exp(j 2 pi x u), the positions x of the
elements in wavelengths and the direction cosines u of the source. All methods use the covariance R of the snapshots of one
position:

    MUSIC:   maximum of |e^H a|^2, with the eigenvector e of the largest eigenvalue of R
             (R. O. Schmidt, "Multiple emitter location and signal parameter estimation", IEEE Trans. AP 34, 1986)
    ESPRIT:  phase of e between displaced groups of elements
             (R. Roy and T. Kailath, IEEE Trans. ASSP 37, 1989)
    maximum likelihood: maximum of a^H R a, that of the Bartlett beamformer
             (I. Ziskind and M. Wax, IEEE Trans. ASSP 36, 1988)

Subcarriers resolve paths by their delays, too: `joint_music` searches directions and delays together.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.array.beamforming import covariance, of_unit_power
from swiftwrf.array.planar import PlanarArray, differences, pairs
from swiftwrf.errors import InputError

Method = Callable[[PlanarArray, Tensor], Tensor]  # (array, covariance (n, K, K)) to direction cosines (n, d)

EDGE = 1e-9  # distance of direction cosines from the unit circle within which they are on it
BATCH_ROWS = 256  # covariances at a time
BATCH_JOINT = 8  # positions whose directions and delays are searched together
MIN_SUBCARRIERS, MAX_SUBCARRIERS = 4, 16  # of which blocks of half as many are smoothed
MIN_EIGENVALUE = 0.02  # of the signals, relative to the largest
MIN_PEAK, MIN_GAIN = 0.7, 0.3  # of the paths among which the earliest is taken, relative to the strongest


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


def joint_music(array: PlanarArray, channel: Tensor, frequency_hz: Tensor) -> Tensor:
    """Return the direction of the earliest path by MUSIC over elements and subcarriers.

    Blocks of subcarriers are snapshots of one another (smoothing), because all paths are coherent (M. Kotaru, K. Joshi,
    D. Bharadia and S. Katti, "SpotFi: Decimeter level localization using WiFi", SIGCOMM 2015). A delay and a phase of each
    channel may be unknown.

    Args:
        array: The K elements and the wavelength.
        channel: Channels of n positions at S subcarriers, complex (n, S, K). At most 16 of them are used.
        frequency_hz: Frequencies (S,) [Hz], at least 4, at equal distances.

    Returns:
        Unit vectors in array coordinates, float64 (n, 3), folded as `PlanarArray.folded`.

    Raises:
        InputError: Fewer subcarriers, or others.

    Example:
        >>> array = PlanarArray.grid(4, 4, spacing=0.06, frequency_hz=2.4e9)
        >>> towards = torch.tensor([[0.6, 0.64, 0.48], [-0.6, 0.0, 0.8]], dtype=torch.float64)
        >>> frequency, delay = torch.linspace(2.36e9, 2.44e9, 8).double(), torch.tensor([20e-9, 40e-9]).double()
        >>> wave = torch.exp(1j * (array.phase(towards)[:, None] - math.tau * (delay[:, None] * frequency)[..., None]))
        >>> joint_music(array, wave.sum(dim=0)[None], frequency).round(decimals=2).tolist()
        [[0.6, 0.64, 0.48]]
    """
    order = frequency_hz.argsort()
    step, channel = frequency_hz[order].diff(), channel[:, order]
    if len(frequency_hz) < MIN_SUBCARRIERS or bool(((step / step.mean() - 1).abs() > 1e-3).any()):
        raise InputError(
            f"MUSIC over elements and subcarriers needs at least {MIN_SUBCARRIERS} subcarriers at equal distances, got "
            f"{len(frequency_hz)} snapshots; use music"
        )
    channel = channel[:, :: math.ceil(len(frequency_hz) / MAX_SUBCARRIERS)].to(torch.complex128)
    found = torch.cat([_earliest(array, some) for some in channel.split(BATCH_JOINT)])
    z = (1 - found.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()
    return torch.cat([found @ _axes(array).T, z], dim=-1)


def _earliest(array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the direction cosines (n, d) of the earliest of the strong paths of channels (n, S, K)."""
    n, count, _ = channel.shape
    size = (count + 1) // 2
    block = channel.unfold(1, size, 1)  # (n, blocks, K, size)
    if (opposite := array.opposite) is not None:
        block = torch.cat([block, block[:, :, opposite].flip(-1).conj()], dim=1)
    value, vector = torch.linalg.eigh(covariance(block.flatten(2)))
    most = min(block.shape[1], value.shape[1] // 2)
    strong = value[:, -most:] > MIN_EIGENVALUE * value[:, -1:]
    signal = (vector[..., -most:] * strong[:, None]).unflatten(1, (-1, size))  # (n, K, size, q)
    element = array.element.double() @ _axes(array) / array.wavelength
    half = math.ceil(8 * float((element.amax(dim=0) - element.amin(dim=0)).max()))
    axis = torch.linspace(-1, 1, 2 * half + 1, dtype=torch.float64)
    cosine = torch.cartesian_prod(*[axis] * element.shape[1]).reshape(-1, element.shape[1])
    delay = torch.arange(4 * size, dtype=torch.float64) / (4 * size)  # times the distance of the subcarriers

    def power(cosine: Tensor, delay: Tensor) -> Tensor:
        """Return the fraction of waves (n or 1, G, d) with delays (n or 1, G) in the signal subspace, (n, G)."""
        at_element = torch.exp(-1j * math.tau * (cosine @ element.T))
        at_subcarrier = torch.exp(1j * math.tau * delay[..., None] * torch.arange(size))
        wave = (at_element[..., None] * at_subcarrier[..., None, :]).flatten(2)
        inside = cosine.norm(dim=-1) <= 1 + EDGE
        matched: Tensor = (wave @ signal.flatten(1, 2)).abs().square().sum(-1) / wave.shape[-1] * inside
        return matched

    each = torch.cat([power(cosine[None], at.expand(1, len(cosine))) for at in delay], dim=1)
    whole = each.reshape(n, 1, len(delay), len(axis), len(cosine) // len(axis))
    around = torch.cat([whole[:, :, -1:], whole, whole[:, :, :1]], dim=2)
    highest = torch.nn.functional.max_pool3d(around, 3, stride=1, padding=(0, 1, 1))
    top = (whole * (whole == highest)).flatten(1).topk(most, dim=1)
    at, late = cosine[top.indices % len(cosine)], delay[top.indices // len(cosine)]
    reach = torch.tensor([*[axis[1] - axis[0]] * element.shape[1], delay[1]])
    offset = torch.cartesian_prod(*[torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64)] * len(reach))
    for _ in range(8):  # towards the maxima, on smaller and smaller grids
        near = torch.cat([at, late[..., None]], dim=-1)[:, :, None] + offset * reach
        value = power(near[..., :-1].flatten(1, 2), near[..., -1].flatten(1)).unflatten(1, (most, -1))
        best = near.gather(2, value.argmax(2)[..., None, None].expand(-1, -1, 1, near.shape[-1]))[:, :, 0]
        at, late, reach = best[..., :-1], best[..., -1], reach / 2
    wave = torch.exp(1j * math.tau * (at @ element.T))[:, :, None]
    wave = (wave * torch.exp(-1j * math.tau * late[..., None] * torch.arange(count))[..., None]).flatten(2)
    wave = wave * (top.values > MIN_PEAK * top.values[:, :1])[..., None]
    gain = (torch.linalg.pinv(wave.mT, rtol=1e-3) @ channel.flatten(1)[..., None])[..., 0].abs()
    strongest = late.gather(1, gain.argmax(1, keepdim=True))
    later = (late - strongest + 0.5) % 1 - 0.5
    first = later.masked_fill(gain < MIN_GAIN * gain.amax(1, keepdim=True), torch.inf).argmin(1)
    return at[torch.arange(n), first]


def _directions(method: Method, array: PlanarArray, channel: Tensor) -> Tensor:
    """Return the directions that a method finds; see `music`."""
    found = torch.empty(len(channel), 3, dtype=torch.float64)
    for rows in torch.arange(len(channel)).split(BATCH_ROWS):
        cosine = method(array, of_unit_power(channel[rows]))
        z = (1 - cosine.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()
        found[rows] = torch.cat([cosine @ _axes(array).T, z], dim=-1)
    return found


def _axes(array: PlanarArray) -> Tensor:
    """Return the directions along which the array extends, float64 (2, d): d is 1 for a linear array, otherwise 2."""
    return torch.eye(2, dtype=torch.float64) if array.axis is None else array.axis[:2, None].double()


def _music(array: PlanarArray, matrix: Tensor) -> Tensor:
    signal = torch.linalg.eigh(matrix).eigenvectors[..., -1]
    return _maximum(array, signal[..., None] @ signal[:, None].conj())


def _esprit(array: PlanarArray, matrix: Tensor) -> Tensor:
    signal = torch.linalg.eigh(matrix).eigenvectors[..., -1]
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
