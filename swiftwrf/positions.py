"""Positions and the distances between them."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.errors import InputError

FARTHEST = 1e15


def check_positions(position: Tensor) -> Tensor:
    """Positions [m] as float64 (n, 3).

    Raises:
        InputError: another shape, or not finite.
    """
    position = torch.as_tensor(position, dtype=torch.float64)
    if position.dim() != 2 or position.shape[1] != 3:
        raise InputError(f"positions must have shape (n, 3), got {tuple(position.shape)}")
    if not position.isfinite().all():
        raise InputError("positions must be finite numbers [m]")
    return position


def check_batch(batch: int) -> None:
    """Refuses a number of positions at a time that would leave some out.

    Raises:
        InputError: below 1.
    """
    if batch < 1:
        raise InputError(f"batch must be at least 1 position at a time, got {batch}")


def check_drawn(spectrum: Tensor) -> Tensor:
    """The spectra, none of which may hold something that is not finite.

    Raises:
        InputError: parameters so large that sums of them overflow.
    """
    if not bool(spectrum.isfinite().all()):
        raise InputError("the model draws values that are not finite; its parameters overflow, so fit it anew")
    return spectrum


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Distances between positions (n, 3) and (m, 3), (n, m), in their unit.

    From differences, never from products: torch's fast way loses close pairs to rounding, all the more the farther the
    origin is (map coordinates lie thousands of kilometres from it). Farther than 1e15 counts as that: an infinite distance
    would give weights of inf / inf.
    """
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").clamp(max=FARTHEST)
