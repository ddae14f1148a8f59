"""RSSI at any position: the computations behind the page of RSSI maps."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf import RssiModel
from swiftwrf.models.base import Prediction
from swiftwrf.rssi import LEVEL
from tasks.page import figures
from tasks.records import as_table
from tasks.view.drawing import PlanProjection

CELLS = 120  # of a map, along its longer side
RECEIVER_COLOURS, N_RECEIVER_COLOURS = "tab20", 20
RECEIVER_MARK = "#ee6677"
MIN_STD_DB = 1e-6
MapKind = Literal["RSSI", "interval", "coverage", "best receiver"]
Corners = tuple[float, float, float, float]  # x0, x1, y0, y1 [m]
Values = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class MeasuredFloor:
    """RSSI measurements on a floor.

    Args:
        position: Positions of the transmitter [m], (n, 3).
        rssi_dbm: Measured RSSI [dBm], (n, R), nan where a receiver detected nothing.
        receiver: Positions of the receivers [m], (R, 3), nan where they are unknown.
        plan: Image of the floor (height, width, 3) and its corners. None if there is none.
    """

    position: Values
    rssi_dbm: Values
    receiver: Values
    plan: tuple[NDArray[np.uint8], Corners] | None = None

    @classmethod
    def from_run(cls, maps: Mapping[str, NDArray[Any]]) -> MeasuredFloor:
        """Return the measurements in the `maps.npz` of a run."""
        plan = None
        if "plan" in maps:
            x0, x1, y0, y1 = maps["plan_extent"].tolist()
            plan = maps["plan"], (x0, x1, y0, y1)
        return cls(maps["measured_position"], maps["measured"], maps["receiver"], plan)

    @classmethod
    def from_model(cls, model: RssiModel) -> MeasuredFloor:
        """Return the positions that a model contains, without the RSSI measured there."""
        position = (model.anchor + model.centre).numpy()
        return cls(position, np.full((len(position), len(model.receiver_names)), np.nan), model.receiver.numpy())


@dataclass(frozen=True, eq=False)
class RssiMaps:
    """Predicted RSSI over the floor at one height of the transmitter.

    Args:
        x: Centres of the columns [m].
        y: Centres of the rows [m].
        height: Height of the transmitter [m].
        rssi: Predicted RSSI [dBm] and its standard deviation [dB], (R, len(y), len(x)).
    """

    x: Values
    y: Values
    height: float
    rssi: Prediction

    @property
    def corners(self) -> Corners:
        """Corners of the picture of all cells."""
        half_x, half_y = (self.x[1] - self.x[0]) / 2, (self.y[1] - self.y[0]) / 2
        return self.x[0] - half_x, self.x[-1] + half_x, self.y[0] - half_y, self.y[-1] + half_y

    @property
    def width(self) -> Values:
        """Width of the intervals [dB]."""
        low, high = self.rssi.interval(LEVEL)
        return (high - low).numpy()

    @property
    def best(self) -> NDArray[np.integer]:
        """Number of the receiver with the highest prediction, (len(y), len(x))."""
        return self.rssi.mean.argmax(dim=0).numpy()


@dataclass(frozen=True)
class MapSelection:
    """The map that a visitor has selected.

    Args:
        kind: Predicted RSSI, width of its interval, cells above the threshold, or receiver with the highest prediction.
        receiver: Number of the receiver, counted from 0. A map of the best receiver ignores it.
        height: Height of the transmitter [m].
        threshold: Threshold of the coverage [dBm].
        certainty: Required probability that a measurement exceeds the threshold, in (0, 1).
    """

    kind: MapKind
    receiver: int
    height: float
    threshold: float = -75.0
    certainty: float = 0.9


@dataclass(frozen=True)
class ColouredMap:
    """Values of a map and their colours.

    Args:
        values: Values (len(y), len(x)), nan where the map is transparent.
        colours: Name of a matplotlib colour map.
        low: Value of its first colour.
        high: Value of its last colour.
        label: Quantity with its unit. Empty if the colours stand for names.
    """

    values: Values
    colours: str
    low: float
    high: float
    label: str


@dataclass(eq=False)
class RssiView:
    """A fitted RSSI model and the floor where it was measured.

    Args:
        title: Title of the page.
        model: Fitted model.
        floor: Measurements on the floor.
    """

    title: str
    model: RssiModel
    floor: MeasuredFloor
    _last: RssiMaps | None = field(default=None, init=False, repr=False)

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of the receivers."""
        return self.model.receiver_names

    @property
    def kinds(self) -> tuple[MapKind, ...]:
        """Available maps. The best receiver needs several receivers."""
        kinds: tuple[MapKind, ...] = get_args(MapKind)
        return kinds if len(self.receivers) > 1 else kinds[:-1]

    @property
    def heights(self) -> tuple[float, float, float]:
        """Lowest, median and highest height of the transmitter [m]."""
        low, middle, high = np.quantile(self.floor.position[:, 2], (0, 0.5, 1)).tolist()
        return low, middle, high

    def plan(self, max_px: tuple[int, int] = (CELLS, CELLS)) -> PlanProjection:
        """Return the plan that contains measurements, receivers and floor plan, at most of this size in pixels."""
        corners = np.array(self.floor.plan[1]).reshape(2, 2).T if self.floor.plan else self.floor.position
        return PlanProjection.around(self.floor.position, self.floor.receiver, corners, max_px=max_px)

    def maps(self, height: float) -> RssiMaps:
        """Return the predictions at a height [m]. Those of the last height are cached."""
        if self._last is None or self._last.height != height:
            self._last = self._predicted(height)
        return self._last

    def _predicted(self, height: float) -> RssiMaps:
        plan = self.plan()
        x, y = (
            low + (np.arange(cells) + 0.5) / cells * (high - low)
            for low, high, cells in zip(plan.low, plan.high, plan.size, strict=True)
        )
        cells = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], axis=-1).reshape(-1, 3)
        found = self.model.predict(torch.from_numpy(cells))
        assert found.std is not None
        mean, std = (values.T.reshape(-1, len(y), len(x)) for values in (found.mean, found.std))
        return RssiMaps(x, y, height, Prediction(mean, std))

    def coloured(self, selection: MapSelection) -> ColouredMap:
        """Return values and colours of the selected map."""
        maps, receiver = self.maps(selection.height), selection.receiver
        match selection.kind:
            case "RSSI":
                measured = self.floor.rssi_dbm[np.isfinite(self.floor.rssi_dbm)]
                predicted = maps.rssi.mean.numpy()
                low, high = np.percentile(measured if len(measured) else predicted, (1, 99)).tolist()
                return ColouredMap(predicted[receiver], "viridis", low, high, "predicted RSSI [dBm]")
            case "interval":
                high = float(np.percentile(maps.width, 99))
                return ColouredMap(maps.width[receiver], "magma", 0.0, high, f"width of the {LEVEL:.0%} interval [dB]")
            case "coverage":
                return ColouredMap(np.where(self._covered(selection), 0.7, np.nan), "GnBu", 0.0, 1.0, "")
            case "best receiver":
                values = maps.best % N_RECEIVER_COLOURS + 0.5
                return ColouredMap(values, RECEIVER_COLOURS, 0, N_RECEIVER_COLOURS, "")

    def _covered(self, selection: MapSelection) -> NDArray[np.bool_]:
        rssi = self.maps(selection.height).rssi
        return (probability_above(rssi, selection)[selection.receiver] >= selection.certainty).numpy()

    def sentence(self, selection: MapSelection) -> str:
        """Describe the selected map in a sentence."""
        name = self.receivers[selection.receiver]
        match selection.kind:
            case "RSSI":
                dots = np.isfinite(self.floor.rssi_dbm[:, selection.receiver]).any()
                return f"Predicted RSSI of {name}{'; dots: measured, in the same colours' if dots else ''}."
            case "interval":
                return f"Width of the {LEVEL:.0%} interval of a measurement at {name}."
            case "coverage":
                return (
                    f"{self._covered(selection).mean():.0%} of the map is coloured: there a measurement at {name} is above "
                    f"{selection.threshold:g} dBm with {selection.certainty:.0%} certainty, if it is detected at all."
                )
            case "best receiver":
                best = self.maps(selection.height).best
                counts = np.bincount(best.ravel(), minlength=len(self.receivers))
                first = int(counts.argmax())
                fraction = counts[first] / best.size
                return f"Receiver with the highest prediction: {self.receivers[first]} on {fraction:.0%} of the map."

    def at(self, selection: MapSelection, x: float, y: float) -> Prediction:
        """Return the predictions of all receivers (R,) at a position [m], at the height of the selected map."""
        found = self.model.predict(torch.tensor([[x, y, selection.height]], dtype=torch.float64))
        assert found.std is not None
        return Prediction(found.mean[0], found.std[0])

    def describe(self, selection: MapSelection, x: float, y: float) -> str:
        """Describe the predictions at a position [m] in lines of text."""
        rssi, r = self.at(selection, x, y), selection.receiver
        mean, (low, high) = rssi.mean, rssi.interval(LEVEL)
        lines = [
            f"at {x:.2f}, {y:.2f} m",
            f"{self.receivers[r]}: {mean[r]:.1f} dBm, {LEVEL:.0%} of measurements in [{low[r]:.1f}, {high[r]:.1f}] dBm",
        ]
        if selection.kind == "coverage":
            lines.append(f"above {selection.threshold:g} dBm with {probability_above(rssi, selection)[r]:.0%}")
        if len(self.receivers) > 1:
            lines.append(f"best receiver: {self.receivers[int(mean.argmax())]}, {mean.max():.1f} dBm")
        return "\n".join(lines)

    def table(self, selection: MapSelection) -> str:
        """Return the selected map as comma-separated values, a row a cell."""
        maps, r = self.maps(selection.height), selection.receiver
        low, high = maps.rssi.interval(LEVEL)
        x, y = np.meshgrid(maps.x.round(4), maps.y.round(4))
        columns = {"predicted_dbm": maps.rssi.mean[r], "low_dbm": low[r], "high_dbm": high[r]}
        table = pd.DataFrame(
            {
                "x_m": x.ravel(),
                "y_m": y.ravel(),
                "z_m": selection.height,
                "receiver": self.receivers[r],
                **{name: values.double().numpy().ravel().round(2) for name, values in columns.items()},
                f"above_{selection.threshold:g}_dbm_with_{selection.certainty:.0%}": self._covered(selection)
                .ravel()
                .astype(int),
                "best_receiver": np.array(self.receivers)[maps.best.ravel()],
            }
        )
        return as_table(table.to_dict("records"))

    def picture(self, selection: MapSelection) -> bytes:
        """Return the selected map as PNG with axes and legend."""
        coloured, corners = self.coloured(selection), self.maps(selection.height).corners
        width, height = self.plan().size
        figure, (ax,) = figures.new_figure(1, 1, 8, 1 + 7 * height / width)
        if self.floor.plan:
            ax.imshow(self.floor.plan[0], extent=self.floor.plan[1], zorder=0)
        drawn = ax.imshow(
            coloured.values,
            origin="lower",
            extent=corners,
            cmap=coloured.colours,
            vmin=coloured.low,
            vmax=coloured.high,
            alpha=0.75 if self.floor.plan else 1.0,
            zorder=1,
        )
        for number, (x, y) in enumerate(self.floor.receiver[:, :2]):
            if number == selection.receiver or selection.kind == "best receiver":
                ax.plot(x, y, "x", color=RECEIVER_MARK, markersize=9, markeredgewidth=2)
                ax.annotate(figures.short(self.receivers[number]), (x, y), (6, 6), textcoords="offset points")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=corners[:2], ylim=corners[2:])
        ax.grid(visible=False)
        title = textwrap.fill(f"{self.sentence(selection)} Height {selection.height:.2f} m.", figures.LONGEST)
        ax.set_title(figures.plain(title), fontsize=8)
        if coloured.label:
            figure.colorbar(drawn, ax=ax, label=coloured.label, fraction=0.04, pad=0.02)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=150)
        return stream.getvalue()


def probability_above(rssi: Prediction, selection: MapSelection) -> Tensor:
    """Return the probability that a measurement exceeds the threshold, of the shape of the prediction."""
    assert rssi.std is not None
    return torch.special.ndtr((rssi.mean - selection.threshold) / rssi.std.clamp_min(MIN_STD_DB))
