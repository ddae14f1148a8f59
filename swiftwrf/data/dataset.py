"""The base class of spectra, array snapshots and RSSI: measurements at known positions of the moving end of a link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.labelled import Labelled, Variable, position_coordinates
from swiftwrf.data.splits import choose_split
from swiftwrf.errors import InputError

Numbers = Any  # a tensor, array, list or table of numbers
Data = TypeVar("Data", bound="PositionedData")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PositionedData(Labelled):
    """Measurements at n known positions; the base class of `Spectra`, `Snapshots` and `Rssi`.

    Attributes:
        name: Name of the data set.
        index: Number of each row in the data set that it comes from, counted from 0, int64 (n,).
        named_splits: Training and test rows of the splits that came with the data.
        source: sha256 of each file that was read, by file name.
        notes: What the reader found or did that a user should know, one sentence each.
    """

    name: str
    index: Tensor
    named_splits: dict[str, tuple[Tensor, Tensor]]
    source: dict[str, str]
    notes: tuple[str, ...]

    row_fields: ClassVar[tuple[str, ...]]
    """fields with one entry a measurement; the first holds the positions"""

    def __init__(
        self,
        name: str,
        index: Numbers | None = None,
        named_splits: Mapping[str, tuple[Tensor, Tensor]] | None = None,
        source: Mapping[str, str] | None = None,
        notes: tuple[str, ...] = (),
        **values: Any,
    ) -> None:
        """Set all fields of the frozen dataclass, once every row field has the length of the positions."""
        if unknown := [field for field in values if field not in self.__dataclass_fields__]:
            raise InputError(f"{type(self).__name__} has no {', '.join(unknown)}")
        n = len(values[self.row_fields[0]])
        values["index"] = torch.arange(n) if index is None else to_tensor("index", index, torch.int64, (n,))
        values |= {"name": name, "named_splits": dict(named_splits or {}), "source": dict(source or {}), "notes": notes}
        for field in self.row_fields:
            if values[field] is not None and len(values[field]) != n:
                raise InputError(
                    f"{name} has {n} positions, but {field} has {len(values[field])} rows; they must match"
                )
        for split, parts in values["named_splits"].items():
            if any(len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < n for rows in parts):
                raise InputError(f"split {split!r} of {name} has a row outside 0 to {n - 1}")
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def _position(self) -> Tensor:
        position: Tensor = getattr(self, self.row_fields[0])
        return position

    def __len__(self) -> int:
        return len(self._position)

    def subset(self: Data, rows: Tensor) -> Data:
        """Return the given rows in the given order, without the splits that are named for the whole set.

        Args:
            rows: Row numbers, int64, or a mask, bool (n,).
        """
        values = {field: getattr(self, field) for field in self.row_fields}
        kept: dict[str, Any] = {
            f: v[rows] if isinstance(v, Tensor) else v.subset(rows) for f, v in values.items() if v is not None
        }
        return replace(self, **kept, named_splits={})

    def split(self: Data, name: str = "random", seed: int = 0) -> tuple[Data, Data]:
        """Return the training and the test part.

        Args:
            name: A split that came with the data, or else "random" or "block".
            seed: Seed of the random and of the block split.

        Raises:
            InputError: An unknown name, or fewer than 10 training rows.
        """
        train, test = choose_split(name, seed, self._position, self.named_splits, self.name)
        return self.subset(train), self.subset(test)

    def to_frame(self) -> pd.DataFrame:
        """Return a table with one row a measurement: position [m] and what is measured there, by the row's number."""
        index = pd.Index(self.index.numpy(), name="index")
        return pd.DataFrame(self._position.numpy(), index, ["x_m", "y_m", "z_m"]).assign(**self._columns())

    def _columns(self) -> dict[str, Any]:
        """Return the columns of `to_frame` beside the position."""
        raise NotImplementedError

    def coordinates(self) -> dict[str, Variable]:
        """Return number and position of each row."""
        index = Variable(("position",), self.index.numpy())
        return {"index": index} | position_coordinates(self._position.numpy())

    def to_numpy(self) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """Return positions X (n, 3) [m] and measurements y, as scikit-learn takes them; no copies where possible."""
        return self._position.numpy(), self._measured().numpy()

    def _measured(self) -> Tensor:
        """Return what is measured at each position."""
        raise NotImplementedError

    def __repr__(self) -> str:
        position = self._position
        extent = (position.amax(dim=0) - position.amin(dim=0)).tolist() if len(self) else [0.0] * 3
        size = " x ".join(f"{side:.2f}" for side in extent)
        return f"<{type(self).__name__} {self.name!r}: {self._summary()}, positions over {size} m>"

    def _summary(self) -> str:
        """Return number and kind of the measurements."""
        raise NotImplementedError


def to_tensor(name: str, value: Numbers, dtype: torch.dtype, shape: tuple[int | None, ...]) -> Tensor:
    """Return finite numbers as a tensor on the CPU.

    Args:
        name: Name of the value, for the message.
        value: Tensor, array, list or table.
        dtype: Type of the tensor.
        shape: Expected shape. None stands for any size.

    Raises:
        InputError: No numbers, another shape, or a number that is not finite.

    Example:
        >>> to_tensor("position", [[0, 1, 2]], torch.float64, (None, 3))
        tensor([[0., 1., 2.]], dtype=torch.float64)
    """
    try:
        tensor = value.detach().cpu() if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name} must be numbers of equal rows, got {type(value).__name__}") from None
    if tensor.dim() != len(shape) or any(e not in (None, size) for e, size in zip(shape, tensor.shape, strict=True)):
        expected = ", ".join("n" if size is None else str(size) for size in shape)
        raise InputError(f"{name} must have shape ({expected}), got {tuple(tensor.shape)}")
    if not bool(tensor.isfinite().all()):
        raise InputError(f"{name} must be finite; row {int((~tensor.isfinite()).nonzero()[0, 0])} is not")
    return tensor.to(dtype)


def to_positions(name: str, value: Numbers) -> Tensor:
    """Return positions as float64 (n, 3) [m].

    Raises:
        InputError: As `to_tensor`.
    """
    return to_tensor(name, value, torch.float64, (None, 3))
