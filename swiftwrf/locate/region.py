"""Candidate positions: the region where the moving end can be, cut into cells."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.positions import nearest

FLAT = 1e-3  # extent below which a dimension of the region counts as none, as a fraction of the largest extent
MARGIN = 0.03  # fraction of the extent by which the region exceeds the known positions on each side
NEIGHBOURS = 8  # the distance to this neighbour gives the scale on which positions fill a region
QUANTILE = 0.95  # of these distances
MAX_TRIES = 12


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


@dataclass(frozen=True, eq=False)
class Region:
    """Where the moving end can be: the neighbourhood of known positions within their box.

    A region follows a measured path and fills a measured room, because it reaches as far from the known positions as these
    lie from each other.

    Args:
        known: Known positions, float64 (n, 3) [m].
        margin_m: Distance [m] by which the region exceeds the known positions. Defaults to their spacing.

    Example:
        >>> region = Region(torch.rand(50, 3, dtype=torch.float64))
        >>> len(region.cells(1000).position) > 500
        True
    """

    known: Tensor
    margin_m: float | None = None

    def __post_init__(self) -> None:
        if self.known.dim() != 2 or self.known.shape[1] != 3 or len(self.known) < 2:
            raise InputError(f"a region needs at least 2 known positions (n, 3), got shape {tuple(self.known.shape)}")

    @property
    def scale(self) -> float:
        """Distance [m] from known positions that the region covers."""
        if self.margin_m is not None:
            return self.margin_m
        spots = self.known.unique(dim=0)
        apart, _ = nearest(spots, spots, min(NEIGHBOURS + 1, len(spots)))
        return float(apart[:, -1].quantile(QUANTILE))

    def contains(self, position: Tensor) -> Tensor:
        """Return True for each position (n, 3) [m] inside the region, (n,)."""
        _, centre, axes, half = self._frame()
        inside = (((position - centre) @ axes.T).abs() <= half + 1e-9).all(dim=1)
        inside[inside.clone()] = nearest(position[inside], self.known, 1)[0][:, 0] <= self.scale
        return inside

    def _frame(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return extents, centre, the axes along which positions extend, and half the box along each [m]."""
        middle = self.known.mean(dim=0)
        _, size, axes = torch.linalg.svd(self.known - middle, full_matrices=False)
        extended = size > FLAT * size[0].clamp_min(1e-12)
        # axes of the coordinates where they extend in all three: rooms are boxes
        axes = torch.eye(3, dtype=torch.float64) if bool(extended.all()) else axes[extended]
        along = (self.known - middle) @ axes.T
        low, high = along.amin(dim=0), along.amax(dim=0)
        margin = MARGIN * (high - low) if self.margin_m is None else torch.full_like(high, self.margin_m)
        return high - low, middle + (low + high) / 2 @ axes, axes, (high - low) / 2 + margin

    def cells(self, count: int) -> Cells:
        """Return about `count` cells of equal size that cover the region.

        Args:
            count: Number of cells, at least 1.
        """
        _, centre, axes, half = self._frame()
        spacing = float((2 * half).prod() / count) ** (1 / len(half)) if len(half) else 1.0
        for _ in range(MAX_TRIES):
            numbers = (2 * half / spacing).ceil().clamp_min(1)
            step = 2 * half / numbers
            lines = [
                -h + s * (torch.arange(int(n), dtype=torch.float64) + 0.5)
                for h, s, n in zip(half, step, numbers, strict=True)
            ]
            offset = torch.cartesian_prod(*lines).reshape(-1, len(half)) if lines else torch.zeros(1, 0, dtype=torch.float64)
            position = centre + offset @ axes
            position = position[self.contains(position)]
            if len(position) >= count / 2 or not len(half):
                break
            spacing *= (max(len(position), count / 1000) / count) ** (1 / len(half))
        if not len(position):  # known positions lie between the centres of cells
            position = self.known
        log_volume = torch.full((len(position),), -float(torch.tensor(len(position)).log()), dtype=torch.float64)
        return Cells(position, log_volume, step[:, None] * axes, torch.zeros_like(log_volume))
