"""Arrays with names, dimensions and units, and the tables and files that are made of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import replacing

if TYPE_CHECKING:
    import xarray

AXES = ("x", "y", "z")


class Variable(NamedTuple):
    """An array with named dimensions.

    Args:
        dimensions: Name of each dimension.
        values: The array.
        units: Unit of the values. Empty if they have none.
    """

    dimensions: tuple[str, ...]
    values: NDArray[Any]
    units: str = ""


class Labelled(ABC):
    """Base class of measurements and predictions that become tables (pandas), data sets (xarray) and files."""

    @abstractmethod
    def to_frame(self) -> pd.DataFrame:
        """Return a table."""

    @abstractmethod
    def coordinates(self) -> dict[str, Variable]:
        """Return where the values are: positions, directions, names of receivers."""

    @abstractmethod
    def variables(self) -> dict[str, Variable]:
        """Return the values by name."""

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray data set whose coordinates and variables have the attribute `units`.

        Raises:
            InputError: xarray is not installed.
        """
        try:
            import xarray
        except ModuleNotFoundError:
            raise InputError("to_xarray needs xarray; install it with pip install 'swiftwrf-tasks[xarray]'") from None

        def arrays(some: Mapping[str, Variable]) -> dict[str, Any]:
            return {name: (v.dimensions, v.values, {"units": v.units} if v.units else {}) for name, v in some.items()}

        return xarray.Dataset(arrays(self.variables()), arrays(self.coordinates()))


def position_coordinates(position: NDArray[np.float64], origin: GeodeticOrigin | None = None) -> dict[str, Variable]:
    """Return the coordinates x, y and z of positions (n, 3) [m], and latitude and longitude [deg] with an origin.

    Example:
        >>> list(position_coordinates(np.zeros((2, 3)), GeodeticOrigin(48.0, 11.0)))
        ['x', 'y', 'z', 'latitude', 'longitude']
    """
    found = {name: Variable(("position",), values, "m") for name, values in zip(AXES, position.T, strict=True)}
    degrees = degree_columns(origin, position).items()
    return found | {
        name.removesuffix("_deg"): Variable(("position",), values, f"degrees_{'north' if 'lat' in name else 'east'}")
        for name, values in degrees
    }


def receiver_coordinates(names: Sequence[str]) -> dict[str, Variable]:
    """Return the names of receivers as a coordinate.

    Example:
        >>> receiver_coordinates(["hall", "office"])["receiver"].values.tolist()
        ['hall', 'office']
    """
    return {"receiver": Variable(("receiver",), np.array(names, dtype=np.str_))}


def write_mat(data: Labelled, file: Path) -> None:
    """Write coordinates and variables as a MATLAB file of version 5: arrays of one dimension as (n, 1), names as cells.

    Raises:
        OSError: The file cannot be written.
    """
    from scipy.io import savemat

    arrays = {name: _as_cells(variable.values) for name, variable in (data.coordinates() | data.variables()).items()}
    with replacing(file) as temporary, temporary.open("wb") as stream:
        savemat(stream, arrays, do_compression=True, oned_as="column")


def _as_cells(values: NDArray[Any]) -> NDArray[Any]:
    """Return texts as objects, which become a cell array."""
    return values.astype(object) if values.dtype.kind == "U" else values
