"""Rows of RSSI that belong together: by device or channel, which differ by a constant offset, or by session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from swiftwrf.errors import listed

if TYPE_CHECKING:
    from swiftwrf.data.rssi import Rssi


def numbered(names: Tensor | Sequence[str | int]) -> Tensor:
    """Return the number of each name in the order of first occurrence, int64 (n,); numbers of a tensor stay.

    Example:
        >>> numbered(["out", "back", "out"])
        tensor([0, 1, 0])
    """
    if isinstance(names, Tensor):
        return names.long()
    return torch.from_numpy(pd.factorize(np.asarray(names, dtype=object))[0].astype(np.int64))


@dataclass(frozen=True, eq=False)
class Groups:
    """Groups of rows between which RSSI has constant offsets, e.g. devices or channels.

    Args:
        column: Name of the column with the groups' names.
        names: Names of the groups.
        code: Group of each row, int64 (n,).
    """

    column: str
    names: tuple[str, ...]
    code: Tensor

    @classmethod
    def of(cls, column: str, values: Sequence[str]) -> Groups:
        """Return the groups of n rows by their values in a column."""
        code, names = pd.factorize(np.asarray(values, dtype=object), sort=True)
        return cls(column, tuple(map(str, names)), torch.from_numpy(code.astype(np.int64)))

    def __len__(self) -> int:
        return len(self.code)

    def subset(self, rows: Tensor) -> Groups:
        """Return the groups of the given rows."""
        return replace(self, code=self.code[rows])

    def labels(self) -> list[str]:
        """Return the name of each row's group."""
        return [self.names[code] for code in self.code.tolist()]


@dataclass(frozen=True)
class Offsets:
    """Offsets of RSSI between groups of rows.

    Args:
        column: Name of the column with the groups' names.
        reference: Group whose offset is 0.
        offset_db: Offset of each group [dB].
        explained: Fraction of the variance about the field that the offsets explain.
    """

    column: str
    reference: str
    offset_db: Mapping[str, float]
    explained: float

    def of(self, data: Rssi) -> Tensor:
        """Return the offset of each row, float64 (n,) [dB]; 0 for a group without an estimate, or without groups."""
        labels = data.groups.labels() if data.groups else [self.reference] * len(data)
        return torch.tensor([self.offset_db.get(label, 0.0) for label in labels], dtype=torch.float64)

    def removed(self, data: Rssi) -> Rssi:
        """Return the data as the reference group would have measured them."""
        return data.derived(rssi_dbm=data.rssi_dbm - self.of(data)[:, None], offsets=self)

    def note(self) -> str:
        """Return a sentence with all offsets."""
        each = listed(f"{name} {db:+.1f} dB" for name, db in self.offset_db.items() if name != self.reference)
        return f"offsets of {self.column} relative to {self.reference}, which maps are of: {each}"
