"""Diagnose errors of array snapshots before their frames: order of elements and axes, sign flips, phases without delay.

A wave from the line of sight has the phases a_k at the elements (`PlanarArray.phase`). The residual phases
r_k = h_k conj(a_k) of a channel h are equal at all elements if the direct path dominates, so |mean r_k|^2 is the fraction of
the power along the line of sight.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.array.beamforming import unit
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.snapshots import Snapshots

ROUND_TRIP = (
    "the phases are those of the way there and back, as of RFID and backscatter (--round-trip); elements are then "
    "{spacing:.2f} wavelengths apart{ambiguous}"
)


def other_readings(data: Snapshots) -> dict[str, Snapshots]:
    """Return the snapshots as they would be read under each error, by its description."""
    channel, array = data.channel, data.array
    found = {
        f"the elements are given {name}": replace(data, channel=channel[..., order])
        for name, order in _element_orders(array).items()
    }
    if channel.shape[1] == channel.shape[2]:
        swapped = "the axes of elements and subcarriers are swapped: give csi.transpose(0, 2, 1)"
        found[swapped] = replace(data, channel=channel.mT.contiguous())
    halved = PlanarArray(array.element, array.wavelength / 2)
    ambiguous = ", so directions are ambiguous" if halved.spacing_wavelengths > 0.51 else ""
    meaning = ROUND_TRIP.format(spacing=halved.spacing_wavelengths, ambiguous=ambiguous)
    return {meaning: replace(data, array=halved), **found}


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
    rank[order] = torch.nn.functional.pad((ordered.diff() > tolerance).long().cumsum(0), (1, 0))
    return rank


def arrives_along(data: Snapshots, direction: Tensor) -> bool:
    """Return True if most of the power arrives along directions (n, 3) in array coordinates.

    Random phases at K elements have the fraction 1 / K along any direction. Only the excess over it counts, and it must be
    larger for fewer elements, whose phases agree more easily by chance.
    """
    residual = _unit_channel(data) * unit_phasor(data.array.phase(direction))[:, None].conj()
    share, chance = float(residual.mean(dim=-1).abs().square().mean()), 1 / residual.shape[-1]
    return (share - chance) / (1 - chance) >= 0.45 + chance


def flipping_elements(data: Snapshots) -> list[int]:
    """Return the elements whose phase changes by half a turn from measurement to measurement, counted from 1.

    Of two groups that flip against each other, the larger one counts as steady.
    """
    channel, steering = _unit_channel(data), unit_phasor(data.array.phase(data.direction))
    residual = channel * steering[:, None].conj()
    plain, doubled = (residual.pow(power).mean(dim=-1).abs().square() for power in (1, 2))
    sign, mended = _without_flips(residual)
    # pairings of channels with lines of sight of other positions
    rolled = (steering.roll(shift, 0) for shift in {max(1, len(data) * k // 6) for k in range(1, 6)})
    chance = torch.stack([_without_flips(channel * other[:, None].conj())[1].mean() for other in rolled]).mean()
    gain = min(mended.mean() - plain.mean(), mended.mean() - chance)
    # fractions of the power along the line of sight; flips do not change that of the squared channel
    if gain < 0.15 or mended.median() < 0.75 or doubled.median() < 0.5:
        return []
    signs = sign.flatten(0, 1)
    together = (signs.T @ signs / len(signs)).abs() > 0.8
    steady = together[int(together.sum(dim=1).argmax())]
    reference = residual[..., steady].mean(dim=-1, keepdim=True).angle()
    cosine = (residual * unit_phasor(-reference)).real.abs().mean(dim=(0, 1))
    if bool((cosine[~steady] < 0.85).any()):  # phases that change by other angles; random ones have a mean of 0.64
        return []
    return [number + 1 for number in (~steady).nonzero()[:, 0].tolist()]


def _without_flips(residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the signs (n, S, K) that align residual phases best, and the fraction of the power with them (n, S)."""
    axis = residual.square().mean(dim=-1, keepdim=True).angle() / 2
    aligned = residual * unit_phasor(-axis)
    sign = torch.where(aligned.real < 0, -1.0, 1.0).double()
    return sign, (aligned * sign).mean(dim=-1).abs().square()


def phases_are_constant(data: Snapshots) -> bool:
    """Return True if the phases between elements hardly depend on the position, although the lines of sight differ."""
    channel, steering = _unit_channel(data), unit_phasor(data.array.phase(data.direction))
    each = channel.mT @ channel.conj() / channel.shape[1]
    of_one_position = torch.linalg.eigvalsh(each)[:, -1].mean()
    common = torch.linalg.eigvalsh(each.mean(dim=0))[-1] / of_one_position
    geometric = torch.linalg.eigvalsh(steering.T @ steering.conj() / len(data))[-1] / len(data.array.element)
    # beyond 0.65 the lines of sight are too close to each other
    return bool(common > 0.8 and geometric < 0.65)


def _unit_channel(data: Snapshots) -> Tensor:
    """Return the phases of some snapshots of each position, complex128 (n, S, K)."""
    few = data.channel[:, :: max(1, data.channel.shape[1] // 8)]
    return unit(few)


def unit_phasor(phase: Tensor) -> Tensor:
    """Return exp(j phase) for phases [rad] of any shape."""
    return torch.polar(torch.ones_like(phase), phase)
