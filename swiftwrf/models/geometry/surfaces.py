"""Search for reflecting surfaces of limited extent, such as table tops and fronts of cupboards, in the residual of channels.

A room and its furniture predict the field h at each position, and the measured channel x leaves the residual r = x - c h. A
surface at one more coordinate adds the wave w of its image with a gain of one sign where the surface is, and 0 elsewhere.
The gain is estimated in cells of the surface by matched filtering at half of the positions, and scored at the other half:

    improvement = 2 g Re(w^H r) - g^2 |w|^2.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swiftwrf.gp import subsample
from swiftwrf.models.geometry.channels import Channels, ends, superposed, waves
from swiftwrf.models.geometry.images import PlaneSet, mirror
from swiftwrf.models.geometry.planes import Plane
from swiftwrf.runtime.threads import parallel_map

MAX_SURFACES = 8  # of furniture; each adds images of the order of the room
MAX_STARTS = 40  # local maxima that are followed
STEP = 1 / 12  # of the offsets of the scan, in wavelengths
CELL, MAX_CELLS = 4.0, 12  # least edge of a cell in wavelengths, and cells along each side of the region
MAX_OFFSETS = 4000  # along each axis, those nearest to the fixed end
MAX_CHANNELS = 10_000  # positions times elements by which surfaces are searched
BATCH = 16  # offsets whose waves stay in a processor's cache


def find_surfaces(
    planes: PlaneSet,
    gain: Tensor,
    measured: Channels,
    low: Tensor,
    high: Tensor,
    *,
    significance: float = 1.0,
    start_gain: float = 0.12,
    rarity: float = 1.2,
    side_lobe: float = 0.05,
    margin_wavelengths: float = 2.0,
    open_margin_m: float = 3.0,
) -> list[Plane]:
    """Return surfaces along the axes that explain the residual of measured channels, the best first.

    Args:
        planes: Planes of one room.
        gain: Gains of its paths at the measured positions, (n, 1 + S).
        measured: Measured channels.
        low: Lower corner of the region with furniture, (3,) [m].
        high: Opposite corner (3,) [m].
        significance: Standard errors of the improvement that a surface needs. Low: held-out positions decide later.
        start_gain: Modulus of the gain that the fit of a surface starts from.
        rarity: Factor by which a surface whose sign differs from that of most planes must explain more, because a small
            shift of a plane looks like it.
        side_lobe: Fraction of the strongest improvement below which the search ends: as much may be left of a surface that
            is modelled imperfectly.
        margin_wavelengths: Distance beyond the region up to which surfaces are searched.
        open_margin_m: The same distance [m] on a side without a plane, where a wall may be hidden from most positions.

    The values of these options are not studied.
    """
    n, count, n_elements = measured.value.shape
    (rows,) = subsample(torch.arange(n), rows=max(1, MAX_CHANNELS // n_elements))
    measured, gain = measured.subset(rows), gain[rows]
    measured = replace(measured, value=measured.value[:, ends(count)], frequency=measured.frequency[ends(count)])
    scene = measured.scene
    wavelength = math.tau / scene.wavenumber
    residual = _Residual.of(measured, superposed(gain, waves(planes, scene, measured.frequency)), low, high)
    step = STEP * wavelength
    margin = [margin_wavelengths * wavelength if side in planes.by_side() else open_margin_m for side in range(6)]

    def scanned(axis: int) -> list[tuple[float, int, float]]:
        first, last = float(low[axis]) - margin[2 * axis], float(high[axis]) + margin[2 * axis + 1]
        return residual.maxima(axis, torch.arange(first, last, step, dtype=torch.float64))

    starts = sorted(itertools.chain(*parallel_map(scanned, range(3))), reverse=True)[:MAX_STARTS]
    surfaces: list[Plane] = []
    strongest = 0.0
    usual = float(planes.gain[0].sign().sum()) >= 0
    factor = torch.tensor([[1.0 if usual else rarity], [rarity if usual else 1.0]])  # of either sign
    fine = torch.linspace(-step, step, 9, dtype=torch.float64)
    while starts and len(surfaces) < MAX_SURFACES:
        tried = []
        for _, axis, at in starts:
            improvement = residual.improvement(axis, at + fine, planes)[0]
            sign, row = divmod(int((improvement.mean(-1) / factor).argmax()), len(fine))
            each = improvement[sign, row]
            error = float(each.std()) / math.sqrt(len(each))
            if float(each.mean()) > significance * error > 0:
                tried.append((float(each.mean() / factor[sign]), axis, at + float(fine[row]), sign))
        if not tried:
            break
        value, axis, at, sign = max(tried)
        strongest = max(value, strongest)
        if value < side_lobe * strongest:
            break
        residual = residual.without(axis, at, sign, planes)
        side = math.copysign(1.0, at - float(residual.fixed[axis]))
        normal = [side * float(other == axis) for other in range(3)]
        surfaces.append(Plane((normal[0], normal[1], normal[2]), side * at, (start_gain, -start_gain)[sign]))
        starts = [(v, a, o) for v, a, o, _ in tried if a != axis or abs(o - at) > 2 * step]
    return surfaces


@dataclass(frozen=True, eq=False)
class _Residual:
    """Measured channels and the part of them that is explained.

    Args:
        measured: Measured channels, of unit power at each position.
        factor: Factor of predicted waves in each snapshot, complex64 (n, F, 1).
        known: Explained part (n, F, K).
        low, cell_m: Corner [m] and edges (3,) [m] of the cells.
    """

    measured: Channels
    factor: Tensor
    known: Tensor
    low: Tensor
    cell_m: Tensor

    @classmethod
    def of(cls, measured: Channels, predicted: Tensor, low: Tensor, high: Tensor) -> _Residual:
        value = measured.value / measured.value.abs().square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-30)
        factor = _factor(value, predicted)
        edge = CELL * math.tau / measured.scene.wavenumber
        cell = ((high - low) / MAX_CELLS).clamp_min(edge)
        return cls(replace(measured, value=value), factor, factor * predicted, low, cell)

    @property
    def fixed(self) -> Tensor:
        """Position of the fixed end, (3,) [m]."""
        return self.measured.scene.fixed

    def _waves(self, axis: int, offset: Tensor, planes: PlaneSet | None) -> tuple[Tensor, Tensor]:
        """Return the waves of surfaces at offsets (B,) [m], (B, C n, F, K), and the cell of each reflection, (B, C n).

        The C paths reflect at the surface alone and, given planes, at each of these between the surface and either end.
        """
        scene, normal = self.measured.scene, torch.zeros(3, 1, 1, dtype=torch.float64)
        normal[axis] = 1.0
        fixed, moving, transmitter = (x.T[:, None] for x in (self.fixed[None], scene.moving, scene.transmitter))
        beside, at_surface = [other for other in range(3) if other != axis], (normal, offset[:, None])
        nowhere = torch.zeros(3, 1, 1, dtype=torch.float64), torch.ones((), dtype=torch.float64)
        paths = [(fixed, moving, [at_surface], 1.0, nowhere)]
        for n, o, g in zip(*(x[0] for x in (planes.normal, planes.offset, planes.gain)), strict=True) if planes else ():
            at_plane = n[:, None, None], o
            pairs = [(mirror(fixed, *at_plane), moving), (fixed, mirror(moving, *at_plane))]
            first = [at_plane, at_surface]
            orders = [first, first[::-1]] if scene.end == "receiver" else [first[::-1], first]
            paths += [(*both, order, float(g), at_plane) for both, order in zip(pairs, orders, strict=True)]
        waves, cells = [], []
        for start, end, order, gain, plane in paths:
            source = transmitter
            for where in order:
                source = mirror(source, *where)
            near, far = start[axis] - offset[:, None], end[axis] - offset[:, None]
            hit = start + (near / (near + far)).nan_to_num(0.5, 0.5, 0.5) * (end - start)
            there = (near * far > 0) & ((hit * plane[0]).sum(0) < plane[1])
            wave = scene.waves(source.movedim(0, -1), self.measured.frequency)
            waves.append(self.factor * wave * (gain * there)[..., None, None])
            row, column = (
                ((hit[a] - self.low[a]) / self.cell_m[a]).long().clamp(0, MAX_CELLS).expand_as(there) for a in beside
            )
            cells.append(row * (MAX_CELLS + 1) + column)
        return torch.cat(waves, dim=1), torch.cat(cells, dim=1)

    def improvement(self, axis: int, offset: Tensor, planes: PlaneSet | None = None) -> tuple[Tensor, Tensor]:
        """Return what a surface of gains of either sign explains, and these gains.

        Args:
            axis: Axis of the normal.
            offset: Offsets (B,) [m].
            planes: Planes of the room, whose reflections of the surface count, too.

        Returns:
            Improvement at positions whose channels did not determine the gain, (2, B, n), as a fraction of their power, and
            the added waves by the gains from all positions, (2, B, n, F, K).
        """
        whole, number = self._waves(axis, offset, planes)
        n, count = len(self.known), number.shape[1] // len(self.known)
        known, residual = (x.repeat(count, 1, 1) for x in (self.known, self.measured.value - self.known))
        wave = whole - known * _factor(whole, known)
        match = (wave.conj() * residual).real.sum((2, 3))
        power = wave.abs().square().sum((2, 3))
        prior, size = power.mean(), (len(offset), (MAX_CELLS + 1) ** 2)

        def gains(rows: Tensor) -> Tensor:
            among = torch.zeros(size).scatter_add(1, number, match * rows).gather(1, number)
            total = torch.zeros(size).scatter_add(1, number, power * rows).gather(1, number)
            return (torch.stack([among, -among]) / (total + prior).clamp_min(1e-30)).clamp(0, 1)

        half = (torch.arange(n).repeat(count) % 2).float()
        gain = torch.where(half > 0, gains(1 - half), gains(half))
        improvement = 2 * gain * torch.stack([match, -match]) - gain.square() * power
        added = torch.tensor([1.0, -1.0])[:, None, None] * gains(torch.ones_like(half))
        total = (added[..., None, None] * whole).unflatten(2, (count, n)).sum(2)
        return improvement.unflatten(2, (count, n)).sum(2), total

    def maxima(self, axis: int, offset: Tensor) -> list[tuple[float, int, float]]:
        """Return improvement, axis and offset of local maxima over offsets [m], those nearest to the fixed end."""
        offset = offset[(offset - self.fixed[axis]).abs().argsort()[:MAX_OFFSETS].sort().values]
        value = torch.cat([self.improvement(axis, batch)[0].mean(-1).amax(0) for batch in offset.split(BATCH)])
        top = (value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:]) & (value[1:-1] > 0)
        rows = top.nonzero()[:, 0] + 1
        return [(v, axis, o) for v, o in zip(value[rows].tolist(), offset[rows].tolist(), strict=True)]

    def without(self, axis: int, offset: float, sign: int, planes: PlaneSet) -> _Residual:
        """Return the residual after a surface."""
        known = self.known + self.improvement(axis, torch.tensor([offset], dtype=torch.float64), planes)[1][sign, 0]
        return replace(self, known=_factor(self.measured.value, known) * known)


def _factor(value: Tensor, part: Tensor) -> Tensor:
    """Return the factor of a part that explains most of a value in each snapshot, (..., F, K) to (..., F, 1)."""
    match = (part.conj() * value).sum(-1, keepdim=True)
    return match / part.abs().square().sum(-1, keepdim=True).clamp_min(1e-30)
