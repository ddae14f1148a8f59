"""Rooms: polygons in plan, each on one floor, and files of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.data.cells import Floats, text_of
from swiftwrf.data.columns import column_of
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame
from swiftwrf.data.files import digests, read_table, read_text
from swiftwrf.data.receivers import positions_of
from swiftwrf.errors import InputError, listed
from swiftwrf.runtime.checkpoint import refusing

FILES = ("rooms.csv", "rooms.geojson", "rooms.json")  # names beside measurements
OUTSIDE = "outside"  # name of no room
NAMES, FLOOR_NAMES = ("room", "name", "id"), ("floor", "level")  # columns, or properties in GeoJSON


@dataclass(frozen=True, eq=False)
class Rooms:
    """Rooms by name.

    Args:
        names: Name of each room, unique.
        rings: Corners (n, 2) [m] of the closed lines around each room: its outline, and those of holes and further parts.
        floors: Floors of the building. None if there is one only.
        floor: Number of the floor of each room. Defaults to 0.
        source: sha256 of the file by its name.

    Raises:
        InputError: No room, a name twice, or a ring of fewer than three corners.

    Example:
        >>> rooms = Rooms(("hall",), ((np.array([[0.0, 0], [4, 0], [4, 3], [0, 3]]),),))
        >>> rooms.named(torch.tensor([[1.0, 1.0, 0.0], [5.0, 1.0, 0.0]]))
        ['hall', 'outside']
    """

    names: tuple[str, ...]
    rings: tuple[tuple[Floats, ...], ...]
    floors: Floors | None = None
    floor: tuple[int, ...] = ()
    source: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) < len(self.names) or OUTSIDE in self.names:
            raise InputError(
                f"rooms need names, each once and none of them {OUTSIDE!r}, got {listed(self.names) or 'none'}"
            )
        for name, rings in zip(self.names, self.rings, strict=True):
            if any(len(np.unique(ring, axis=0)) < 3 for ring in rings):
                raise InputError(f"room {name!r} has fewer than three corners; give each room its outline")

    def contain(self, position: Tensor) -> NDArray[np.bool_]:
        """Return whether each room contains positions (n, 3) [m], (n, rooms)."""
        from matplotlib.path import Path as Outline  # takes a moment, and most data have no rooms

        at = position[:, :2].double().numpy()
        within = [np.logical_xor.reduce([Outline(ring).contains_points(at) for ring in rings]) for rings in self.rings]
        found = np.stack(within, axis=1)
        if self.floors is not None:
            found &= self.floors.number(position).numpy()[:, None] == np.array(self.floor)
        return found

    def named(self, position: Tensor) -> list[str]:
        """Return the name of the first room that contains each position (n, 3) [m], or "outside"."""
        found = self.contain(position)
        number = np.where(found.any(axis=1), found.argmax(axis=1), len(self.names))
        return [(*self.names, OUTSIDE)[room] for room in number.tolist()]

    def probability(self, position: Tensor, weight: Tensor) -> Tensor:
        """Return the probability of each room, and last of no room, float64 (n, rooms + 1).

        Args:
            position: Candidate positions of a posterior (n, m, 3) or (1, m, 3) [m].
            weight: Their masses (n, m).

        Example:
            >>> rooms = Rooms(("hall",), ((np.array([[0.0, 0], [4, 0], [4, 3], [0, 3]]),),))
            >>> at = torch.tensor([[[1.0, 1.0, 0.0], [5.0, 1.0, 0.0]]])
            >>> rooms.probability(at, torch.tensor([[0.75, 0.25]])).tolist()
            [[0.75, 0.25]]
        """
        found = self.contain(position.reshape(-1, 3))
        first = np.where(found.any(axis=1), found.argmax(axis=1), len(self.names))
        number = torch.from_numpy(first).reshape(position.shape[:2]).expand(len(weight), -1)
        mass = torch.zeros(len(weight), len(self.names) + 1, dtype=torch.float64)
        return mass.scatter_add(1, number, weight.double())

    def columns(self, probability: Tensor) -> dict[str, Any]:
        """Return columns of a table of observations, from `probability`: the most probable room, and each room.

        Example:
            >>> rooms = Rooms(("hall",), ((np.array([[0.0, 0], [4, 0], [4, 3], [0, 3]]),),))
            >>> {name: column.tolist() for name, column in rooms.columns(torch.tensor([[0.75, 0.25]])).items()}
            {'room': ['hall'], 'room_probability': [0.75], 'probability_hall': [0.75], 'probability_outside': [0.25]}
        """
        names = (*self.names, OUTSIDE)
        columns: dict[str, Any] = {
            "room": np.array(names, dtype=object)[probability.argmax(dim=1).numpy()],
            "room_probability": probability.amax(dim=1).numpy(),
        }
        return columns | {f"probability_{name}": each.numpy() for name, each in zip(names, probability.T, strict=True)}


def read_rooms(
    file: Path, origin: GeodeticOrigin | None = None, frame: PlanFrame | None = None, floors: Floors | None = None
) -> Rooms:
    """Return the rooms in a file: GeoJSON with polygons, or a table with a row for each corner, in order.

    Columns of a table are room, x, y (or longitude, latitude), and floor in a building with floors. Polygons have their name
    and floor as properties, and coordinates in the unit of the measurements.

    Args:
        file: The file.
        origin: Origin of the measurements, if their positions were in degrees; then corners are, too.
        frame: Axes of the measurements, which the corners share.
        floors: Floors of the measurements.

    Raises:
        InputError: No polygons, columns that are missing, an unknown floor, or wrong corners.
    """
    is_document = file.suffix.lower() in (".geojson", ".json")
    table = _corners(file, origin) if is_document else read_table(file)
    name = next((column for column in table.columns if str(column).strip().lower() in NAMES), None)
    if name is None or not len(table):
        raise InputError(f"{file} needs a column room and a row for each corner; there are {listed(table.columns)}")
    table = table[text_of(table[name]) != ""]
    at = positions_of(file, table, origin, frame or PlanFrame())[:, :2]
    if not np.isfinite(at).all():
        raise InputError(f"{file} has a corner without position; give each row x and y, or leave it out")
    rows = pd.DataFrame({"room": text_of(table[name]).to_numpy(), "ring": 0, "floor": 0})
    if "ring" in table:
        rows["ring"] = table["ring"].astype(str).to_numpy()
    if floors is not None:
        rows["floor"] = _floor_numbers(file, table, floors)
    found = [
        (room, number, tuple(at[ring.index] for _, ring in part.groupby("ring", sort=False)))
        for (room, number), part in rows.groupby(["room", "floor"], sort=False)
    ]
    names = [room for room, *_ in found]
    named = [
        room if names.count(room) == 1 or floors is None else f"{room} ({floors.names[number]})"
        for room, number, _ in found
    ]
    numbers, rings = tuple(number for _, number, _ in found), tuple(rings for *_, rings in found)
    return Rooms(tuple(named), rings, floors, numbers, digests([file]))


def _floor_numbers(file: Path, table: pd.DataFrame, floors: Floors) -> list[int]:
    column = column_of(table, "floor", {})
    named = [] if column is None else text_of(table[column]).tolist()
    number = {name: n for n, names in enumerate(floors.names) for name in names.split(", ")}
    if not named or not set(named) <= set(number):
        raise InputError(f"{file} needs the floor of each room, one of {listed(number)}, in a column floor")
    return [number[name] for name in named]


def _corners(file: Path, origin: GeodeticOrigin | None) -> pd.DataFrame:
    """Return a table with a row for each corner of the polygons in GeoJSON."""
    axes = ("x", "y") if origin is None else ("longitude", "latitude")
    text, rows = read_text(file), list[dict[str, Any]]()
    with refusing(f"{file} must be GeoJSON, a FeatureCollection of polygons with names"):
        for number, feature in enumerate(json.loads(text)["features"], start=1):
            about, geometry = feature.get("properties") or {}, feature["geometry"]
            if geometry["type"] not in ("Polygon", "MultiPolygon"):
                continue
            polygons = geometry["coordinates"] if geometry["type"] == "MultiPolygon" else [geometry["coordinates"]]
            room, floor = (_property(about, keys) for keys in (NAMES, FLOOR_NAMES))
            for ring, corners in enumerate(corners for polygon in polygons for corners in polygon):
                rows += [
                    {"room": room or f"room {number}", "ring": ring, "floor": floor}
                    | {axis: str(float(value)) for axis, value in zip(axes, corner[:2], strict=True)}
                    for corner in corners
                ]
    return pd.DataFrame(rows, columns=["room", "ring", "floor", *axes])


def _property(about: dict[str, Any], keys: Sequence[str]) -> str:
    return next((str(value).strip() for key, value in about.items() if key.lower() in keys and value is not None), "")
