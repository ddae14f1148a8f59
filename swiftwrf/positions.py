"""Numbers and positions that a user gives, the frame positions are normalised in, and the distances between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from torch import Tensor

from swiftwrf.errors import InputError

MAX_COORDINATE_M = 1e9  # of a position: beyond, float64 does not resolve a wavelength
MAX_COORDINATE = 1e15
MAX_NORMALISED = 1e6  # normalised: beyond, all is equally far, and float32 must not overflow
MIN_TREE_POSITIONS = 2000  # known positions from which on a tree finds the nearest ones faster than all distances do


def to_tensor(
    name: str, value: Any, dtype: torch.dtype, shape: tuple[int | None, ...], missing: bool = False
) -> Tensor:
    """Return numbers as a tensor on the CPU without gradient. Casts that lose more than digits are refused.

    Args:
        name: Name of the value, for the message.
        value: Tensor, array, list or table.
        dtype: Type of the tensor.
        shape: Expected shape. None stands for any size.
        missing: Whether nan is allowed, for a value that is unknown.

    Raises:
        InputError: No numbers, another shape, masked values, another kind of number, or a number that is not finite.

    Example:
        >>> to_tensor("position", [[0, 1, 2]], torch.float64, (None, 3))
        tensor([[0., 1., 2.]], dtype=torch.float64)
    """
    try:
        if isinstance(value, Tensor):
            tensor = value.detach().cpu().to_dense()
        else:
            array = np.asarray(value)
            # torch does not compute with these
            is_wide = (array.dtype.kind == "u" and array.itemsize > 1) or array.dtype == np.longdouble
            tensor = torch.from_numpy(array.astype(np.float64 if is_wide else array.dtype.newbyteorder("=")))
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name} must be numbers of equal rows, got {type(value).__name__}") from None
    if tensor.dim() != len(shape) or any(e not in (None, size) for e, size in zip(shape, tensor.shape, strict=True)):
        expected = ", ".join("n" if size is None else str(size) for size in shape)
        raise InputError(f"{name} must have shape ({expected}), got {tuple(tensor.shape)}")
    if np.ma.is_masked(value):
        raise InputError(f"{name} has masked values, which are no numbers; leave them out or fill them: filled()")
    if tensor.is_complex() and not dtype.is_complex:
        raise InputError(f"{name} must be real, got complex numbers; if they are amplitudes, give magnitudes: abs()")
    if (dtype.is_complex and not tensor.is_complex()) or (tensor.dtype == torch.bool != dtype):
        raise InputError(f"{name} must be {str(dtype).removeprefix('torch.')} numbers, got {tensor.dtype}")
    cast = tensor.to(dtype)
    if not (dtype.is_floating_point or dtype.is_complex) and bool((lost := cast != tensor).any()):
        expected = "True or False" if dtype == torch.bool else "whole numbers"
        raise InputError(f"{name} must be {expected}, got {tensor[lost][0].item()}")
    bad = ~cast.isfinite() & ~(cast.isnan() & missing)
    if bool(bad.any()):
        row = int(bad.nonzero()[0, 0]) if shape else 0
        also = ", or nan where it is unknown" if missing else ""
        raise InputError(f"{name} must be finite{also}; row {row}, counted from 0, is not")
    return cast


def check_positions(
    position: Any, name: str = "positions", shape: tuple[int | None, ...] = (None, 3), missing: bool = False
) -> Tensor:
    """Return positions (tensor, array or list) as float64 (n, 3) [m], on their device and with their gradient.

    Args:
        position: Positions, (n, 3) [m].
        name: Name of the positions, for the message.
        shape: Expected shape, e.g. (3,) for one position.
        missing: Whether a position may be unknown, all nan.

    Raises:
        InputError: Another shape, no real numbers, or a coordinate that is not finite or beyond 1e9 m.

    Example:
        >>> check_positions([[0, 1, 2]])
        tensor([[0., 1., 2.]], dtype=torch.float64)
    """
    checked = to_tensor(name, position, torch.float64, shape, missing)
    rows = checked.reshape(-1, checked.shape[-1])
    usable = (rows.abs() <= MAX_COORDINATE_M).all(dim=1) | rows.isnan().all(dim=1)
    if not bool(usable.all()):
        row = int((~usable).nonzero()[0])
        unknown = ", or all nan where it is unknown" if missing else ""
        raise InputError(
            f"{name} must be finite numbers [m], at most {MAX_COORDINATE_M:g}{unknown}; row {row}, counted from 0, is "
            f"{rows[row].tolist()}"
        )
    return position.to_dense().double() if isinstance(position, Tensor) else checked


def check_near(
    name: str, position: Tensor, known: Tensor, min_far_m: float = 100.0, max_diagonals: float = 10.0
) -> None:
    """Refuse positions (n, 3) [m] so far away from known ones (m, 3) [m] that they are in another unit or frame.

    Raises:
        InputError: A position more than 100 m and 10 diagonals away from the box around the known ones (not studied).
    """
    low, high = known.amin(dim=0), known.amax(dim=0)
    away, extent = (position - position.clamp(low, high)).norm(dim=1), float((high - low).norm())
    if bool((away > max(min_far_m, max_diagonals * extent)).any()):
        raise InputError(
            f"{name} has a position {float(away.max()):.3g} m away from those that the model was fitted to, which extend "
            f"over {extent:.3g} m; give positions in the unit and frame of these"
        )


def centre_and_half_side(position: Tensor) -> tuple[Tensor, Tensor]:
    """Return centre (3,) and half the longest side () of the box around positions (n, 3) [m], float64."""
    low, high = position.double().min(dim=0).values, position.double().max(dim=0).values
    half = (high - low).max() / 2
    return (low + high) / 2, half if half > 0 else torch.ones_like(half)


def normalise(position: Tensor, centre: Tensor, scale: Tensor | float) -> Tensor:
    """Return positions (n, 3) [m] in the frame of a centre [m] and a scale [m], float32."""
    return ((position.double() - centre) / scale).clamp(-MAX_NORMALISED, MAX_NORMALISED).float()


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the distances (..., n, m) between positions (..., n, 3) and (..., m, 3), in their unit, at most 1e15.

    They follow from differences. Products, which are faster, round the distances of close pairs away if the origin is far,
    as that of map coordinates. An infinite distance would give weights of inf / inf.

    Example:
        >>> distance(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]]))
        tensor([[5.]])
    """
    apart: Tensor
    if a.is_cuda:  # cdist would start a block of threads for each pair
        apart = torch.linalg.vector_norm(a.unsqueeze(-2) - b.unsqueeze(-3), dim=-1)
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
    fine, coarse, cell = 0.0, float(local.max()), torch.zeros(len(position), dtype=torch.int64)
    for _ in range(20):  # to a millionth of the extent
        edge = (fine + coarse) / 2
        number = torch.unique((local / edge).floor().long(), dim=0, return_inverse=True)[1]
        if int(number.max()) < n:
            coarse, cell = edge, number
        else:
            fine = edge
    return cell, coarse


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


def inside(position: ArrayLike, known: ArrayLike, reach: float = 1.5) -> NDArray[np.bool_]:
    """Return whether positions (..., 2 or 3) [m] lie inside the convex hull of known ones (n, 2 or 3), in plan.

    Known positions on a line have no hull. There a position is inside if it lies within `reach` times the largest distance
    between neighbours of one of them (not studied).

    Example:
        >>> inside([[0.5, 0.2], [2.0, 0.2]], [[0, 0], [1, 0], [0, 1], [1, 1]]).tolist()
        [True, False]
    """
    at, points = np.asarray(position, dtype=float)[..., :2], np.asarray(known, dtype=float)[:, :2]
    try:
        corners = points[ConvexHull(points).vertices]
        return np.asarray(Delaunay(corners).find_simplex(at) >= 0)
    except (QhullError, ValueError):
        places = np.unique(points, axis=0)
        tree = cKDTree(places)
        apart = tree.query(places, min(2, len(places)))[0].reshape(len(places), -1)[:, -1]
        return np.asarray(tree.query(at)[0] <= reach * max(float(apart.max()), 1e-6))
