"""A floor where RSSI was measured, and maps of what a model predicts there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from swiftwrf import RssiModel
from swiftwrf.rssi import LEVEL

DEVIATIONS = ndtri((1 + LEVEL) / 2)  # half of an interval, of a normal variable
Corners = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Floor:
    """Where RSSI was measured.

    Args:
        measured: positions of the transmitter [m], (n, 3).
        rssi_dbm: measured there, (n, R) [dBm], nan where a receiver did not hear.
        receiver: positions [m], (R, 3), nan where they are unknown.
        plan: an image of the floor, (height, width, 3), and its corners x0, x1, y0, y1 [m]; None where there is none.
    """

    measured: NDArray[np.floating]
    rssi_dbm: NDArray[np.floating]
    receiver: NDArray[np.floating]
    plan: tuple[NDArray[np.uint8], Corners] | None = None

    @classmethod
    def kept(cls, maps: Mapping[str, NDArray[Any]]) -> Floor:
        """Of a run's maps.npz."""
        plan = None
        if "plan" in maps:
            x0, x1, y0, y1 = maps["plan_extent"].tolist()
            plan = maps["plan"], (x0, x1, y0, y1)
        return cls(maps["measured_position"], maps["measured"], maps["receiver"], plan)

    @classmethod
    def of(cls, model: RssiModel) -> Floor:
        """As far as a model by itself tells: some measured positions, but no values."""
        at = (model.known_position + model.centre).numpy()
        return cls(at, np.full((len(at), len(model.receiver_names)), np.nan), model.receiver.numpy())


@dataclass(frozen=True, eq=False)
class Maps:
    """Predictions over the floor at one height.

    Args:
        x, y: middles of the cells [m].
        height: [m].
        middle, low, high: prediction and its interval [dBm], (R, len(y), len(x)).
    """

    x: NDArray[np.floating]
    y: NDArray[np.floating]
    height: float
    middle: NDArray[np.floating]
    low: NDArray[np.floating]
    high: NDArray[np.floating]

    @property
    def corners(self) -> Corners:
        """x0, x1, y0, y1 of the picture of all cells [m]."""
        half_x, half_y = (self.x[1] - self.x[0]) / 2, (self.y[1] - self.y[0]) / 2
        return self.x[0] - half_x, self.x[-1] + half_x, self.y[0] - half_y, self.y[-1] + half_y

    @property
    def width(self) -> NDArray[np.floating]:
        """Of the intervals [dB]."""
        return self.high - self.low

    def assured(self, certainty: float) -> NDArray[np.floating]:
        """What a measurement exceeds with a certainty in (0, 1) [dBm], (R, len(y), len(x)), its deviation normal as that of
        the interval: at 90 % the lower end of the 80 % interval."""
        assured: NDArray[np.floating] = self.middle - ndtri(certainty) * self.width / (2 * DEVIATIONS)
        return assured

    @property
    def best(self) -> NDArray[np.integer]:
        """Number of the receiver with the highest prediction, (len(y), len(x))."""
        best: NDArray[np.integer] = self.middle.argmax(axis=0)
        return best
