"""Floors of a building: a dimension of positions of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float64]
STOREY_M = 4.0  # height of a floor where heights are missing or count from the floor
MIN_STOREY_M = 1.5  # difference of the heights of two floors


@dataclass(frozen=True)
class Floors:
    """Floors, ascending.

    Args:
        names: Names in the table.
        height_m: Median height z of the measurements on each floor [m].

    Example:
        >>> Floors(("ground", "first"), (1.2, 4.5)).number(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 5.0]]))
        tensor([0, 1])
    """

    names: tuple[str, ...]
    height_m: tuple[float, ...]

    def number(self, position: Tensor) -> Tensor:
        """Return the number of the floor whose height is nearest to each position (n, 3), int64 (n,)."""
        height = torch.tensor(self.height_m, dtype=torch.float64)
        return (position[:, 2:].double() - height).abs().argmin(dim=1)


def floors_of(floor: list[str], z: Floats) -> Floors | None:
    """Return the floors by the name of each row's floor and its height z (n,) [m]; None if there is one only.

    Names of one height, e.g. in two buildings, are one floor.

    Example:
        >>> floors_of(["1", "0", "1"], np.array([5.0, 1.0, 5.2]))
        Floors(names=('0', '1'), height_m=(1.0, 5.1))
    """
    label = np.array(floor, dtype=object)
    height = {name: float(np.median(z[label == name])) for name in set(floor) - {""}}
    levels: list[list[str]] = []
    for name in sorted(height, key=lambda name: (height[name], name)):
        if levels and height[name] - height[levels[-1][0]] < MIN_STOREY_M:
            levels[-1].append(name)
        else:
            levels.append([name])
    heights = (float(np.mean([height[name] for name in level])) for level in levels)
    return Floors(tuple(", ".join(level) for level in levels), tuple(heights)) if len(levels) > 1 else None


def height_of_floors(z: Floats, floor: Floats) -> Floats:
    """Return heights in the building (n,) [m] of heights that may count from the floor, by the floor's number (n,).

    Example:
        >>> height_of_floors(np.array([1.0, 1.2]), np.array([0.0, 1.0]))
        array([1. , 5.2])
    """
    known = ~(np.isnan(floor) | np.isnan(z))
    numbers = np.unique(floor[known])
    heights = np.array([np.median(z[known & (floor == number)]) for number in numbers])
    return z + STOREY_M * floor if len(numbers) > 1 and np.diff(heights).max() < MIN_STOREY_M else z
