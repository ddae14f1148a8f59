"""Maps of predicted RSSI on square cells, as tables and data sets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from swiftwrf.data.dataset import DEGREE_UNITS, Arrays, Labelled, Numbers
from swiftwrf.data.rssi import receiver_row
from swiftwrf.errors import InputError, listed
from swiftwrf.models.prediction import Prediction, difference_unit, suffix
from swiftwrf.plotting import Axes, Displayed, corners_of, hatch, plan_map
from swiftwrf.positions import to_tensor
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.rssi.scans import CORRELATION

CELLS = 120  # of a map, along its longer side
MAX_CELLS = 2**22
Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RssiMap(Labelled, Displayed):
    """RSSI that R receivers detect from a transmitter at the centres of square cells of one height.

    Args:
        x: Centres of the columns, ascending, (columns,) [m].
        y: Centres of the rows, ascending, (rows,) [m].
        height: Height of the transmitter [m].
        cell: Edge of a cell [m].
        mean: Predictive mean (R, rows, columns) [dBm].
        std: Predictive standard deviation of a measurement (R, rows, columns) [dB].
        detection: Probability of a detection (R, rows, columns).
        receiver_names: Names of the receivers.
        origin: Latitude and longitude of x = y = 0, if they are known.
        quantity: RSSI, or what else is predicted.
        unit: Its unit.
        correlation: Correlation of the errors of the receivers of a scan.
    """

    x: Values
    y: Values
    height: float
    cell: float
    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    detection: NDArray[np.float32]
    receiver_names: tuple[str, ...]
    origin: GeodeticOrigin | None = None
    quantity: str = "RSSI"
    unit: str = "dBm"
    correlation: float = CORRELATION

    @classmethod
    def predict(
        cls,
        model: RssiPredictor,
        cell: float | None = None,
        height: float | None = None,
        region: Numbers | None = None,
        detected: bool = False,
    ) -> RssiMap:
        """Return the map of a fitted model over the box of a region.

        Args:
            model: Fitted model.
            cell: Edge of a cell [m]. Defaults to 1/120 of the longer side, larger if predictions of the model are slow.
            height: Height of the transmitter [m]. Defaults to the median of the training positions.
            region: Positions (n, 2 or 3) [m]. Defaults to the training positions and the known positions of receivers.
            detected: Predict mean and standard deviation of detected packets, as of `predict_detected`.

        Raises:
            InputError: A cell that is not positive, a region of no or other positions, a map of more than 2^22 cells, or a
                predictor without maps.

        Example:
            >>> import swiftwrf
            >>> model = swiftwrf.RssiModel().fit(swiftwrf.rssi_room(n=60))
            >>> RssiMap.predict(model, cell=1.0).mean.shape
            (12, 15, 19)
        """
        return cls.of_packets(model, cell, height, region)[detected]

    @classmethod
    def of_packets(
        cls,
        model: RssiPredictor,
        cell: float | None = None,
        height: float | None = None,
        region: Numbers | None = None,
    ) -> tuple[RssiMap, RssiMap]:
        """Return the maps of all packets and of detected ones, from one prediction; arguments and errors as of `predict`.

        Example:
            >>> import swiftwrf
            >>> every, detected = RssiMap.of_packets(swiftwrf.RssiModel().fit(swiftwrf.rssi_room(n=60)), cell=1.0)
            >>> bool((detected.mean >= every.mean).all())
            True
        """
        known, receiver = model.region(), model.receiver_position
        if region is None:
            region = torch.cat([known, receiver[receiver.isfinite().all(dim=1)]])
        sides = 2 if np.ndim(region) == 2 and np.shape(region)[1] == 2 else 3
        corner = to_tensor("region", region, torch.float64, (None, sides)).numpy()[:, :2]
        if not len(corner):
            raise InputError(
                "a region needs at least one position, got none; leave it out for that of the training rows"
            )
        low, high = corner.min(axis=0), corner.max(axis=0)
        if cell is None:
            n_cells = min(CELLS, math.isqrt(model.max_map_predictions // len(model.receiver_names)))
            cell = float((high - low).max()) / n_cells or 1.0
        if not cell > 0:
            raise InputError(f"a cell needs an edge above 0 m, got {cell:g}")
        sizes = np.maximum(np.ceil((high - low) / cell), 1)
        if sizes.prod() > MAX_CELLS:
            raise InputError(f"a map of cells of {cell:g} m would have {sizes.prod():.3g} of them; take larger cells")
        first = (low + high - sizes * cell) / 2 + cell / 2
        x, y = (start + cell * np.arange(int(size)) for start, size in zip(first, sizes, strict=True))
        z = float(known[:, 2].median()) if height is None else height
        grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], axis=-1).reshape(-1, 3)
        about = model.receiver_names, model.origin, model.quantity, model.unit, model.scan_correlation
        every, detected, detection = model.predict_packets(grid)

        def chart(prediction: Prediction) -> RssiMap:
            assert prediction.std is not None
            fields = (prediction.mean, prediction.std, detection)
            mean, std, found = (values.T.reshape(-1, len(y), len(x)).float().numpy() for values in fields)
            return cls(x, y, z, cell, mean, std, found, *about)

        return chart(every), chart(detected)

    def receivers(self, asked: Sequence[str]) -> RssiMap:
        """Return the map of receivers by their names, or by numbers counted from 1.

        Raises:
            InputError: An unknown receiver.
        """
        rows = [receiver_row(self.receiver_names, name, "the map") for name in asked]
        names = tuple(self.receiver_names[row] for row in rows)
        fields = {name: getattr(self, name)[rows] for name in ("mean", "std", "detection")}
        return replace(self, **fields, receiver_names=names)

    @property
    def prediction(self) -> Prediction:
        """Prediction of all cells, mean and standard deviation (R, rows, columns)."""
        return Prediction(torch.from_numpy(self.mean), torch.from_numpy(self.std))

    @property
    def corners(self) -> tuple[float, float, float, float]:
        """Edges x0, x1, y0, y1 of all cells [m]."""
        return corners_of(self.x, self.y, self.cell)

    def plot(self, receiver: str | None = None, ax: Axes | None = None) -> Axes:
        """Draw the map of the predictive mean, seen from above; hatched where a detection is less likely than not.

        Args:
            receiver: Name of a receiver, or its number from 1. Defaults to the strongest RSSI at each position.
            ax: Axes to draw into. Defaults to those of a new figure.

        Raises:
            InputError: An unknown receiver.
        """
        shown = self if receiver is None else self.receivers([receiver])
        ax = plan_map(self.corners, shown.mean.max(axis=0), f"predicted {self.quantity} [{self.unit}]", ax)
        hatch(ax, self.x, self.y, shown.detection.max(axis=0) < 0.5)
        of = "the strongest receiver" if receiver is None else shown.receiver_names[0]
        ax.set_title(f"predicted {self.quantity} of {of}")
        return ax

    def __repr__(self) -> str:
        facts = self._facts()
        return f"<RssiMap of {facts['receivers']}:\n {facts['cells']}, height {self.height:g} m>"

    def _facts(self) -> dict[str, str]:
        cells = f"{len(self.y)} x {len(self.x)} cells of {self.cell:.3g} m"
        return {"receivers": listed(self.receiver_names), "cells": cells, "height": f"{self.height:g} m"}

    def to_frame(self) -> pd.DataFrame:
        """Return a table with one row for each cell and receiver."""
        x, y = (values.ravel() for values in np.meshgrid(self.x, self.y))
        cells = {"x_m": x, "y_m": y, "z_m": np.full(len(x), self.height)}
        cells |= degree_columns(self.origin, np.stack([x, y], axis=1))
        n_receivers = len(self.receiver_names)
        return pd.DataFrame({name: np.tile(values, n_receivers) for name, values in cells.items()}).assign(
            receiver=np.repeat(self.receiver_names, len(x)),
            **{
                f"predicted_{suffix(self.unit)}": self.mean.ravel(),
                f"std_{suffix(self._differences)}": self.std.ravel(),
            },
            detection=self.detection.ravel(),
        )

    @property
    def _differences(self) -> str:
        return difference_unit(self.unit)

    def coordinates(self) -> Arrays:
        metres = {"units": "m"}
        coordinates: Arrays = {
            "x": (("x",), self.x, metres),
            "y": (("y",), self.y, metres),
            "z": ((), np.array(self.height), metres),
        }
        cells = np.stack(np.meshgrid(self.x, self.y), axis=-1)
        degrees = degree_columns(self.origin, cells.reshape(-1, 2)).values()
        for (name, units), values in zip(DEGREE_UNITS.items(), degrees, strict=False):
            coordinates[name] = (("y", "x"), values.reshape(cells.shape[:2]), {"units": units})
        return coordinates | {"receiver": (("receiver",), np.array(self.receiver_names))}

    def variables(self) -> Arrays:
        dimensions = ("receiver", "y", "x")
        detection = (dimensions, self.detection, {"long_name": "probability of a detection"})
        values = {suffix(self.quantity): (dimensions, self.mean, {"units": self.unit})}
        values |= {"std": (dimensions, self.std, {"units": self._differences})}
        return values | {"detection": detection}
