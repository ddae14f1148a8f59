"""How much a scene needs: the search for the smallest number that does as well as any, on held-out spectra."""

from __future__ import annotations

import math
from collections.abc import Callable

GAIN = 0.004  # a share of the loss: 0.04 dB


def doubling_search(loss: Callable[[int], float], first: int, last: int, patience: int) -> int:
    """The smallest of first, 2 first, 4 first, ... whose loss is within 0.4 % of the lowest that was found.

    Doubles until that has lowered the loss by less `patience` times in a row, or up to `last`. What lies beyond is not
    tried, so the search costs about as much as its last members.

    Args:
        loss: of a fit of that size on spectra that it has not seen.
    """
    losses: dict[int, float] = {}
    size, lowest, in_vain = first, math.inf, 0
    while size <= last and in_vain < patience:
        losses[size] = loss(size)
        in_vain = 0 if losses[size] < (1 - GAIN) * lowest else in_vain + 1
        lowest = min(lowest, losses[size])
        size *= 2
    return next(size for size, found in losses.items() if found <= (1 + GAIN) * lowest)
