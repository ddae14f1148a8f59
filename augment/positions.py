"""Positions at which spectra are synthesized: position and direction are known, the spectrum is not measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from torch import Tensor

from swiftwrf import InputError, Spectra
from swiftwrf.data.splits import centres, places
from swiftwrf.positions import nearest
from swiftwrf.runtime.validation import checked

NO_INDEX = -1  # index of a position that is not in the data set
MIN_RELATIVE_EXTENT = (
    1e-3  # extent of the region along an axis, relative to the largest, below which the axis is dropped
)
Count = Annotated[int, Ge(0), Le(10**6)]  # of positions, whose spectra are in memory
MIN_HULL_FRACTION = 1e-3  # smallest fraction of the convex hull that the region covers


@dataclass(frozen=True, eq=False)
class SyntheticPositions:
    """Positions with their directions, without spectra.

    Args:
        position: Positions of the moving end, (n, 3) [m].
        label: Direction of the transmitter from the positions of both ends, (n, 2) [rad].
        index: Number of each position in the data set, (n,). -1 for positions outside of it.

    Example:
        >>> import swiftwrf
        >>> positions = synthetic_positions(swiftwrf.simulated_room(n=20), 5, seed=0)
        >>> len(positions), positions.index.tolist()
        (5, [-1, -1, -1, -1, -1])
    """

    position: Tensor
    label: Tensor
    index: Tensor

    def __len__(self) -> int:
        return len(self.position)


@checked
def synthetic_positions(measured: Spectra, n: Count, seed: int) -> SyntheticPositions:
    """Return random positions in the region of the measured ones, with directions from the known geometry.

    Args:
        measured: Measured spectra. Only their positions are used.
        n: Number of positions.
        seed: Seed of the positions.

    Raises:
        InputError: The fixed end or the orientation of the array is unknown, or more than a million positions.

    Example:
        >>> import swiftwrf
        >>> synthetic_positions(swiftwrf.simulated_room(n=20), 5, seed=0).label.shape
        torch.Size([5, 2])
    """
    position = sample_positions(measured.position, n, seed)
    return SyntheticPositions(position, measured.direction_at(position), torch.full((n,), NO_INDEX))


def sample_positions(known: Tensor, n: int, seed: int) -> Tensor:
    """Sample positions uniformly in the region of known positions.

    The region is the part of the convex hull within the typical spacing of a known position, so that the inside of a loop
    stays empty. The hull has as many dimensions as the positions extend in. Where repeated measurements at few places make
    the spacing tiny, it is doubled until the region covers the fraction `MIN_HULL_FRACTION` of the hull.

    Args:
        known: Known positions (m, 3) [m].
        n: Number of samples.
        seed: Seed of the samples.

    Returns:
        Positions (n, 3) [m].

    Example:
        >>> corners = torch.tensor([[0.0, 0, 1], [4, 0, 1], [0, 3, 1], [4, 3, 1]], dtype=torch.float64)
        >>> sample_positions(corners, 100, seed=0)[:, 2].unique()
        tensor([1.], dtype=torch.float64)
    """
    if not len(known):
        raise InputError("synthetic positions need the region of known ones, and there is none")
    generator = np.random.default_rng(seed)
    centre = known.mean(dim=0)
    _, extent, axes = torch.linalg.svd(known - centre, full_matrices=False)
    axes = axes[extent > MIN_RELATIVE_EXTENT * extent[0].clamp_min(1e-12)]
    projected = ((known - centre) @ axes.T).numpy()
    spots = centres(known, places(known))
    # each is its own nearest, and the next may be the step along a path
    distance, _ = nearest(spots, spots, min(9, len(spots)))
    spacing = float(distance[:, -1].quantile(0.95))
    samples, tried = torch.empty(0, 3, dtype=torch.float64), 0
    while len(samples) < n:
        inside = torch.from_numpy(_sample_hull(projected, 2 * n, generator)) @ axes + centre
        accepted = nearest(inside, known, 1)[0][:, 0] <= spacing
        tried, samples = tried + len(inside), torch.cat([samples, inside[accepted]])
        if tried * MIN_HULL_FRACTION >= 1 and len(samples) < tried * MIN_HULL_FRACTION:
            spacing, tried, samples = 2 * spacing, 0, samples[:0]
    return samples[:n]


def _sample_hull(corner: NDArray[np.float64], n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Sample points (n, d) uniformly in the convex hull of points (m, d), d from 0 to 3."""
    dimensions = corner.shape[1]
    if dimensions < 2:
        low, high = corner.min(axis=0), corner.max(axis=0)
        line: NDArray[np.float64] = low + (high - low) * generator.random((n, dimensions))
        return line
    mesh = Delaunay(corner, qhull_options="QJ")  # joggled: positions on a lattice have no unique mesh
    simplex = corner[mesh.simplices]  # (s, d + 1, d)
    volume = np.abs(np.linalg.det(simplex[:, 1:] - simplex[:, :1]))
    chosen = generator.choice(len(simplex), n, p=volume / volume.sum())
    weight = generator.dirichlet(np.ones(dimensions + 1), n)
    points: NDArray[np.float64] = np.einsum("nk,nkd->nd", weight, simplex[chosen])
    return points
