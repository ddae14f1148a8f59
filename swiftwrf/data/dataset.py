"""The base class of spectra, array snapshots and RSSI: measurements at known positions of the moving end of a link."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from swiftwrf.data.splits import MIN_TRAINING, block_split, random_split
from swiftwrf.errors import CONTENT_ERRORS, InputError, optional_module
from swiftwrf.plotting import Displayed, extent
from swiftwrf.positions import check_positions, to_tensor
from swiftwrf.runtime.validation import NonNegativeInt, checked

if TYPE_CHECKING:
    import xarray

Numbers = Any  # a tensor, array, list or table of numbers
Rows = Any  # numbers of rows (tensor, array or list), a mask, or a slice
Data = TypeVar("Data", bound="PositionedData")
Arrays = dict[str, Any]  # in the form of xarray: dimensions, values, and a dictionary of units if there are any
DEGREE_UNITS = {"latitude": "degrees_north", "longitude": "degrees_east"}


class Labelled(ABC):
    """Base class of measurements and predictions that become tables (pandas), data sets (xarray) and files."""

    @abstractmethod
    def to_frame(self) -> pd.DataFrame:
        """Return a table."""

    @abstractmethod
    def coordinates(self) -> Arrays:
        """Return where the values are: positions, directions, names of receivers."""

    @abstractmethod
    def variables(self) -> Arrays:
        """Return the values by name."""

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray data set whose coordinates and variables have the attribute `units`.

        Raises:
            InputError: xarray is not installed.
        """
        dataset: xarray.Dataset = optional_module("xarray", "to_xarray needs xarray", "xarray").Dataset(
            self.variables(), self.coordinates()
        )
        return dataset


def position_coordinates(position: NDArray[np.float64], origin: GeodeticOrigin | None = None) -> Arrays:
    """Return the coordinates x, y and z of positions (n, 3) [m], and latitude and longitude [deg] with an origin.

    Example:
        >>> list(position_coordinates(np.zeros((2, 3)), GeodeticOrigin(48.0, 11.0)))
        ['x', 'y', 'z', 'latitude', 'longitude']
    """
    coordinates: Arrays = {
        axis: (("position",), values, {"units": "m"}) for axis, values in zip("xyz", position.T, strict=True)
    }
    for (name, units), values in zip(DEGREE_UNITS.items(), degree_columns(origin, position).values(), strict=False):
        coordinates[name] = (("position",), values, {"units": units})
    return coordinates


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PositionedData(Labelled, Displayed):
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

    @checked
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

    def subset(self: Data, rows: Rows) -> Data:
        """Return the given rows in the given order, without the splits that are named for the whole set.

        `data[rows]` is the same.

        Args:
            rows: Row numbers (tensor, array or list), a mask, bool (n,), or a slice. -1 is the last row.

        Raises:
            InputError: A row that does not exist, or a mask of another length.

        Example:
            >>> import swiftwrf
            >>> data = swiftwrf.rssi_room(n=30)
            >>> len(data[:10]), data.subset([4, -1]).index.tolist()
            (10, [4, 29])
        """
        try:
            chosen = np.arange(len(self))[rows.cpu().numpy() if isinstance(rows, Tensor) else rows]
        except CONTENT_ERRORS:
            chosen = None
        if chosen is None or chosen.ndim != 1:
            raise InputError(
                f"rows of {self.name} must be a list of numbers below {len(self)}, a mask of that length or a slice, "
                f"got {rows!r}"
            )
        number = torch.from_numpy(chosen.copy())
        values = {field: getattr(self, field) for field in self.row_fields}
        kept: dict[str, Any] = {
            f: v[number] if isinstance(v, Tensor) else v.iloc[chosen] if isinstance(v, pd.Series) else v.subset(number)
            for f, v in values.items()
            if v is not None
        }
        return self.derived(**kept, named_splits={})

    __getitem__ = subset

    def row_digests(self, max_values: int = 64) -> Tensor:
        """Return a digest of each row by its number, its time, its position and some of its values, int64 (n,).

        About `max_values` equally spaced values count: more take time and distinguish no more rows.
        """
        values, time = getattr(self, self.row_fields[1]), getattr(self, "time", None)
        number = torch.stack([self.index.double(), torch.zeros(len(self)).double() if time is None else time], dim=1)
        digests = [b""]
        for rows in [slice(None)] if isinstance(values, Tensor) else values.parts():
            part = values[rows].flatten(1)
            sample = part[:, :: max(1, part.shape[1] // max_values)].double()
            known = torch.cat([number[rows], self._position[rows], sample], dim=1)
            rounded = (1000 * known).round().nan_to_num(-1.0).long().numpy()  # to a millisecond and a millimetre
            digests += [hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rounded]
        return torch.from_numpy(np.frombuffer(b"".join(digests), np.int64).copy())

    def derived(self: Data, **fields: Any) -> Data:
        """Return a copy with other values of some fields, which follow from checked ones and are not checked again."""
        copy: Data = object.__new__(type(self))
        for field, value in (vars(self) | fields).items():
            object.__setattr__(copy, field, value)
        return copy

    @checked
    def split(self: Data, name: str = "random", seed: NonNegativeInt = 0) -> tuple[Data, Data]:
        """Return the training and the test part.

        Args:
            name: A split that came with the data, or else "random" or "block".
            seed: Seed of the random and of the block split.

        Raises:
            InputError: An unknown name, another seed than a whole number, or fewer than 10 training rows.
        """
        made = {"random": random_split, "block": block_split}
        if name in self.named_splits:
            train, test = self.named_splits[name]
        elif name in made:
            train, test = made[name](self._position, seed)
        else:
            known = ", ".join(sorted({*self.named_splits, *made}))
            raise InputError(f"{self.name} has no split {name!r}; choose one of {known}")
        if len(train) < MIN_TRAINING:
            raise InputError(
                f"split {name!r} of {self.name} has {len(train)} training measurements, too few to fit anything; at least "
                f"{MIN_TRAINING} are needed"
            )
        return self.subset(train), self.subset(test)

    def to_frame(self) -> pd.DataFrame:
        """Return a table with one row a measurement: position [m] and what is measured there, by the row's number."""
        index = pd.Index(self.index.numpy(), name="index")
        return pd.DataFrame(self._position.numpy(), index, ["x_m", "y_m", "z_m"]).assign(**self._columns())

    def _columns(self) -> dict[str, Any]:
        """Return the columns of `to_frame` beside the position."""
        raise NotImplementedError

    def coordinates(self) -> Arrays:
        """Return number and position of each row."""
        return {"index": (("position",), self.index.numpy())} | position_coordinates(self._position.numpy())

    def to_numpy(self) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """Return positions X (n, 3) [m] and measurements y, as scikit-learn takes them; no copies where possible."""
        measured: NDArray[Any] = next(iter(self.variables().values()))[1]
        return self._position.numpy(), measured

    def __repr__(self) -> str:
        head = f"<{type(self).__name__} {self.name!r}: {self._summary()},"
        return f"{head}\n positions over {extent(self._position)}>"

    def _facts(self) -> dict[str, str]:
        facts = {"name": self.name, "measurements": self._summary(), "positions over": extent(self._position)}
        return facts | {f"note {number}": note for number, note in enumerate(self.notes, start=1)}

    def _summary(self) -> str:
        """Return number and kind of the measurements."""
        raise NotImplementedError


def to_positions(name: str, value: Numbers, shape: tuple[int | None, ...] = (None, 3), missing: bool = False) -> Tensor:
    """Return positions as `check_positions`, on the CPU and without gradient."""
    return check_positions(value, name, shape, missing).detach().cpu()


def to_rotation(value: Numbers, tolerance: float = 1e-3) -> Tensor:
    """Return a matrix that rotates array into world coordinates as float64 (3, 3).

    Products of its columns are those of unit vectors to the tolerance, because of rounding.

    Raises:
        InputError: As `to_tensor`, or columns that are no right-handed set of unit vectors at right angles.
    """
    rotation = to_tensor("rotation", value, torch.float64, (3, 3))
    error = float((rotation.T @ rotation - torch.eye(3)).abs().max())
    if error > tolerance or float(rotation.det()) < 0:
        raise InputError(
            "rotation must be a rotation matrix (orthonormal, determinant 1), got "
            f"{rotation.tolist()}; a pose=ArrayPose(position, quaternion) gives one"
        )
    return rotation
