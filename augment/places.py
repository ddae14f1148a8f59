"""Where spectra are synthesized: places that one knows everything of but the spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from torch import Tensor

from swiftwrf import Spectra
from swiftwrf.positions import nearest

FURTHER = -1  # index of a place that is no place of the data set
FLAT = 1e-3  # extent below which a direction of the region counts as none, as a share of the largest
LEAST = 1e-3  # share of the hull that the region takes up at least
NEAR = 0.95  # quantile of the measured neighbours' distances within which a drawn place has a measured one


@dataclass(frozen=True, eq=False)
class Places:
    """What one knows of places without measuring there. It has no spectrum to leak.

    Args:
        position: of the moving end (n, 3) [m].
        label: direction of the transmitter (n, 2) [rad], from the positions of both ends.
        index: of each place in the data set, -1 for further places, (n,).
    """

    position: Tensor
    label: Tensor
    index: Tensor

    def __len__(self) -> int:
        return len(self.position)


def draw_places(measured: Spectra, n: int, seed: int) -> Places:
    """Places drawn evenly in the region of the measured positions, their directions from the known geometry.

    Args:
        measured: spectra whose positions say where the region is; the spectra themselves play no part.
        n: number of places.
        seed: of the draw.

    Raises:
        InputError: the fixed end or the array's orientation is unknown.
    """
    position = draw_positions(measured.position, n, seed)
    return Places(position, measured.direction_at(position), torch.full((n,), FURTHER))


def draw_positions(known: Tensor, n: int, seed: int) -> Tensor:
    """Positions (n, 3) drawn evenly in the region of known ones (m, 3) [m].

    The region is the positions' convex hull, in as many dimensions as they extend in, without what lies farther from all of
    them than they do from each other: a hull alone would fill the inside of a path round a room. Where spots were measured
    again and again, within a tracker's error, that would leave next to nothing; it reaches as far as `LEAST` asks for then.
    """
    generator = np.random.default_rng(seed)
    centre = known.mean(dim=0)
    _, extent, axes = torch.linalg.svd(known - centre, full_matrices=False)
    axes = axes[extent > FLAT * extent[0].clamp_min(1e-12)]  # the directions in which the positions extend
    flat = ((known - centre) @ axes.T).numpy()
    # eight nearest neighbours make the scale of a region; the nearest one alone would be the step along a path
    spots = known.unique(dim=0)
    apart, _ = nearest(spots, spots, min(9, len(spots)))  # each is its own nearest
    scale = float(apart[:, -1].quantile(NEAR))
    drawn, tried = torch.empty(0, 3, dtype=torch.float64), 0
    while len(drawn) < n:
        inside = torch.from_numpy(_in_hull(flat, 2 * n, generator)) @ axes + centre
        near = nearest(inside, known, 1)[0][:, 0] <= scale
        tried, drawn = tried + len(inside), torch.cat([drawn, inside[near]])
        if tried * LEAST >= 1 and len(drawn) < tried * LEAST:
            scale, tried, drawn = 2 * scale, 0, drawn[:0]
    return drawn[:n]


def _in_hull(corner: NDArray[np.float64], n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Points (n, d), evenly distributed in the convex hull of others (m, d); d may be 0 to 3."""
    dimensions = corner.shape[1]
    if dimensions < 2:
        low, high = corner.min(axis=0), corner.max(axis=0)
        line: NDArray[np.float64] = low + (high - low) * generator.random((n, dimensions))
        return line
    mesh = Delaunay(corner, qhull_options="QJ")  # joggled: positions on a lattice have no unique mesh
    simplex = corner[mesh.simplices]  # (s, d + 1, d)
    volume = np.abs(np.linalg.det(simplex[:, 1:] - simplex[:, :1]))
    chosen = generator.choice(len(simplex), n, p=volume / volume.sum())
    share = generator.dirichlet(np.ones(dimensions + 1), n)
    points: NDArray[np.float64] = np.einsum("nk,nkd->nd", share, simplex[chosen])
    return points
