"""What every fit and every model refuses, in one sentence each."""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.errors import InputError


def positions(position: Tensor) -> Tensor:
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


def training(train: Spectra) -> None:
    """Enough spectra to learn from, all finite.

    Raises:
        InputError: fewer than 10, or the first that is not finite.
    """
    if len(train) < MIN_TRAINING:
        raise InputError(f"a fit needs at least {MIN_TRAINING} spectra, got {len(train)}")
    for name, tensor in (("position", train.position), ("spectrum", train.spectrum)):
        bad = (~tensor.isfinite()).flatten(1).any(dim=1).nonzero()
        if len(bad):
            raise InputError(f"{name} of training spectrum {int(bad[0])} is not finite; mend or leave it out")
