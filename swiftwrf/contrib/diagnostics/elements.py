"""Diagnose errors of array snapshots before their frames: order of elements and axes, sign flips, phases without delay.

A wave from the line of sight has the phases a_k at the elements (`PlanarArray.phase`). The residual phases
r_k = h_k conj(a_k) of a channel h are equal at all elements if the direct path dominates, so |mean r_k|^2 is the fraction of
the power along the line of sight.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.beamforming import unit, unit_phasor
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.errors import listed

MIN_SCALE = 0.06  # of wavelengths, relative to the declared one and to its half
ORDERS = 40  # from which the order of the elements is searched


def other_readings(data: Snapshots, away: Tensor) -> Iterator[tuple[str, float, Snapshots]]:
    """Yield each error, its number of fitted parameters, and the snapshots as they would be read without it.

    Direct paths begin at points `away` (n, 3) [m] in array coordinates.
    """
    data = replace(data, frequency_hz=None)  # those of another carrier
    channel, array = data.channel, data.array
    for name, order in _element_orders(array).items():
        yield f"the elements are given {name}", 0, replace(data, channel=channel[..., order])
    if channel.shape[1] == channel.shape[2]:
        remedy = "give csi.transpose(0, 2, 1), in MATLAB permute(csi, [1 3 2])"
        swapped = replace(data, channel=channel.mT.contiguous())
        yield f"the axes of elements and subcarriers are swapped: {remedy}", 0, swapped
    halved = PlanarArray(array.element, array.wavelength / 2)
    ambiguous = ", so directions are ambiguous" if halved.spacing_wavelengths > 0.51 else ""
    apart = f"elements are then {halved.spacing_wavelengths:.2f} wavelengths apart{ambiguous}"
    meaning = f"the phases are those of the way there and back, as of RFID and backscatter (--round-trip); {apart}"
    yield meaning, 0, replace(data, array=halved)
    scales = torch.logspace(math.log10(0.38), math.log10(3.5), 50, dtype=torch.float64).tolist()
    scaled = {scale: replace(data, array=PlanarArray(array.element, array.wavelength / scale)) for scale in scales}
    scale = max(scaled, key=lambda scale: float(evidence(scaled[scale], away).mean()))
    if min(abs(math.log(scale)), abs(math.log(scale / 2))) > MIN_SCALE:
        carrier = f"the carrier is about {scaled[scale].array.frequency_hz / 1e9:.2g} GHz"
        yield f"{carrier}, or elements are {scale:.2f} times as far apart", 1, scaled[scale]
    if (degrees := phases_in_degrees(channel)) is not None:
        remedy = "take np.deg2rad of them before exp(1j * phase)"
        yield f"phases in degrees were taken as radians: {remedy}", 0, replace(data, channel=degrees)
    order = best_order(data, away)
    if moved := (order != torch.arange(len(order))).nonzero()[:, 0].tolist():
        names = " and ".join(map(str, moved)) if len(moved) == 2 else listed(moved)
        remedy = f"are exchanged, counted from 0: give csi[..., {order.tolist()}]"
        yield f"elements {names} {remedy}", len(moved) / 2, replace(data, channel=channel[..., order])


def phases_in_degrees(channel: Tensor, max_error: float = 3e-4) -> Tensor | None:
    """Return channels (n, S, K) whose phases were degrees that were taken as radians. None if they were not.

    Degrees were rounded, to 0.01 or more, so that their number of turns follows. At most a tenth of the values are further
    than `max_error` steps from such a number (not studied).

    Example:
        >>> degrees = torch.arange(-180.0, 180.0, 7.0, dtype=torch.float64)[:, None, None]
        >>> channel = torch.polar(torch.ones_like(degrees), degrees)
        >>> bool(torch.allclose(phases_in_degrees(channel).angle().rad2deg(), degrees, atol=1e-3))
        True
    """
    sample = channel[channel.abs() > 0][:2000].to(torch.complex128).angle()
    turns = math.tau * torch.arange(-29, 59)  # of -180 to 360 degrees
    for step in (1.0, 0.5, 0.1, 0.05, 0.01):
        steps = (sample[:, None] + turns) / step
        if float(((steps - steps.round()).abs().amin(dim=1) < max_error).double().mean()) < 0.9:
            continue
        phase = channel.to(torch.complex128).angle()
        steps = (phase[..., None] + turns) / step
        degrees = (phase + turns[(steps - steps.round()).abs().argmin(dim=-1)]).round(decimals=2)
        if float(degrees.abs().median()) > 10:  # small numbers of radians may be round, too
            return torch.polar(channel.abs(), degrees.deg2rad().to(channel.abs().dtype))
    return None


def in_fft_order(data: Snapshots, min_step: float = 0.3, min_count: int = 8) -> bool:
    """Return True if subcarriers look to be in the order of an FFT, from zero frequency, although the carriers ascend.

    In this order the phase steps in the middle, from the highest to the lowest frequency, and the last subcarrier continues
    with the first. The step is at least `min_step` [rad], that of other neighbours at most a third of it (not studied).
    """
    carriers, count = data.frequency_hz, data.channel.shape[1]
    if carriers is None or count < min_count or bool((carriers.diff() <= 0).any()):
        return False
    channel = unit(data.channel)
    product = (channel.roll(-1, 1) * channel.conj()).mean(
        dim=(0, 2)
    )  # from each subcarrier to the next, the last to the first
    usual = product[: count // 4].mean()
    step = (product * usual.conj()).angle().abs()
    middle = step[count // 2 - 2 : count // 2 + 2].max()
    others = step[: count // 4].max()
    return float(middle) >= min_step and float(max(others, step[-1] / 2)) <= float(middle) / 3


def _element_orders(array: PlanarArray) -> dict[str, Tensor]:
    """Return the order (K,) of the channels if elements of a lattice are given along its other axis, by description."""
    tolerance = 1e-3 * array.wavelength  # between coordinates of elements in one row or column
    sites = [_ranks(array.element[:, axis], tolerance) for axis in (0, 1)]
    columns, rows = (int(rank.max()) + 1 for rank in sites)
    if columns * rows != len(array.element) or min(rows, columns) < 2:
        return {}
    declared = sites[1] * columns + sites[0]
    by_row = torch.arange(rows * columns).reshape(rows, columns)
    row_wise = bool((sites[1].diff() == 0).sum() > (sites[0].diff() == 0).sum())
    name = "column by column" if row_wise else "row by row"
    ends = {"": (), ", from the highest y": (0,), ", from the highest x": (1,), ", from the highest x and y": (0, 1)}
    orders = {}
    for end, flipped in ends.items():
        sequence = by_row.flip(flipped)
        given = (sequence.T if row_wise else sequence).flatten()  # lattice site of each channel
        orders[name + end] = given.argsort()[declared]
    return {meaning: order for meaning, order in orders.items() if not torch.equal(order, torch.arange(len(order)))}


def _ranks(values: Tensor, tolerance: float) -> Tensor:
    """Return the rank of each value among the distinct ones."""
    ordered, order = values.sort()
    rank = torch.empty_like(order)
    rank[order] = functional.pad((ordered.diff() > tolerance).long().cumsum(0), (1, 0))
    return rank


def wave_from(data: Snapshots, away: Tensor) -> Tensor:
    """Return the unit phasors (n, K) of waves from points `away` (n, 3) [m] in array coordinates.

    Waves are spheres if points lie in the near field and spheres fit the channels better.
    """
    plane = unit_phasor(data.array.phase(functional.normalize(away, dim=1)))
    if float(away.norm(dim=1).min()) > data.array.far_field_m:
        return plane
    curved = unit_phasor(data.array.phase_at(away))
    return max(plane, curved, key=lambda wave: float(_coherence(unit_channel(data) * wave[:, None].conj()).mean()))


def residual_of(data: Snapshots, away: Tensor) -> Tensor:
    """Return the residual phases (n, S, K) of channels beside waves from points `away` (n, 3) [m]."""
    return unit_channel(data) * wave_from(data, away)[:, None].conj()


def evidence(data: Snapshots, away: Tensor) -> Tensor:
    """Return the fraction (n,) of the power that arrives from points `away` (n, 3) [m], in excess of random phases."""
    return excess(_coherence(residual_of(data, away)), 1 / data.channel.shape[2])


def excess(share: Tensor, chance: float) -> Tensor:
    """Return a fraction as its excess over chance: 0 at chance, 1 at 1."""
    return (share - chance) / (1 - chance)


def _coherence(residual: Tensor) -> Tensor:
    """Return the fraction (n,) of the power of residual phases (n, S, K) that is equal at all elements."""
    power = residual.abs().square().sum(dim=(1, 2)).clamp_min(1e-12)
    return residual.sum(dim=2).abs().square().sum(dim=1) / power / residual.shape[2]


def best_order(data: Snapshots, away: Tensor) -> Tensor:
    """Return the order (K,) of the channels with most power along the direct paths from points `away` (n, 3).

    From several orders, each channel is assigned to the element whose wave it follows best, relative to the sum of all.
    """
    channel = unit_channel(data)
    wave = wave_from(data, away)[:, None].conj().expand_as(channel).flatten(0, 1)
    channel, elements = channel.flatten(0, 1), channel.shape[2]
    draw = torch.Generator().manual_seed(0)

    def total(order: Tensor) -> Tensor:
        return (channel[:, order] * wave).sum(dim=1, keepdim=True)

    found = []
    for start in range(ORDERS):
        order = torch.randperm(elements, generator=draw) if start else torch.arange(elements)
        for _ in range(30):
            aligned = channel * unit(total(order)).conj()
            assigned = torch.from_numpy(linear_sum_assignment(-(wave.T @ aligned).real.numpy())[1])
            if torch.equal(assigned, order):
                break
            order = assigned
        found.append(order)
    return max(found, key=lambda order: float(total(order).abs().square().mean()))


def noisy_elements(data: Snapshots, away: Tensor) -> list[int]:
    """Return the elements whose phase follows no other element, counted from 0, if most others follow each other."""
    residual = residual_of(data, away).flatten(0, 1)
    coherence = (residual.T @ residual.conj() / len(residual)).abs().fill_diagonal_(0)
    others = coherence.sort(dim=1, descending=True).values[:, : max(1, len(coherence) // 2)].mean(dim=1)
    noise = others < 0.25
    return noise.nonzero()[:, 0].tolist() if bool((others[~noise] > 0.5).all()) and int((~noise).sum()) >= 2 else []


def in_noise(elements: list[int]) -> str:
    """Return in words that elements, counted from 0, hold noise."""
    names = list(map(str, elements))
    remedy = f"(--drop-elements {' '.join(names)})"
    return f"elements {', '.join(names)}, counted from 0, hold noise: their phase follows no other element {remedy}"


def sloped(data: Snapshots, away: Tensor) -> Tensor:
    """Return the evidence (n,) for phases that grow with the element's number, by another slope in each snapshot.

    Chance is that of slopes fitted to direct paths of other positions: a linear array confounds slopes and directions.
    """
    channel, wave = unit_channel(data), wave_from(data, away)
    n, count, elements = channel.shape

    def fitted(shift: int) -> tuple[Tensor, Tensor]:
        power, slope = (
            torch.fft.fft(channel * wave.roll(shift, 0)[:, None].conj(), 8 * elements).abs().square().max(dim=2)
        )
        return (power / elements**2).mean(dim=1), slope * math.tau / (8 * elements)

    share, slope = fitted(0)
    steady = unit_phasor(slope * (elements - 1) / 2).mean(dim=1).abs().mean()
    if count < 2 or float(steady) > 0.9:
        return torch.zeros(n)
    chance = torch.stack([fitted(max(1, n * k // 6))[0] for k in range(1, 6)]).mean()
    return excess(share, float(chance))


def flipping_elements(data: Snapshots, away: Tensor) -> tuple[list[int], Tensor]:
    """Return the elements whose phase changes by half a turn from measurement to measurement, and the evidence (n,).

    Elements count from 0. Of two groups that flip against each other, the larger one counts as steady.
    """
    channel, wave = unit_channel(data), wave_from(data, away)
    residual = channel * wave[:, None].conj()
    plain, doubled = (residual.pow(power).mean(dim=-1).abs().square() for power in (1, 2))
    sign, mended = _without_flips(residual)
    # pairings of channels with lines of sight of other positions
    rolled = (wave.roll(shift, 0) for shift in {max(1, len(data) * k // 6) for k in range(1, 6)})
    chance = torch.stack([_without_flips(channel * other[:, None].conj())[1].mean() for other in rolled]).mean()
    gain = min(mended.mean() - plain.mean(), mended.mean() - chance)
    # fractions of the power along the line of sight; flips do not change that of the squared channel
    if gain < 0.15 or mended.median() < 0.75 or doubled.median() < 0.5:
        return [], torch.zeros(len(data))
    signs = sign.flatten(0, 1)
    together = (signs.T @ signs / len(signs)).abs() > 0.8
    steady = together[int(together.sum(dim=1).argmax())]
    reference = residual[..., steady].mean(dim=-1, keepdim=True).angle()
    cosine = (residual * unit_phasor(-reference)).real.abs().mean(dim=(0, 1))
    if bool((cosine[~steady] < 0.85).any()):  # phases that change by other angles; random ones have a mean of 0.64
        return [], torch.zeros(len(data))
    return (~steady).nonzero()[:, 0].tolist(), excess(mended.mean(dim=1), float(chance))


def _without_flips(residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the signs (n, S, K) that align residual phases best, and the fraction of the power with them (n, S)."""
    axis = residual.square().mean(dim=-1, keepdim=True).angle() / 2
    aligned = residual * unit_phasor(-axis)
    sign = torch.where(aligned.real < 0, -1.0, 1.0).double()
    return sign, (aligned * sign).mean(dim=-1).abs().square()


def constant_phases(data: Snapshots) -> Tensor:
    """Return the evidence (n,) for phases between elements that hardly depend on the position, 0 if they do."""
    channel, steering = unit_channel(data), unit_phasor(data.array.phase(data.direction))
    each = channel.mT @ channel.conj() / channel.shape[1]
    of_one_position = torch.linalg.eigvalsh(each)[:, -1].mean()
    power, vector = torch.linalg.eigh(each.mean(dim=0))
    geometric = torch.linalg.eigvalsh(steering.T @ steering.conj() / len(data))[-1] / len(data.array.element)
    # beyond 0.65 the lines of sight are too close to each other
    if power[-1] / of_one_position <= 0.8 or geometric >= 0.65:
        return torch.zeros(len(data))
    return excess(_coherence(channel * vector[:, -1].conj()), 1 / channel.shape[2])


def uncalibrated(data: Snapshots, away: Tensor) -> Tensor:
    """Return the evidence (n,) for constant phases of the elements beside those of the direct paths."""
    residual = residual_of(data, away)
    rows = residual.flatten(0, 1)
    phase = torch.linalg.eigh(rows.T @ rows.conj()).eigenvectors[:, -1]
    return excess(_coherence(residual * unit(phase).conj()), 1 / residual.shape[2])


def unit_channel(data: Snapshots) -> Tensor:
    """Return the phases of some snapshots of each position, complex128 (n, S, K)."""
    return unit(data.channel[:, :: max(1, data.channel.shape[1] // 8)])
