"""Furniture of a room: absorption in voxels and reflectivity in cells on each plane, estimated from channels.

Surfaces of limited extent, such as table tops, are planes that reflect in some cells only.
The path of an image reflects at planes w in cells c and crosses voxels v along lengths l_v. Its gain

    a = exp(-sum_v absorption_v l_v) prod_w sign_w reflectivity_wc f_w

depends on the position, because furniture hides paths from parts of a room. The factor f_w depends on the angle of incidence
if the plane is a dielectric. Otherwise it is 1. Measured channels x and the field h of the gains determine absorption and
reflectivity: the mean of 1 - coherence(x, h) and a penalty are minimised. The penalty contains the total variation
(L. I. Rudin, S. Osher and E. Fatemi, Physica D 60, 1992). Held-out positions choose its weight and the size of the voxels,
and decide whether furniture explains the channels better than planes alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import softplus

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import InputError
from swiftwrf.models.geometry.channels import Channels, coherence, superposed, waves
from swiftwrf.models.geometry.images import MAX_COSINE, LinkAt, PlaneSet, Sequence, mirror
from swiftwrf.models.geometry.planes import Plane, log_advantage, log_explained, plane_set, robust_advantage
from swiftwrf.models.geometry.surfaces import find_surfaces
from swiftwrf.plotting import Axes, corners_of, hatch, plan_map
from swiftwrf.runtime.threads import parallel_map, single_thread

Floats = NDArray[np.float64]
MAX_VOXELS = 50_000
MIN_SHOWN_DB = 1.0  # absorption [dB/m] of a voxel in JSON: less differs little from empty space
N_STEPS = 150  # of Adam
# edge of a voxel [wavelengths] and weight of the penalty, of which held-out channels choose
SETTINGS = ((2.0, 1e-3), (1.0, 1e-3), (2.0, 3e-3), (2.0, 3e-4))
MAX_CHOICE = 200  # positions that choose the settings
MIN_HELD_OUT = 60  # positions in the folds that are held out to choose, if there are as many; all folds decide


@dataclass(frozen=True, eq=False)
class Furniture:
    """Absorption in voxels and reflectivity in cells on the planes of a room.

    Args:
        low: Corner of the first voxel, float64 (3,) [m].
        voxel_m: Edge of the voxels [m].
        absorption: Absorption of the amplitude, float32 (X, Y, Z) [1 / m].
        reflectivity: Modulus of the reflection gain of each plane by cells, float32 (P, cells), at normal incidence. Cells
            are voxels projected along the axis that is closest to the normal.
        crossed_m: Length of the measured paths in each voxel, float32 (X, Y, Z) [m]. Where it is 0, absorption is unknown.
        penalty: Weight of the penalty that held-out positions chose.
        surfaces: Reflecting surfaces besides the planes of the room, after which their rows of `reflectivity` come.
    """

    low: Annotated[Tensor, "float64 3"]
    voxel_m: Annotated[float, Gt(0), Lt(math.inf)]
    absorption: Annotated[Tensor, "float32 x y z", Ge(0)]
    reflectivity: Annotated[Tensor, "float32 s c"]
    crossed_m: Annotated[Tensor, "float32 x y z"]
    penalty: float
    surfaces: tuple[Plane, ...] = ()

    def joined(self, planes: PlaneSet) -> PlaneSet:
        """Return the planes of one room and the surfaces; these reflect at most twice, and no path meets two of them."""
        if not self.surfaces:
            return planes
        n, both = planes.gain.shape[1], planes.joined(plane_set([*self.surfaces], planes.order))
        kept = [s for s in both.sequence if max(s) < n or (len(s) <= 2 and min(s) < n) or len(s) == 1]
        return replace(both, only=tuple(kept))

    def with_surfaces(self, surfaces: list[Plane]) -> Furniture:
        """Return the voxels with further surfaces, to fit."""
        cells = torch.ones(len(surfaces), self.reflectivity.shape[1])
        return replace(self, surfaces=tuple(surfaces), reflectivity=torch.cat([self.reflectivity, cells]))

    def with_reflectivity(self, plane: int, value: float) -> Furniture:
        """Return the furniture with one reflectivity of a whole plane or surface."""
        reflectivity = self.reflectivity.clone()
        reflectivity[plane] = value
        return replace(self, reflectivity=reflectivity)

    def check(self, n_planes: int) -> None:
        """Refuse other cells than those of the voxels on the planes of a room and on the surfaces.

        Raises:
            InputError: The reflectivity has another shape.
        """
        voxels = self.absorption.shape
        shape = n_planes + len(self.surfaces), math.prod(voxels) // max(1, min(voxels))
        if self.reflectivity.shape != shape:
            raise InputError(
                f"reflectivity has shape {tuple(self.reflectivity.shape)}, but planes and voxels need {shape}"
            )

    def to_json(self) -> dict[str, Any]:
        """Return what stands in the room as plain values.

        Returns:
            Corner, edge and numbers of the voxels, the absorption [dB/m] of those that measured paths cross and that absorb
            more than 1 dB/m, by their indices, and normal, offset [m] and mean reflectivity of each surface.
        """
        decibel = 20 / math.log(10) * self.absorption
        rows = ((self.crossed_m > 0) & (decibel > MIN_SHOWN_DB)).nonzero()
        mean = self.reflectivity[len(self.reflectivity) - len(self.surfaces) :].mean(dim=1).tolist()
        return {
            "low_m": self.low.tolist(),
            "voxel_m": self.voxel_m,
            "shape": [*self.absorption.shape],
            "voxels": [[*row, round(float(decibel[tuple(row)]), 2)] for row in rows.tolist()],
            "surfaces": [
                {"normal": [*surface.normal], "offset_m": surface.offset_m, "reflectivity": value}
                for surface, value in zip(self.surfaces, mean, strict=True)
            ],
        }

    def gains(self, planes: PlaneSet, scene: LinkAt) -> Tensor:
        """Return the gains of the direct path and of each image at the positions of a scene, float32 (n, 1 + S).

        Args:
            planes: Planes of the room and surfaces, as `joined`.
            scene: Positions.
        """
        padded = _padded(self.absorption)

        def transmission(group: _Crossings) -> Tensor:
            absorption = padded.index_select(0, group.voxel.flatten()).view(group.voxel.shape)
            return (-absorption.sum(-1) * group.step_m).exp()

        return _gains(self._crossings(planes, scene), _factor(planes, scene), transmission, self.reflectivity)

    def in_plan(self, low_m: float = -math.inf, high_m: float = math.inf) -> tuple[Floats, Floats, Floats]:
        """Return what stands between two heights, seen from above.

        Args:
            low_m: Lower height [m].
            high_m: Upper height [m].

        Returns:
            Centres of the columns (X,) and of the rows (Y,) [m], and the largest absorption (Y, X) [dB / m], nan where no
            measured path crosses a voxel.
        """
        x, y, z = (
            (start + self.voxel_m * (torch.arange(size) + 0.5)).numpy()
            for start, size in zip(self.low, self.absorption.shape, strict=True)
        )
        layer = torch.from_numpy((z > low_m) & (z < high_m))
        decibel = torch.where(self.crossed_m > 0, 20 / math.log(10) * self.absorption, -1.0)[:, :, layer]
        values = decibel.amax(dim=2).T if bool(layer.any()) else -torch.ones(len(y), len(x))
        return x, y, torch.where(values < 0, torch.nan, values).double().numpy()

    def plot(self, low_m: float = -math.inf, high_m: float = math.inf, ax: Axes | None = None) -> Axes:
        """Draw what stands between two heights, seen from above, hatched where it is unknown.

        Args:
            low_m: Lower height [m].
            high_m: Upper height [m].
            ax: Axes to draw into. Defaults to those of a new figure.

        Example:
            >>> low, empty = torch.zeros(3, dtype=torch.float64), torch.zeros(4, 3, 2)
            >>> Furniture(low, 0.25, empty, torch.ones(6, 12), torch.ones(4, 3, 2), 1e-3).plot(0.0, 0.25).get_ylabel()
            'y [m]'
        """
        x, y, values = self.in_plan(low_m, high_m)
        ax = plan_map(corners_of(x, y), values, "absorption [dB/m]", ax)
        hatch(ax, x, y, np.isnan(values))
        return ax

    def _crossings(self, planes: PlaneSet, scene: LinkAt) -> list[_Crossings]:
        sequence: list[Sequence] = [(), *planes.sequence]
        groups: dict[int, list[int]] = {}
        for row, s in enumerate(sequence):
            groups.setdefault(len(s), []).append(row)
        return [self._crossed(planes, scene, [sequence[row] for row in rows], rows) for rows in groups.values()]

    def _crossed(self, planes: PlaneSet, scene: LinkAt, sequence: list[Sequence], rows_of: list[int]) -> _Crossings:
        """Follow the paths of images with equally many reflections from the moving end to the fixed end.

        A path is straight towards its image. Samples of it beyond a reflection are mirrored back into the room.
        """
        order = orders(tuple(sequence), tuple(map(tuple, planes.normal[0].tolist())))  # (S, Q, D)
        if scene.end == "transmitter":
            order = order.flip(-1)
        # coordinates come first, in voxels from the corner of the layer of empty ones around the grid
        normal, away = planes.normal[0].T, (planes.offset[0] - planes.normal[0] @ self.low) / self.voxel_m
        away = away + planes.normal[0].sum(dim=1)
        source = [((scene.fixed - self.low) / self.voxel_m + 1)[:, None, None].expand(-1, *order.shape[:2])]
        for plane in order.unbind(-1):
            source.append(mirror(source[-1], normal[:, plane], away[plane]))
        normal, away = normal.float(), away.float()
        start = ((scene.moving - self.low) / self.voxel_m + 1).float().T[:, :, None, None]
        point, along = start, torch.zeros(len(scene), *order.shape[:2])
        exists = torch.ones_like(along, dtype=torch.bool)
        hits = []  # points, fractions of the path and planes, from the moving end on
        for depth in range(order.shape[2], 0, -1):
            plane = order[..., depth - 1]
            n, ray = normal[:, None, plane], source[depth].float()[:, None] - point
            fraction = (away[plane] - (point * n).sum(0)) / (ray * n).sum(0)
            exists = exists & (fraction > 0) & (fraction < 1)
            point, along = point + fraction * ray, along + fraction * (1 - along)
            hits.append((point, along, plane))
        best = exists.byte().argmax(-1, keepdim=True)  # (n, S, 1): of the orders of one image at most one exists

        def of_best(values: Tensor) -> Tensor:
            whole = values.expand(*values.shape[:-3], *exists.shape)
            return whole.gather(-1, best.expand(*whole.shape[:-1], 1))[..., 0]

        ray = source[-1][:, None, :, 0].float() - start[..., 0]
        length = self.voxel_m * ray.square().sum(0).sqrt()
        samples = self._samples(source[-1][..., 0])
        at = (torch.arange(samples) + 0.5) / samples
        x = torch.addcmul(start, at, ray.nan_to_num(0, 0, 0)[..., None])  # paths that do not exist have any points
        cell = torch.zeros(*length.shape, len(hits), dtype=torch.int64)
        for number, (point, along, plane) in enumerate(hits):
            hit, begin, plane = of_best(point), of_best(along).nan_to_num(0, 0, 0), of_best(plane[None])
            n = normal[:, plane]
            turn = -2 * (ray * n).sum(0) * n
            ray = ray + turn
            x.addcmul_((at - begin[..., None]).clamp_min_(0), turn.nan_to_num(0, 0, 0)[..., None])
            cell[..., number] = self._cell(plane, planes.normal[0], hit)
        largest = torch.tensor(self.absorption.shape)[:, None, None, None] + 1
        i, j, k = x.floor_().clamp_(torch.zeros(()), largest)
        voxel = i.mul_(largest[1] + 1).add_(j).mul_(largest[2] + 1).add_(k).int()  # exact in float32 below 2^24
        return _Crossings(torch.tensor(rows_of), voxel, length / samples, cell, of_best(exists))

    def _samples(self, image: Tensor) -> int:
        """Return the number of samples of paths to images (3, S) [voxels], one a voxel of the longest from inside the grid.

        It must not depend on the paths that are followed together, which would change each other.
        """
        size = torch.tensor(self.absorption.shape, dtype=torch.float64) + 2
        corner = torch.cartesian_prod(*(torch.tensor([0.0, edge], dtype=torch.float64) for edge in size.tolist()))
        return max(2, math.ceil(float(torch.cdist(corner, image.T.double()).max())))

    def _cell(self, plane: Tensor, normal: Tensor, hit: Tensor) -> Tensor:
        """Return the number of the cell, counted over all planes, of points (3, n, S) [voxels] on planes (n, S)."""
        shape = torch.tensor(self.absorption.shape)
        index = (hit.nan_to_num(0, 0, 0).floor() - 1).clamp(torch.zeros(()), shape[:, None, None] - 1).long()
        beside = torch.tensor([[1, 2], [0, 2], [0, 1]])[normal.abs().argmax(-1)].T[:, plane]
        number = index.gather(0, beside)
        return plane * self.reflectivity.shape[1] + number[0] * shape[beside[1]] + number[1]


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Voxels and cells of the paths of S images with D reflections to n positions.

    Args:
        image: Numbers of the images, the direct path is 0, (S,).
        voxel: Number of the voxel at samples along each path, in the grid with a layer of empty voxels around it, int32
            (n, S, M).
        step_m: Distance of the samples (n, S) [m].
        cell: Numbers of the cells (n, S, D).
        exists: Whether there is such a path, (n, S).
    """

    image: Tensor
    voxel: Tensor
    step_m: Tensor
    cell: Tensor
    exists: Tensor

    def lengths(self, n_voxels: int) -> csr_array:
        """Return the length of each path in each voxel [m], (n S, voxels)."""
        rows = np.arange(self.voxel.shape[0] * self.voxel.shape[1]).repeat(self.voxel.shape[2])
        values = (self.step_m * self.exists)[..., None].expand_as(self.voxel).flatten().numpy()
        entries = values, (rows, self.voxel.flatten().numpy())
        return csr_array(entries, shape=(self.step_m.numel(), n_voxels), dtype=np.float32)


def _padded(absorption: Tensor) -> Tensor:
    """Return the absorption with a layer of empty voxels around it, flat."""
    return torch.nn.functional.pad(absorption, (1,) * 6).flatten()


def _gains(
    crossings: list[_Crossings], factor: Tensor, transmission: Callable[[_Crossings], Tensor], reflectivity: Tensor
) -> Tensor:
    """Return the gains (n, 1 + S) of all paths; `transmission` gives those of a group without its reflections, (n, S)."""
    gain = [transmission(group) * reflectivity.flatten()[group.cell].prod(-1) * group.exists for group in crossings]
    order = torch.cat([group.image for group in crossings]).argsort()
    return torch.cat(gain, dim=1)[:, order] * factor


def _factor(planes: PlaneSet, scene: LinkAt) -> Tensor:
    """Return the gains of all paths of reflectivity 1 without absorption, (n or 1, 1 + S)."""
    if not planes.sequence:
        return torch.ones(1, 1)
    sign = replace(planes, gain=planes.gain.sign()).image_gain[0]
    return torch.nn.functional.pad(planes.angular_factor(scene)[0].T * sign, (1, 0), value=1.0)


class _Depth(torch.autograd.Function):
    """Product of a sparse matrix of SciPy with a vector: several times as fast as gathering and its gradient."""

    @staticmethod
    def forward(context: Any, values: Tensor, lengths: csr_array, transposed: csr_array) -> Tensor:
        context.transposed = transposed
        return torch.from_numpy(lengths @ values.detach().numpy())

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return torch.from_numpy(context.transposed @ gradient.numpy()), None, None


@lru_cache(maxsize=64)
def orders(sequence: tuple[Sequence, ...], normal: tuple[tuple[float, ...], ...]) -> Tensor:
    """Return all orders of reflection with the image of each sequence, (S, Q, D), filled up with the first order.

    Perpendicular planes one after the other may change places; which order exists depends on the position.
    """
    n = torch.tensor(normal, dtype=torch.float64).reshape(-1, 3)
    cosine = (n @ n.T).abs()
    rows = []
    for first in sequence:
        orders, new = {first}, [first]
        while new:
            s = new.pop()
            swapped = [
                (*s[:i], s[i + 1], s[i], *s[i + 2 :]) for i in range(len(s) - 1) if cosine[s[i], s[i + 1]] < MAX_COSINE
            ]
            new += [other for other in swapped if other not in orders]
            orders |= {*swapped}
        rows.append([first, *sorted(orders - {first})])
    most = max(map(len, rows))
    return torch.tensor([orders + orders[:1] * (most - len(orders)) for orders in rows], dtype=torch.int64)


def fit_furniture(planes: PlaneSet, measured: Channels, start: Furniture) -> Furniture:
    """Fit absorption and reflectivity to measured channels, with voxels, penalty and surfaces of `start`."""
    scene, observed = measured.scene, measured.value
    wave, factor = waves(planes, scene, measured.frequency), _factor(planes, scene)
    crossings = start._crossings(planes, scene)
    shape = [size + 2 for size in start.absorption.shape]
    parts = [group.lengths(math.prod(shape)) for group in crossings]
    sparse = {id(group): (part, part.T.tocsr()) for group, part in zip(crossings, parts, strict=True)}
    raw = torch.full(start.absorption.shape, -3.0, requires_grad=True)
    level = torch.special.logit(planes.gain[0].abs().clamp(0.05, 0.98))[:, None].requires_grad_()  # of each plane
    change = torch.zeros_like(start.reflectivity, requires_grad=True)
    optimiser = torch.optim.Adam([{"params": [raw], "lr": 0.1}, {"params": [level, change], "lr": 0.05}])
    area, normal, n_planes = start.voxel_m**2, planes.normal[0], len(start.reflectivity) - len(start.surfaces)
    # a surface beyond all positions, on a side without a plane, is a wall that the search for the room has missed
    side, ends = planes.side[0].tolist(), torch.cat([scene.transmitter, scene.receiver])
    beyond = ((ends @ normal.T).amax(0) < planes.offset[0]).tolist()
    is_wall = [row < n_planes or (beyond[row] and side[row] not in side[:n_planes]) for row in range(len(side))]
    for _ in range(N_STEPS):
        absorption, reflectivity, usual = softplus(raw), (level + change).sigmoid(), level.sigmoid()
        values = _padded(absorption)

        def transmission(group: _Crossings, values: Tensor = values) -> Tensor:
            depth: Tensor = _Depth.apply(values, *sparse[id(group)])
            return (-depth).exp().view_as(group.step_m)

        gain = _gains(crossings, factor, transmission, reflectivity)
        penalty = 10 * start.voxel_m**3 * absorption.sum() + area * _variation(absorption)
        for number, (axis, values) in enumerate(zip(normal.abs().argmax(-1).tolist(), reflectivity, strict=True)):
            sides = [size for other, size in enumerate(absorption.shape) if other != axis]
            cells = values[: math.prod(sides)].reshape(sides)
            penalty = penalty + start.voxel_m * _variation(cells)
            # a wall reflects alike everywhere unless channels need another gain, another surface nowhere
            penalty = penalty + area * ((cells - usual[number]).abs() if is_wall[number] else cells).sum()
        loss = 1 - coherence(observed, superposed(gain, wave)).mean() + start.penalty * penalty
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    crossed = torch.from_numpy(np.sum([part.sum(axis=0) for part in parts], axis=0))
    return replace(
        start,
        absorption=softplus(raw).detach(),
        reflectivity=(level + change).sigmoid().detach(),
        crossed_m=crossed.reshape(shape)[1:-1, 1:-1, 1:-1],
    )


@single_thread()
def find_furniture(
    planes: PlaneSet, free: Tensor, measured: Channels, corners: Tensor, fold: Tensor, *, significance: float = 2.5
) -> Furniture | None:
    """Estimate what stands in a room; None if it does not explain held-out channels better than planes alone.

    Args:
        planes: Planes of one room.
        free: Gains of the paths without furniture, (n, 1 + S).
        measured: Measured channels.
        corners: Points (m, 3) [m] that the voxels surround, besides the measured positions.
        fold: Fold of each position.
        significance: Standard errors by which furniture must explain held-out channels better than planes alone, and each
            surface better than the room without it. As `GeometryConfig.significance`, not studied apart.
    """
    low, high, empty = _empty(planes, measured, corners)
    rows = measured.scene.few_rows(MAX_CHOICE)
    held_out = _HeldOut(planes, measured.subset(rows), [(kept, out) for out, kept in each_fold(fold[rows])])
    few = max(2, math.ceil(MIN_HELD_OUT * len(held_out.splits) / len(rows)))
    fits = [held_out.fits(start, slice(few)) for start in empty]
    best = max(range(len(empty)), key=lambda row: float(log_explained(held_out.coherence(fits[row])).mean()))
    with_furniture = held_out.coherence(fits[best] + held_out.fits(empty[best], slice(few, None)))
    out = torch.cat([out for _, out in held_out.splits])
    alone = held_out.measured.subset(out).coherence(planes, free[rows][out])
    is_furnished = robust_advantage(with_furniture, alone) > significance
    # without furniture a strong penalty is best, but leaves too much in the residual to find walls that are hidden at times
    start = empty[best if is_furnished else 0]
    furniture = fit_furniture(planes, measured, start)
    surfaces = find_surfaces(planes, furniture.gains(planes, measured.scene), measured, low, high)
    if surfaces:
        wider, n = start.with_surfaces(surfaces), planes.gain.shape[1]
        fitted = held_out.fits(wider)
        every = held_out.coherence(fitted)
        without = [
            held_out.coherence([fit.with_reflectivity(n + row, 0.0) for fit in fitted]) for row in range(len(surfaces))
        ]
        kept = [s for s, other in zip(surfaces, without, strict=True) if log_advantage(every, other) > significance]
        if kept and min(log_advantage(every, other) for other in (with_furniture, alone)) > significance:
            wider = start.with_surfaces(kept)
            return fit_furniture(wider.joined(planes), measured, wider)
    return furniture if is_furnished else None


def _empty(planes: PlaneSet, measured: Channels, corners: Tensor) -> tuple[Tensor, Tensor, list[Furniture]]:
    """Return two opposite corners (3,) [m] of the region of the voxels, and the empty voxels of each of `SETTINGS`."""
    wavelength = math.tau / measured.scene.wavenumber
    region = torch.cat([corners, measured.scene.moving, measured.scene.fixed[None]])
    low, high = region.amin(0) - wavelength, region.amax(0) + wavelength
    smallest = float((high - low).prod() / MAX_VOXELS) ** (1 / 3)
    empty = []
    for wavelengths, penalty in SETTINGS:
        voxel = max(wavelengths * wavelength, smallest)
        shape = ((high - low) / voxel).ceil().int().tolist()
        cells = torch.ones(planes.gain.shape[1], math.prod(shape) // min(shape))
        empty.append(Furniture(low, voxel, torch.zeros(shape), cells, torch.zeros(shape), penalty))
    return low, high, empty


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """Fits of furniture without each fold of measured channels, and their coherence with these.

    Args:
        planes: Planes of one room.
        measured: Measured channels.
        splits: Rows that are kept and held out, for each fold.
    """

    planes: PlaneSet
    measured: Channels
    splits: list[tuple[Tensor, Tensor]]

    def fits(self, start: Furniture, number: slice = slice(None)) -> list[Furniture]:
        """Return furniture with the voxels, penalty and surfaces of `start`, fitted without each of some folds."""
        joined = start.joined(self.planes)

        def fitted(split: tuple[Tensor, Tensor]) -> Furniture:
            return fit_furniture(joined, self.measured.subset(split[0]), start)

        return parallel_map(fitted, self.splits[number])

    def coherence(self, fits: list[Furniture]) -> Tensor:
        """Return the coherence at the positions of the first folds, given the fits without each of these."""
        parts = []
        for fit, (_, out) in zip(fits, self.splits, strict=False):
            test, joined = self.measured.subset(out), fit.joined(self.planes)
            parts.append(test.coherence(joined, fit.gains(joined, test.scene)))
        return torch.cat(parts)


def _variation(values: Tensor) -> Tensor:
    """Return the sum of the moduli of the differences of neighbours, smoothed at 0."""
    return torch.stack([(values.diff(dim=axis).square() + 1e-6).sqrt().sum() for axis in range(values.dim())]).sum()
