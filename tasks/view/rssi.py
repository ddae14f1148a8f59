"""RSSI at any position: the computations behind the page of RSSI maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from swiftwrf import Prediction, Rssi, RssiModel
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.dataset import Numbers
from swiftwrf.locate.posterior import PlanMap
from swiftwrf.metrics import LEVEL
from swiftwrf.models.prediction import difference_unit, suffix
from swiftwrf.rssi.coverage import CLASSES, OTHER_DBM, Coverage, classified, default_threshold, reach, smaller_is_better
from swiftwrf.rssi.maps import RssiMap
from tasks.page.maps import CLASS_COLOURS, Corners, FloorPlan
from tasks.records import METRICS, RECEIVERS, Row, as_table, read_json, read_npz, rounded
from tasks.rssi.coverage import coverage_sentence
from tasks.rssi.maps import MAX_WIDTH_DB
from tasks.view.locating import RssiLocating

RECEIVER_COLOURS, N_RECEIVER_COLOURS = "tab20", 20
MAX_MAPS = 8  # in memory, e.g. those of as many floors
MapKind = Literal["coverage", "RSSI", "interval", "best receiver", "posterior", "expected error"]
LOCATING: tuple[MapKind, ...] = ("posterior", "expected error")
Values = NDArray[np.floating]


def rows_of_run(file: Path, model: RssiModel) -> Rssi:
    """Return the measured rows in the `maps.npz` of a run of a model.

    Raises:
        InputError: The file is damaged, or contains other receivers.
    """
    stored = read_npz(file)
    measured, position, receiver = stored["measured"], stored["measured_position"], stored["receiver"]
    return _rows(model, measured, position, receiver, stored["bands"].tolist() if "bands" in stored else [])


def rows_of_model(model: RssiModel) -> Rssi:
    """Return rows at the positions that a model contains, without the RSSI measured there."""
    position = model.region()
    return _rows(
        model, torch.full((len(position), len(model.receiver_names)), torch.nan), position, model.receiver_position
    )


def _rows(model: RssiModel, measured: Numbers, position: Numbers, receiver: Numbers, bands: Sequence[str] = ()) -> Rssi:
    return Rssi(
        measured,
        position,
        receiver_position=receiver,
        receiver_names=model.receiver_names,
        bands=bands or None,
        quantity=model.quantity,
        unit=model.unit,
    )


@dataclass(frozen=True)
class MapSelection:
    """The map that a visitor has selected."""

    kind: MapKind  # what the map shows
    receiver: int  # number of the receiver, counted from 0. Maps of all receivers ignore it
    height: float  # height of the transmitter [m]
    threshold: float = OTHER_DBM  # threshold of the coverage, in the unit of the values
    certainty: float = 0.9  # required probability that a measurement passes the threshold, in (0, 1)
    row: int = 0  # row whose posterior is shown, counted from 0
    at_least: int = 0  # number of receivers of the coverage; 0 for that of the selected receiver
    band: str = ""  # band of the receivers of the coverage, empty for all


@dataclass(frozen=True)
class ColouredMap:
    """Values of a map, their colours, and what it shows."""

    sentence: str  # description in a few sentences
    values: Values  # values (len(y), len(x)), nan where the map is transparent
    colours: str  # name of a matplotlib colour map
    low: float  # value of its first colour
    high: float  # value of its last colour
    label: str  # unit. Empty if the colours stand for names
    extend: str = "neither"  # ends of the scale that stand for all values beyond, "neither", "max" or "both"
    corners: Corners | None = None  # edges x0, x1, y0, y1 [m] of the picture. Defaults to those of the map


@dataclass(eq=False)
class RssiView:
    """A fitted RSSI model and the floor where it was measured."""

    title: str  # title of the page
    model: RssiModel  # fitted model
    rows: Rssi  # measured rows
    locating: RssiLocating | None = None  # locator and the rows that it locates. None if there is no locator
    notes: list[str] = field(default_factory=list)  # remarks on the data, a sentence each
    folder: Path | None = None  # directory of the run, where a floor plan is saved. None for a saved model
    plan: FloorPlan | None = field(default=None, init=False)  # image of the floor. None if there is none
    estimated: dict[str, tuple[list[float], float]] = field(default_factory=dict, init=False)
    """Estimated position [m] and radius of its 80 % region [m] of receivers of unknown position, by name."""

    def __post_init__(self) -> None:
        if self.folder is not None:
            self.plan = FloorPlan.load(self.folder)
            if (file := self.folder / f"{RECEIVERS}.npz").is_file():
                found = read_npz(file)
                names, position, radius = (
                    found["names"].tolist(),
                    found["position"].tolist(),
                    found["radius_m"].tolist(),
                )
                places = zip(position, radius, strict=True)
                self.estimated = dict(zip(names, places, strict=True))
        self.map = lru_cache(maxsize=MAX_MAPS)(
            lambda height, counted=False, detected=False: RssiMap.predict(
                self.model, height=height, region=None if counted else self.region, detected=detected
            )
        )
        """Return the map at a height of the transmitter [m], on the cells that are shown, or `counted`: those of the report.

        It is that of all packets, or of `detected` ones. The last ones are cached for all visitors.
        """

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of the receivers."""
        return self.model.receiver_names

    @property
    def threshold(self) -> float:
        """Threshold of the coverage that is shown first: that of the run, or else the default."""
        if self._coverage:
            return float(self._coverage["threshold_dbm"])
        if self.rows.is_power or self.rows.detected.any():
            return default_threshold(self.rows)[0]
        return float(f"{float(self.model.value_centre):.3g}")  # a saved model does not contain what was measured

    @cached_property
    def _coverage(self) -> Row:
        """Coverage of the lowest floor of the run, empty without a run."""
        file = None if self.folder is None else self.folder / METRICS
        found = read_json(file).get("coverage") if file is not None and file.is_file() else None
        return dict(found[0]) if found else {}

    @property
    def below(self) -> bool:
        """True if values below the threshold are covered."""
        default = "below" if smaller_is_better(self.model.quantity) else "above"
        return str(self._coverage.get("direction", default)) == "below"

    @property
    def direction(self) -> str:
        """Side of the threshold that is covered."""
        return "below" if self.below else "above"

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return self.model.unit

    @property
    def limits(self) -> tuple[float, float, float]:
        """Lowest and highest threshold that can be chosen, and the step between them."""
        if self.unit == "dBm":
            return -110.0, -30.0, 1.0
        values = self.rows.rssi_dbm[self.rows.detected].numpy()
        values = np.append(values if len(values) else self.map(self.heights[1]).mean, self.threshold)
        low, high = float(values.min()), float(values.max())
        step = 10.0 ** np.floor(np.log10(max(high - low, 1e-9) / 50))
        return float(np.floor(low / step) * step), float(np.ceil(high / step) * step), float(step)

    @property
    def position(self) -> Values:
        """Measured positions of the transmitter, (n, 3) [m]."""
        return self.rows.transmitter_position.numpy()

    @property
    def kinds(self) -> tuple[MapKind, ...]:
        """Available maps. The best receiver needs several receivers, the position a locator."""
        missing: tuple[MapKind, ...] = () if len(self.receivers) > 1 else ("best receiver",)
        missing += () if self.locating else LOCATING
        return tuple(kind for kind in get_args(MapKind) if kind not in missing)

    @property
    def heights(self) -> tuple[float, float, float]:
        """Lowest, median and highest height of the transmitter [m]."""
        low, middle, high = np.quantile(self.position[:, 2], (0, 0.5, 1)).tolist()
        return low, middle, high

    @property
    def floors(self) -> Floors | None:
        """Floors of the building; None if there is one only."""
        return None if self.model.attenuation is None else self.model.attenuation.floors

    def on_floor(self, height: float) -> NDArray[np.bool_]:
        """Return which measured rows are on the floor of a height [m], (n,)."""
        if self.floors is None:
            return np.ones(len(self.position), dtype=bool)
        at = torch.tensor([[0.0, 0.0, height]], dtype=torch.float64)
        return (self.floors.number(self.rows.transmitter_position) == self.floors.number(at)).numpy()

    def place(self, plan: FloorPlan) -> None:
        """Show a floor plan below the maps, and save it in the directory of the run."""
        if self.folder is not None:
            plan.save(self.folder)
        self.plan = plan
        self.map.cache_clear()  # maps cover the plan, too

    @property
    def region(self) -> Values:
        """Positions (n, 2) [m] whose box the page covers: measurements, known receivers and the floor plan."""
        corners = np.array(self.plan.corners).reshape(2, 2).T if self.plan else np.empty((0, 2))
        receiver = self.rows.receiver_position[self.rows.receiver_located]
        return np.concatenate([self.model.region().numpy()[:, :2], receiver.numpy()[:, :2], corners])

    def known(self, height: float, counted: bool = False) -> NDArray[np.bool_]:
        """Return the measured cells of a map, (rows, columns)."""
        return self.coverage(MapSelection("coverage", 0, height), chart=self.map(height, counted)).measured

    def silent(self, selection: MapSelection) -> NDArray[np.bool_]:
        """Return where a packet is more likely lost than received, at the selected receiver or at all of them."""
        detection = self.map(selection.height).detection
        shown = detection.max(axis=0) if selection.kind == "best receiver" else detection[selection.receiver]
        return np.asarray(shown < 0.5)

    def coloured(self, selection: MapSelection) -> ColouredMap:
        """Return values, colours and a description of the selected map."""
        if self.locating is not None and (found := self._located(selection)) is not None:
            if selection.kind == "posterior":
                text = self.locating.describe(selection.row)
                return ColouredMap(text, found.values, "magma", 0.0, 1.0, "of the maximum", corners=found.corners)
            most = float(np.nanpercentile(found.values, 98))
            return ColouredMap(self.locating.summary, found.values, "viridis", 0.0, most, "m", "max", found.corners)
        chart, receiver = self.map(selection.height), selection.receiver
        mean, name = chart.mean, self.receivers[receiver]
        hatched = " Hatched: a packet is more likely lost than received." if self.silent(selection).any() else ""
        match selection.kind:
            case "RSSI":
                detected = self.rows.detected
                shown = self.rows.rssi_dbm[detected].numpy() if detected.any() else mean
                low, high = np.percentile(shown, (1, 99)).tolist()
                dots = "; dots: measured, in the same colours, hollow where nothing was received"
                shown_dots = dots if detected[:, receiver].any() else ""
                text = f"Predicted {self.model.quantity} of {name}{shown_dots}.{hatched}"
                return ColouredMap(text, mean[receiver], "viridis", low, high, self.unit, "both")
            case "interval":
                low, high = chart.prediction.interval(LEVEL)
                text = f"Width of the {LEVEL:.0%} interval of a measurement at {name}.{hatched}"
                width = (high - low)[receiver].numpy()
                widest = MAX_WIDTH_DB if self.unit == "dBm" else float(np.percentile(width, 99))
                return ColouredMap(text, width, "magma", 0.0, widest, difference_unit(self.unit), "max")
            case "coverage":
                text = coverage_sentence(self.coverage(selection, counted=True).values, self._passing(selection))
                return ColouredMap(text, self.classes(selection).astype(float), CLASS_COLOURS, 0, len(CLASSES) - 1, "")
            case "best receiver":
                first, part = next(iter(self.best(selection.height).items()))
                best = f"{self.receivers[first]} on {part:.0%} of the measured area"
                text = f"Receiver with the {'lowest' if self.below else 'highest'} prediction: {best}.{hatched}"
                values = self._best(mean) % N_RECEIVER_COLOURS + 0.5
                return ColouredMap(text, values, RECEIVER_COLOURS, 0, N_RECEIVER_COLOURS, "")
        raise AssertionError(selection.kind)

    def _located(self, selection: MapSelection) -> PlanMap | None:
        """Return the map of the locator. None for the maps of the model."""
        if self.locating is None or selection.kind not in LOCATING:
            return None
        return (
            self.locating.expected_error
            if selection.kind == "expected error"
            else self.locating.located(selection.row).density
        )

    def _who(self, selection: MapSelection) -> str:
        """Return the receivers of the selected coverage, in words."""
        if selection.band:
            return f"one of {len(self.rows.receivers_by_band[selection.band])} receivers of {selection.band}"
        names = {0: self.receivers[selection.receiver], 1: f"one of {len(self.receivers)} receivers"}
        return names.get(selection.at_least, f"at least {selection.at_least} receivers")

    def _passing(self, selection: MapSelection) -> str:
        """Return the receivers and the threshold of the selected coverage, in words."""
        return f"{self._who(selection)} {self.direction} {selection.threshold:g} {self.unit}"

    def _best(self, mean: Values) -> NDArray[np.int64]:
        """Return the number of the best of the receivers (R, ...)."""
        return np.asarray(mean.argmin(axis=0) if self.below else mean.argmax(axis=0))

    def coverage(self, selection: MapSelection, counted: bool = False, chart: RssiMap | None = None) -> Coverage:
        """Return the selected coverage, in the cells of a map of detected packets if one is given; see `map`."""
        chart = chart or self.map(selection.height, counted, detected=True)
        scans, number = self.rows.subset(self.on_floor(selection.height)), selection.at_least
        if selection.band:
            columns, number = self.rows.receivers_by_band[selection.band], 1
            chart, scans = chart.receivers([self.receivers[column] for column in columns]), scans.columns(columns)
        elif number == 0:
            chart, scans = chart.receivers([self.receivers[selection.receiver]]), scans.columns([selection.receiver])
        limits = selection.threshold, selection.certainty, max(number, 1)
        return Coverage.of(chart, scans, limits, reach(self.model), self.below)

    def classes(self, selection: MapSelection) -> NDArray[np.int64]:
        """Return the numbers in `CLASSES` of the cells of the map that is shown, (rows, columns)."""
        found = self.coverage(selection)
        return classified(found.probability, found.measured, selection.certainty)

    def best(self, height: float) -> dict[int, float]:
        """Return the fraction of the measured cells where each receiver is the best one, the largest first.

        All cells count on a floor without scans.
        """
        best, known = self._best(self.map(height, counted=True).mean), self.known(height, counted=True)
        counts = np.bincount(best[known if known.any() else ...].ravel())
        order = [int(number) for number in np.argsort(-counts, kind="stable") if counts[number]]
        return {number: float(counts[number] / counts.sum()) for number in order}

    def at(self, selection: MapSelection, x: float, y: float) -> Prediction:
        """Return the predictions of all receivers (R,) at a position [m], at the height of the selected map."""
        with torch.no_grad():
            found = self.model.predict(np.array([[x, y, selection.height]]))
        assert found.std is not None
        return Prediction(found.mean[0], found.std[0])

    def describe(self, selection: MapSelection, x: float, y: float) -> str:
        """Describe the predictions at a position [m] in lines of text."""
        if (found := self._located(selection)) is not None:
            value, what = found.at(x, y), "outside the region of the measured positions"
            if np.isfinite(value):
                is_error = selection.kind == "expected error"
                what = f"expected position error {value:.2f} m" if is_error else f"posterior {value:.1%} of its maximum"
            return f"at {x:.2f}, {y:.2f} m\n{what}"
        rssi, r = self.at(selection, x, y), selection.receiver
        mean, (low, high), unit = rssi.mean, rssi.interval(LEVEL), self.unit
        lines = [
            f"at {x:.2f}, {y:.2f} m",
            f"{self.receivers[r]}: {mean[r]:.1f} {unit}, {LEVEL:.0%} of measurements in "
            f"[{low[r]:.1f}, {high[r]:.1f}] {unit}",
        ]
        if selection.kind == "coverage":
            here = RssiMap.predict(self.model, 1.0, selection.height, np.array([[x, y]]), detected=True)
            above = float(self.coverage(selection, chart=here).probability[0, 0])
            lines.append(f"{self._passing(selection)} with {above:.0%}")
        if len(self.receivers) > 1:
            best = int(self._best(mean.numpy()))
            lines.append(f"best receiver: {self.receivers[best]}, {mean[best]:.1f} {unit}")
        return "\n".join(lines)

    def table(self, selection: MapSelection) -> str:
        """Return the selected map as comma-separated values, a row per cell."""
        if self.locating is not None and (found := self._located(selection)) is not None:
            is_error = selection.kind == "expected error"
            name = "expected_error_m" if is_error else f"posterior_of_row_{self.locating.rows.index[selection.row]}"
            x, y = np.meshgrid(found.x, found.y)
            table = pd.DataFrame({"x_m": x.ravel(), "y_m": y.ravel(), name: found.values.ravel().round(4)}).dropna()
            return as_table(rounded(table.to_dict("records")))
        chart, r = self.map(selection.height), selection.receiver
        low, high = (end[r].double().numpy().ravel() for end in chart.prediction.interval(LEVEL))
        unit, differences = suffix(self.unit), suffix(difference_unit(self.unit))
        table = chart.receivers([self.receivers[r]]).to_frame().drop(columns=f"std_{differences}")
        table = table.assign(**{f"low_{unit}": low, f"high_{unit}": high})
        name = f"{self.direction}_{selection.threshold:g}_{unit}_with_{selection.certainty:.0%}"
        table[name] = np.array(CLASSES)[self.classes(selection).ravel()]
        table["best_receiver"] = np.array(self.receivers)[self._best(chart.mean).ravel()]
        return as_table(rounded(table.to_dict("records")))
