"""Positions, the frame they are normalised in, and the distances between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from swiftwrf.errors import InputError

MAX_COORDINATE = 1e15
MAX_NORMALISED = 1e6  # normalised: beyond, all is equally far, and float32 must not overflow
BISECTIONS = 20  # of the edge of cells, which find it to a millionth of the extent
MIN_TREE_POSITIONS = 2000  # known positions from which on a tree finds the nearest ones faster than all distances do


def check_positions(position: Any) -> Tensor:
    """Return positions (tensor, array or list) as float64 (n, 3) [m].

    Raises:
        InputError: Another shape, or not finite.

    Example:
        >>> check_positions([[0, 1, 2]])
        tensor([[0., 1., 2.]], dtype=torch.float64)
    """
    try:
        tensor = position if isinstance(position, Tensor) else torch.from_numpy(np.array(position))
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"positions must be numbers of shape (n, 3), got {type(position).__name__}") from None
    if tensor.dim() != 2 or tensor.shape[1] != 3:
        raise InputError(f"positions must have shape (n, 3), got {tuple(tensor.shape)}")
    if not tensor.isfinite().all():
        raise InputError("positions must be finite numbers [m]")
    return tensor.double()


def frame(position: Tensor) -> tuple[Tensor, Tensor]:
    """Return centre (3,) and half the longest side () of the box around positions (n, 3) [m], float64."""
    low, high = position.double().min(dim=0).values, position.double().max(dim=0).values
    half = (high - low).max() / 2
    return (low + high) / 2, half if half > 0 else torch.ones_like(half)


def normalise(position: Tensor, centre: Tensor, scale: Tensor | float) -> Tensor:
    """Return positions (n, 3) [m] in the frame of a centre [m] and a scale [m], float32."""
    return ((position.double() - centre) / scale).clamp(-MAX_NORMALISED, MAX_NORMALISED).float()


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the distances (n, m) between positions (n, 3) and (m, 3), in their unit, at most 1e15.

    They follow from differences. Products, which are faster, round the distances of close pairs away if the origin is far,
    as that of map coordinates. An infinite distance would give weights of inf / inf.

    Example:
        >>> distance(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]]))
        tensor([[5.]])
    """
    apart: Tensor
    if a.is_cuda:  # cdist would start a block of threads for each pair
        apart = torch.linalg.vector_norm(a.unsqueeze(1) - b, dim=-1)
    else:
        apart = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    return apart.clamp(max=MAX_COORDINATE)


def cells(position: Tensor, n: int) -> tuple[Tensor, float]:
    """Return the number of the cell of each position (m, 3), int64 (m,), with at most n cells, and the edge of the cells.

    Each distinct position is a cell, with edge 0, unless there are more than n. Then cells are the cubes of a grid.
    """
    spot = torch.unique(position, dim=0, return_inverse=True)[1]
    if int(spot.max()) < n:
        return spot, 0.0
    local = position - position.min(dim=0).values
    fine, coarse, found = 0.0, float(local.max()), torch.zeros(len(position), dtype=torch.int64)
    for _ in range(BISECTIONS):
        edge = (fine + coarse) / 2
        number = torch.unique((local / edge).floor().long(), dim=0, return_inverse=True)[1]
        if int(number.max()) < n:
            coarse, found = edge, number
        else:
            fine = edge
    return found, coarse


class Neighbours:
    """Search for the nearest of known positions.

    Among many positions a tree, built once, makes the time grow with the logarithm of their number (k-d tree: J. L. Bentley,
    Communications of the ACM 18, 1975).

    Args:
        known: Positions (m, 3).
    """

    def __init__(self, known: Tensor) -> None:
        self._known = known.detach().double().cpu()
        self._tree = cKDTree(self._known.numpy()) if len(known) > MIN_TREE_POSITIONS else None

    def __call__(self, position: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Return the distances from positions (n, 3) to the k nearest, ascending, float64, and their indices, (n, k)."""
        position = position.detach().double().cpu()
        if self._tree is not None:
            apart, number = self._tree.query(position.numpy(), k=range(1, k + 1))
            return torch.from_numpy(apart), torch.from_numpy(number).long()
        if k == 1:  # the first of several at one place
            return distance(position, self._known).min(dim=1, keepdim=True)
        return distance(position, self._known).topk(k, largest=False)


def nearest(position: Tensor, known: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return the distances (n, k) from positions (n, 3) to the k nearest known ones (m, 3), ascending, and their indices.

    Example:
        >>> nearest(torch.zeros(1, 3), torch.eye(3) * torch.tensor([1.0, 2.0, 3.0]), k=2)[1]
        tensor([[0, 1]])
    """
    return Neighbours(known)(position, k)
