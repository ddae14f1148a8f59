"""Candidate positions: the region where the moving end can be, cut into cells, and the search for the best cells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor

from swiftwrf.data.coordinates import Floors
from swiftwrf.data.splits import centres, places
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions, nearest

FLOOR_DISTANCE_M = 1e5  # of two floors, in the search for known positions near a cell
MAX_CELLS = 200_000  # among which those near known positions are found
Evaluate = Callable[[Tensor], Tensor]  # candidates (n, m, 3) to log-likelihoods (k, n, m)


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of candidate positions: boxes of equal shape, in as many dimensions as the region has.

    Args:
        position: Centres, float64 (..., 3) [m].
        log_volume: Logarithm of each cell's prior mass, (...).
        edge: Edge vectors of a cell of level 0, float64 (d, 3) [m], d = 0 to 3.
        level: How often a cell's edges are halved, (...).
    """

    position: Tensor
    log_volume: Tensor
    edge: Tensor
    level: Tensor

    @property
    def edge_m(self) -> float:
        """Length of the longest edge of a cell of level 0 [m]."""
        return float(self.edge.norm(dim=1).max()) if len(self.edge) else 0.0

    def centres(self, parts: int) -> Tensor:
        """Return the centres of the parts of a cell of level 0 if each edge is cut, from its centre, (parts^d, 3) [m]."""
        line = (torch.arange(parts, dtype=torch.float64) + 0.5) / parts - 0.5
        along = torch.tensor(list(itertools.product(line.tolist(), repeat=len(self.edge))), dtype=torch.float64)
        return along.reshape(-1, len(self.edge)) @ self.edge

    def cut(self, parts: int) -> Cells:
        """Return cells (m,) of level 0 with each edge cut in equal parts, those of one cell after the other."""
        away = self.centres(parts)
        volume = (self.log_volume - math.log(len(away))).repeat_interleave(len(away))
        position = (self.position[:, None] + away).flatten(0, 1)
        return Cells(position, volume, self.edge / parts, torch.zeros_like(volume))


@dataclass(frozen=True, eq=False)
class Region:
    """Prior over positions: a box around known positions, with most of the prior mass in their neighbourhood.

    The radius of the neighbourhood is the spacing of the known positions. So it follows a measured path and
    fills a measured room. In a building with floors, the box is a plane of cells on each floor.

    Args:
        known: Known positions, (n, 3) [m], kept as float64.
        margin: Fraction of the extent by which the box exceeds the known positions on each side.
        outside: Prior mass spread over the whole box.
        floors: Floors of the building. Defaults to none.

    Raises:
        InputError: Fewer than 2 known positions, one that is not finite, a negative margin, or a mass outside (0, 1].

    Example:
        >>> region = Region(torch.rand(50, 3))
        >>> cells = region.cells(1000)
        >>> round(float(cells.log_volume.exp().sum()), 6)
        1.0
    """

    known: Annotated[Tensor, "float64 n 3"]
    margin: float = 0.03
    outside: float = 0.05
    floors: Floors | None = None

    def __post_init__(self) -> None:
        vars(self)["known"] = check_positions(self.known, "known positions of a region")
        if len(self.known) < 2:
            raise InputError(f"a region needs at least 2 known positions, got {len(self.known)}")
        if not self.margin >= 0 or not 0 < self.outside <= 1:
            raise InputError(f"a margin is at least 0 and a mass above 0, got {self.margin} and {self.outside}")

    @cached_property
    def scale_m(self) -> float:
        """Distance [m] from the known positions that their neighbourhood covers."""
        spots = self._apart(centres(self.known, places(self.known)))
        apart, _ = nearest(spots, spots, min(9, len(spots)))  # the nearest one is the position itself
        return float(apart[:, -1].quantile(0.95))

    def _apart(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] with floors so far apart that the neighbourhood of a position is on its floor."""
        if self.floors is None:
            return position
        number = self.floors.number(position).double()[:, None]
        return torch.cat([position[:, :2], FLOOR_DISTANCE_M * number], dim=1)

    @cached_property
    def _box(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centre (3,), axes (d, 3) along which the positions extend, and half the extent along each (d,) [m]."""
        away = self.known - self.known[0]  # exactly 0 if all positions are one
        if self.floors is not None:
            away = away * away.new_tensor([1.0, 1.0, 0.0])
        middle = self.known[0] + away.mean(dim=0)
        _, size, axes = torch.linalg.svd(away - away.mean(dim=0), full_matrices=False)
        extended = size > 1e-3 * size[0].clamp_min(1e-12)
        # a region in all three dimensions is a box along the coordinates, as rooms are
        axes = torch.eye(3, dtype=torch.float64) if bool(extended.sum() == 3) else axes[extended]
        if self.floors is not None and len(axes) == 2:
            axes = torch.eye(3, dtype=torch.float64)[:2]
        along = (self.known - middle) @ axes.T
        low, high = along.amin(dim=0), along.amax(dim=0)
        return middle + (low + high) / 2 @ axes, axes, (high - low) * (0.5 + self.margin)

    @property
    def extent(self) -> Tensor:
        """Lengths of the box, (d,) [m]."""
        return 2 * self._box[2]

    def is_near(self, position: Tensor) -> Tensor:
        """Return True for each position (n, 3) [m] in the neighbourhood of the known positions, (n,)."""
        return nearest(self._apart(position), self._apart(self.known), 1)[0][:, 0] <= self.scale_m

    def cells(self, count: int) -> Cells:
        """Return about `count` cells of equal size that cover the box; `log_volume` is their prior mass.

        On floors, they are the cells near known positions, and a sample of a tenth as many others.
        """
        if self.floors is None:
            return self._covering(count)
        near_fraction = float(self.is_near(self._covering(count).position).double().mean())
        cells = self._covering(min(round(count / max(near_fraction, 0.01)), MAX_CELLS))
        near = self.is_near(cells.position)
        others = (~near).nonzero()[:, 0]
        others = others[:: max(1, 10 * len(others) // count)]
        kept = torch.cat([near.nonzero()[:, 0], others]).sort().values
        return Cells(cells.position[kept], self.log_mass(cells.position[kept]), cells.edge, cells.level[kept])

    def _covering(self, count: int) -> Cells:
        """Return about `count` cells of equal size that cover the box."""
        centre, axes, half = self._box
        heights = [float(centre[2])] if self.floors is None else self.floors.height_m
        if not len(half):
            step, offset = torch.empty(0, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
        else:
            spacing = float((2 * half).prod() * len(heights) / count) ** (1 / len(half))
            numbers = (2 * half / spacing).round().clamp_min(1)
            step = 2 * half / numbers
            lines = [
                -h + s * (torch.arange(int(n), dtype=torch.float64) + 0.5)
                for h, s, n in zip(half, step, numbers, strict=True)
            ]
            offset = torch.cartesian_prod(*lines).reshape(-1, len(half))
        position = centre + offset @ axes
        if self.floors is not None:
            position = position.repeat(len(heights), 1)
            position[:, 2] = torch.tensor(heights, dtype=torch.float64).repeat_interleave(len(offset))
        log_mass = self.log_mass(position)
        return Cells(position, log_mass, step[:, None] * axes, torch.zeros_like(log_mass))

    def log_mass(self, position: Tensor) -> Tensor:
        """Return the logarithm of the prior mass of cells of equal size with centres (m, 3) [m], (m,)."""
        near = self.is_near(position)
        mass = torch.full((len(position),), self.outside / len(position), dtype=torch.float64)
        mass[near] += (1 - self.outside) / max(int(near.sum()), 1)
        return (mass / mass.sum()).log()


def outside_mass(held_out: Iterable[tuple[Region, Tensor]]) -> float:
    """Return the prior mass outside the neighbourhood of known positions.

    It follows from the region of the other folds' positions and the held-out positions (n, 3) [m] of each fold.
    """
    near = torch.cat([region.is_near(at) for region, at in held_out])
    return (int((~near).sum()) + 1) / (len(near) + 2)


def best_cells(cells: Cells, misfit: Tensor, most: int, others: int, generator: torch.Generator) -> Cells:
    """Return, for each observation, the cells of smallest misfit and a sample that represents all others.

    The misfit (n, m) is any decreasing function of the likelihood. The `others` random cells stand for all cells that are
    left out. Each carries an equal part of their prior mass.
    """
    n, m = misfit.shape
    most = min(most, m)
    best = misfit.topk(most, dim=1, largest=False).indices
    position, volume, level = cells.position[best], cells.log_volume[best], cells.level[best]
    left = m - most
    if left <= 0 or others <= 0:
        return Cells(position, volume, cells.edge, level)
    drawn = torch.randint(m, (n, others), generator=generator)
    # a cell that is among the best already stands for nothing else
    is_best = torch.zeros(n, m, dtype=torch.bool).scatter_(1, best, True).gather(1, drawn)
    kept = (~is_best).sum(dim=1, keepdim=True).clamp_min(1)
    factor = math.log(left) - kept.double().log()
    extra = (cells.log_volume[drawn] + factor).masked_fill(is_best, -torch.inf)
    return Cells(
        torch.cat([position, cells.position[drawn]], dim=1),
        torch.cat([volume, extra], dim=1),
        cells.edge,
        torch.cat([level, cells.level[drawn]], dim=1),
    )


def refined(cells: Cells, log_mass: Tensor, values: Tensor, evaluate: Evaluate, split: int) -> tuple[Cells, Tensor]:
    """Split the cells of largest mass along every edge and evaluate their parts.

    Args:
        cells: Cells (n, m) of each observation.
        log_mass: Logarithms of their masses under the present posterior, (n, m).
        values: Log-likelihoods (k, n, m) of k models.
        evaluate: Function from positions (n, s, 3) to values (k, n, s).
        split: Number of cells of each observation that are split.

    Returns:
        As many cells, of which parts replace the split ones and the lightest, and their values.
    """
    n, m = log_mass.shape
    split = min(split, m)
    chosen = log_mass.topk(split, dim=1).indices
    away = cells.centres(2)
    parent = cells.position.gather(1, chosen[..., None].expand(-1, -1, 3))
    level = cells.level.gather(1, chosen)
    part = (parent[:, :, None] + 2.0 ** -level[..., None, None] * away).reshape(n, -1, 3)

    def repeated(value: Tensor) -> Tensor:
        return value[..., None].expand(-1, -1, len(away)).reshape(n, -1)

    part_volume = repeated(cells.log_volume.gather(1, chosen) - math.log(len(away)))
    part_values = evaluate(part)
    rest = log_mass.scatter(1, chosen, -torch.inf).argsort(dim=1, descending=True)[:, : m - split]
    position = torch.cat([part, cells.position.gather(1, rest[..., None].expand(-1, -1, 3))], dim=1)
    volume = torch.cat([part_volume, cells.log_volume.gather(1, rest)], dim=1)
    levels = torch.cat([repeated(level + 1), cells.level.gather(1, rest)], dim=1)
    kept = values.gather(2, rest.expand(len(values), -1, -1))
    return Cells(position, volume, cells.edge, levels), torch.cat([part_values, kept], dim=2)
