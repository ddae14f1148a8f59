"""Coverage: where a scan has receivers beyond a threshold with some certainty, and which cells the scans determine.

A scan is one packet at each of R receivers. Receiver r is above the threshold t with probability

    p_r = p(r detects the packet) Phi((mean_r - t) / std_r),

where mean and standard deviation are those of detected packets. The errors of a scan have a common correlation, e.g. by a
body beside the device (one-factor Gaussian copula). Where smaller is better, e.g. for latency, values and threshold change
their signs.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame
from scipy.ndimage import label
from scipy.spatial import cKDTree
from scipy.special import ndtri

from swiftwrf.data.rssi import Rssi
from swiftwrf.positions import inside
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.pairs import PairModel
from swiftwrf.rssi.scans import at_least, passing

WIFI_DBM, OTHER_DBM = -67.0, -75.0  # usual thresholds: voice over Wi-Fi; BLE and others
CERTAINTY = 0.9  # probability from which a cell is covered
CLASSES = ("not measured", "not covered", "uncertain", "covered")  # of cells, in the order of their numbers
SMALLER = re.compile(r"latency|delay|jitter|round.?trip|rtt|ping|loss|error|retr|interference|noise", re.IGNORECASE)
WIFI = re.compile(r"(?<![a-z])(wi-?fi|wlan|wap|ap|b?ssid|access ?point)(?![a-z])", re.IGNORECASE)


def default_threshold(data: Rssi) -> tuple[float, str]:
    """Return the threshold of the coverage of data [dBm], and the reason for it.

    It is the median of the values of another quantity than RSSI. It is that of Wi-Fi if names of the data set, of receivers
    or of columns taken as receivers are those of Wi-Fi.

    Example:
        >>> default_threshold(Rssi([[-60.0]], [[0, 0, 1]], receiver_names=["WAP012"]))
        (-67.0, 'the default for Wi-Fi, by the name WAP012')
        >>> default_threshold(Rssi([[-60.0]], [[0, 0, 1]], receiver_names=["beacon"]))
        (-75.0, 'the default for receivers that no name shows to be Wi-Fi')
    """
    if not data.is_power:
        return float(f"{np.nanmedian(data.rssi_dbm.numpy()):.3g}"), "the median of the measured values"
    taken = [column for note in data.notes for column in re.findall(r"receiver = (\S+?)(?:,|$)", note)]
    for name in (*data.receiver_names, *taken, data.name):
        if WIFI.search(name):
            return WIFI_DBM, f"the default for Wi-Fi, by the name {name}"
    return OTHER_DBM, "the default for receivers that no name shows to be Wi-Fi"


def smaller_is_better(quantity: str) -> bool:
    """Return True for quantities whose names are those of latency, loss, noise and the like.

    Example:
        >>> [smaller_is_better(name) for name in ("latency", "packet loss", "throughput", "signal-to-noise ratio")]
        [True, True, False, False]
    """
    return bool(SMALLER.search(quantity)) and "signal" not in quantity.lower()


def reach(model: RssiModel | PairModel, max_open_variance: float = 0.5, max_widening: float = 1.2) -> float:
    """Return the distance [m] from a scan up to which it determines the field of a fitted model.

    Beyond it both limits are exceeded. It is infinite if no interval is so wide, since the field explains little.

    Args:
        model: Fitted model.
        max_open_variance: Fraction of the variance of the field that remains. A definition.
        max_widening: Width of the interval of a measurement relative to that at the scan. A definition.

    Example:
        >>> import swiftwrf
        >>> round(reach(swiftwrf.RssiModel().fit(swiftwrf.rssi_room())), 2)
        1.64
    """
    kernel = model.kernel  # whose rough part alone has a weight: exp(-r / l)
    open_variance = max(max_open_variance, (max_widening**2 - 1) * kernel.noise)
    is_flat = isinstance(model, RssiModel) and not bool(model.field_db.any())
    return math.inf if is_flat or open_variance >= 1 else -kernel.matern12_length / 2 * math.log(1 - open_variance)


def classified(
    probability: NDArray[Any], measured: NDArray[np.bool_], certainty: float = CERTAINTY
) -> NDArray[np.int64]:
    """Return the number of the class of each cell in `CLASSES`.

    Example:
        >>> found = classified(np.array([0.95, 0.5, 0.05, 0.95]), np.array([True, True, True, False]))
        >>> [CLASSES[number] for number in found]
        ['covered', 'uncertain', 'not covered', 'not measured']
    """
    return np.where(measured, 1 + (probability > 1 - certainty) + (probability >= certainty), 0)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Probability that a scan has at least a number of receivers beyond a threshold, on the cells of one floor.

    Args:
        probability: Probability in each cell of a map, float64 (rows, columns).
        inside: Cells inside the scans, bool (rows, columns).
        measured: Those of them that a scan determines, bool (rows, columns).
        values: Fractions of the measured cells that are `covered` (probability of at least `certainty`), `not_covered` (at
            most 1 - `certainty`) and `uncertain`, of the cells inside that are `not_measured`, and of the `n_scans` scans
            that are above, `scans_above`; with `threshold_dbm`, `direction` ("above" or "below", which then holds for
            `scans_above`, too), `certainty`, `at_least` (number of receivers) and `reach_m`. None is a fraction of
            nothing, and no limit. All are None between ends that both move.
    """

    probability: NDArray[np.float64]
    inside: NDArray[np.bool_]
    measured: NDArray[np.bool_]
    values: dict[str, Any]

    @classmethod
    def of(
        cls,
        chart: RssiMap,
        scans: Rssi,
        limits: tuple[float, float, int],
        reach: float = math.inf,
        below: bool = False,
    ) -> Self:
        """Return the coverage of a map of detected packets, `RssiMap.predict(model, detected=True)`.

        Args:
            chart: Map.
            scans: Measured rows on the floor of the map, at its receivers.
            limits: Threshold [dBm], probability from which a cell is covered, above 0.5, and number of receivers.
            reach: Distance from a scan up to which it determines cells, in plan [m].
            below: True where smaller is better: values below the threshold are covered.

        Example:
            >>> import swiftwrf
            >>> floor = swiftwrf.rssi_room(n=60)
            >>> chart = RssiMap.predict(swiftwrf.RssiModel().fit(floor), detected=True)
            >>> Coverage.of(chart, floor, (-75.0, 0.9, 1)).values["covered"]
            1.0
        """
        (threshold_dbm, certainty, number), scans = limits, scans.about(chart.origin)
        mean, std, detection = (torch.from_numpy(field) for field in (chart.mean, chart.std, chart.detection))
        probability = at_least(number, mean, std, detection, threshold_dbm, chart.correlation, below).numpy()
        cells, known = np.stack(np.meshgrid(chart.x, chart.y), axis=-1), scans.transmitter_position[:, :2].numpy()
        enclosed = inside(cells, known) if len(known) else np.zeros(probability.shape, dtype=bool)
        measured = enclosed & (cKDTree(known).query(cells)[0] <= reach)
        above = passing(scans.rssi_dbm, threshold_dbm, number, below).numpy()
        of_cell = classified(probability, measured, certainty)[measured]
        parts = {name.replace(" ", "_"): of_cell == CLASSES.index(name) for name in CLASSES[:0:-1]}
        parts |= {"not_measured": ~measured[enclosed], "scans_above": above}
        if scans.receiver_moves:  # a row is no scan, and the places where a receiver was are not there at once
            parts = {name: part[:0] for name, part in parts.items()}
        fractions = {name: float(part.mean()) if len(part) else None for name, part in parts.items()}
        limited: dict[str, Any] = {"threshold_dbm": threshold_dbm, "direction": "below" if below else "above"}
        limited |= {"certainty": certainty, "at_least": number, "n_scans": None if scans.receiver_moves else len(above)}
        reach_m = reach if math.isfinite(reach) else None
        return cls(probability, enclosed, measured, {**limited, "reach_m": reach_m, **fractions})

    def weak_spots(self, chart: RssiMap) -> DataFrame:
        """Return the connected measured areas that are not covered, a row each, those without any coverage first.

        Args:
            chart: Map of detected packets that the coverage is of.

        Returns:
            `area_m2`, the part `not_covered_m2` of it, and its weakest cell: place `x_m` and `y_m`, the `probability`, the
            best `receiver`, and the `missing_db` by which that is too weak, or too high where smaller is better, for its
            detected packets to pass with the certainty. For at least k receivers it is the k-th best one. 0 dB are missing
            where packets are lost.

        Example:
            >>> import swiftwrf
            >>> floor = swiftwrf.rssi_room(n=60)
            >>> chart = RssiMap.predict(swiftwrf.RssiModel().fit(floor), cell=1.0, detected=True)
            >>> Coverage.of(chart, floor, (-50.0, 0.9, 1)).weak_spots(chart).columns.tolist()[:4]
            ['x_m', 'y_m', 'area_m2', 'not_covered_m2']
        """
        threshold_dbm, certainty, number = (self.values[name] for name in ("threshold_dbm", "certainty", "at_least"))
        of_cell = classified(self.probability, self.measured & (self.values["n_scans"] is not None), certainty)
        sign = -1 if self.values["direction"] == "below" else 1
        shortfall = sign * (threshold_dbm - chart.mean) + ndtri(certainty) * chart.std.astype(float)
        order = np.argsort(shortfall, axis=0, kind="stable")[number - 1]
        missing = np.take_along_axis(shortfall, order[None], 0)[0]
        areas, n_areas = label((of_cell == 1) | (of_cell == 2), np.ones((3, 3)))
        rows = []
        for area in (areas == one for one in range(1, n_areas + 1)):
            weakest = np.unravel_index(np.where(area, missing, -np.inf).argmax(), area.shape)
            rows.append(
                {
                    "x_m": float(chart.x[weakest[1]]),
                    "y_m": float(chart.y[weakest[0]]),
                    "area_m2": float(area.sum() * chart.cell**2),
                    "not_covered_m2": float((of_cell[area] == 1).sum() * chart.cell**2),
                    "probability": float(self.probability[weakest]),
                    "missing_db": max(float(missing[weakest]), 0.0),
                    "receiver": chart.receiver_names[order[weakest]],
                }
            )
        columns = ["x_m", "y_m", "area_m2", "not_covered_m2", "probability", "missing_db", "receiver"]
        found = DataFrame(rows, columns=columns)
        return found.sort_values(["not_covered_m2", "area_m2"], ascending=False, ignore_index=True)
