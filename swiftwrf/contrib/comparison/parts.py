"""Parts of RSSI that predictors are fitted to: the pool of all receivers, fewer rows, and all rows outside of a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.rssi import PLACE
from swiftwrf.data.splits import FOLDS, MIN_TRAINING, slabs


def fewer_rows(train: Rssi, fractions: Sequence[float], seed: int) -> list[Tensor]:
    """Return numbers of random rows, ascending, for each fraction that leaves 10 values or more of every receiver.

    Example:
        >>> import swiftwrf
        >>> [len(rows) for rows in fewer_rows(swiftwrf.rssi_room(n=60), (0.1, 0.5), 0)]
        [30]
    """
    order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))
    parts = [order[: round(fraction * len(train))].sort().values for fraction in fractions]
    return [rows for rows in parts if int(train.detected[rows].sum(dim=0).min()) >= MIN_TRAINING]


def region_of(train: Rssi, seed: int) -> tuple[Tensor, Tensor] | None:
    """Return the numbers of the rows in one of five slabs of the area, and of all others.

    None if the others have fewer than 10 values of a receiver, or if the receiver moves, too.

    Example:
        >>> import swiftwrf
        >>> out, others = region_of(swiftwrf.rssi_room(n=100), seed=0)
        >>> len(out), len(others)
        (20, 80)
    """
    if train.receiver_moves:
        return None
    inside = slabs(train.transmitter_position, FOLDS) == seed % FOLDS
    enough = bool(train.detected[inside].any()) and int(train.detected[~inside].sum(dim=0).min()) >= MIN_TRAINING
    return (inside.nonzero()[:, 0], (~inside).nonzero()[:, 0]) if enough else None


def pool_of(whole: Rssi, train: Rssi, test: Rssi, split: str, seed: int) -> Rssi:
    """Return the training rows at every receiver, without those that a split by place holds out.

    `train` and `test` are the parts of the split at the compared receivers.
    """
    if split != PLACE or PLACE in whole.named_splits:
        return whole.split(split, seed)[0]
    is_held_out = test.detected.any(dim=0)
    held_out = {name for name, out in zip(test.receiver_names, is_held_out.tolist(), strict=True) if out}
    kept = torch.tensor([name not in held_out for name in whole.receiver_names])
    rows = torch.isin(whole.index, train.index)
    return replace(whole, rssi_dbm=whole.rssi_dbm.where(kept, torch.nan)).subset(rows)
