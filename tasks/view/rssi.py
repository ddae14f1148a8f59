"""RSSI anywhere: maps of a fitted model, where it is above a threshold, and who hears best; nothing of how it is shown."""

from __future__ import annotations

import io
import textwrap
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr

from swiftwrf import RssiModel
from swiftwrf.rssi import LEVEL
from tasks.page import figures
from tasks.records import as_table
from tasks.view.floor import DEVIATIONS, Floor, Maps
from tasks.view.plan import Plan

CELLS = 120  # of a map, along its longer side
RECEIVER_COLOURS, MOST_COLOURS = "tab20", 20
Kind = Literal["RSSI", "interval", "coverage", "best receiver"]


@dataclass(frozen=True)
class Shown:
    """What a map shows.

    Args:
        kind: predicted RSSI, the width of its interval, where RSSI is above the threshold, or who hears best.
        receiver: its number, counted from 0; the best-receiver map is of all.
        height: of the transmitter [m].
        threshold: [dBm].
        certainty: with which a measurement must be above the threshold, in (0, 1).
    """

    kind: Kind
    receiver: int
    height: float
    threshold: float = -75.0
    certainty: float = 0.9


@dataclass(frozen=True)
class Layer:
    """Values of a map and how they are coloured.

    Args:
        values: (len(y), len(x)), nan where nothing is drawn.
        colours: name of a colour map.
        low, high: values of its ends.
        label: what they are, with the unit; empty where the colours are names.
    """

    values: NDArray[np.floating]
    colours: str
    low: float
    high: float
    label: str


@dataclass(frozen=True)
class Heard:
    """What is expected at a place.

    Args:
        middle, low, high: prediction and its 80 % interval [dBm].
        above: probability that a measurement is above the threshold.
        best: number of the receiver with the highest prediction, and that [dBm].
    """

    middle: float
    low: float
    high: float
    above: float
    best: tuple[int, float]


@dataclass(frozen=True, eq=False)
class RssiScene:
    """What can be looked at.

    Args:
        title: of the page.
        model: fitted.
        floor: where it was.
    """

    title: str
    model: RssiModel
    floor: Floor
    _kept: dict[str, Maps] = field(default_factory=dict)

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names."""
        return self.model.receiver_names

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Maps that there are: the best receiver of one is no map."""
        kinds: tuple[Kind, ...] = get_args(Kind)
        return kinds if len(self.receivers) > 1 else kinds[:-1]

    @property
    def heights(self) -> tuple[float, float, float]:
        """The lowest, the median and the highest of the transmitter [m]."""
        low, middle, high = np.quantile(self.floor.measured[:, 2], (0, 0.5, 1)).tolist()
        return low, middle, high

    def plan(self, most: tuple[int, int] = (CELLS, CELLS)) -> Plan:
        """Of all that is known of the floor, in at most so many pixels."""
        corners = np.array(self.floor.plan[1]).reshape(2, 2).T if self.floor.plan else self.floor.measured
        return Plan.around(self.floor.measured, self.floor.receiver, corners, most=most)

    def maps(self, height: float) -> Maps:
        """Predictions at a height [m]; the last ones are kept."""
        kept = self._kept.get("last")
        if kept is None or kept.height != height:
            kept = self._kept["last"] = self._predicted(height)
        return kept

    def _predicted(self, height: float) -> Maps:
        plan = self.plan()
        share = [(np.arange(cells) + 0.5) / cells for cells in plan.size]
        x, y = (plan.low[axis] + share[axis] * (plan.high - plan.low)[axis] for axis in (0, 1))
        at = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], axis=-1).reshape(-1, 3)
        predicted = self.model.predict(torch.from_numpy(at))
        return Maps(x, y, height, *(p.T.reshape(-1, len(y), len(x)).numpy() for p in predicted))

    def layer(self, shown: Shown) -> Layer:
        """What the map is drawn from."""
        maps = self.maps(shown.height)
        match shown.kind:
            case "RSSI":
                known = self.floor.rssi_dbm[np.isfinite(self.floor.rssi_dbm)]
                low, high = np.percentile(known if len(known) else maps.middle, (1, 99)).tolist()
                return Layer(maps.middle[shown.receiver], "viridis", low, high, "predicted RSSI [dBm]")
            case "interval":
                width = maps.width[shown.receiver]
                high = float(np.percentile(maps.width, 99))
                return Layer(width, "magma", 0.0, high, f"width of the {LEVEL:.0%} interval [dB]")
            case "coverage":
                above = maps.assured(shown.certainty)[shown.receiver] >= shown.threshold
                return Layer(np.where(above, 0.7, np.nan), "GnBu", 0.0, 1.0, "")
            case "best receiver":
                return Layer(maps.best % MOST_COLOURS + 0.5, RECEIVER_COLOURS, 0, MOST_COLOURS, "")

    def sentence(self, shown: Shown) -> str:
        """What the map says, in words."""
        name, maps = self.receivers[shown.receiver], self.maps(shown.height)
        match shown.kind:
            case "RSSI":
                dots = np.isfinite(self.floor.rssi_dbm[:, shown.receiver]).any()
                return f"RSSI of {name} as predicted{'; dots: measured, in the same colours' if dots else ''}."
            case "interval":
                return f"How far apart the ends of the {LEVEL:.0%} interval of a measurement at {name} lie."
            case "coverage":
                share = float((maps.assured(shown.certainty)[shown.receiver] >= shown.threshold).mean())
                return (
                    f"{share:.0%} of the map is coloured: there a measurement at {name} is above {shown.threshold:g} dBm "
                    f"with {shown.certainty:.0%} certainty, if it is heard at all."
                )
            case "best receiver":
                shares = np.bincount(maps.best.ravel(), minlength=len(self.receivers)) / maps.best.size
                first = int(shares.argmax())
                return f"Who hears best, as predicted: {self.receivers[first]} on {shares[first]:.0%} of the map."

    def heard(self, shown: Shown, x: float, y: float) -> Heard:
        """What is expected at a place [m], at the height of the map."""
        at = torch.tensor([[x, y, shown.height]], dtype=torch.float64)
        predicted = self.model.predict(at)
        middle, low, high = (float(p[0, shown.receiver]) for p in predicted)
        deviation = (high - low) / (2 * DEVIATIONS)
        above = float(ndtr((middle - shown.threshold) / max(deviation, 1e-6)))
        best = int(predicted[0][0].argmax())
        return Heard(middle, low, high, above, (best, float(predicted[0][0, best])))

    def table(self, shown: Shown) -> str:
        """The map as comma-separated values, a row a cell."""
        maps, r = self.maps(shown.height), shown.receiver
        above = maps.assured(shown.certainty)[r] >= shown.threshold
        rows = [
            {
                "x_m": round(x, 4),
                "y_m": round(y, 4),
                "z_m": shown.height,
                "receiver": self.receivers[r],
                "predicted_dbm": round(float(maps.middle[r, i, j]), 2),
                "low_dbm": round(float(maps.low[r, i, j]), 2),
                "high_dbm": round(float(maps.high[r, i, j]), 2),
                f"above_{shown.threshold:g}_dbm_with_{shown.certainty:.0%}": int(above[i, j]),
                "best_receiver": self.receivers[maps.best[i, j]],
            }
            for i, y in enumerate(maps.y.tolist())
            for j, x in enumerate(maps.x.tolist())
        ]
        return as_table(rows)

    def picture(self, shown: Shown) -> bytes:
        """The map as a PNG with axes and legend."""
        layer, maps = self.layer(shown), self.maps(shown.height)
        width, height = self.plan().size
        figure, (ax,) = figures.new_figure(1, 1, 8, 1 + 7 * height / width)
        extent = maps.corners
        if self.floor.plan:
            ax.imshow(self.floor.plan[0], extent=self.floor.plan[1], zorder=0)
        drawn = ax.imshow(
            layer.values,
            origin="lower",
            extent=extent,
            cmap=layer.colours,
            vmin=layer.low,
            vmax=layer.high,
            alpha=0.75 if self.floor.plan else 1.0,
            zorder=1,
        )
        for number, (x, y) in enumerate(self.floor.receiver[:, :2]):
            if number == shown.receiver or shown.kind == "best receiver":
                ax.plot(x, y, "x", color="#ee6677", markersize=9, markeredgewidth=2)
                ax.annotate(figures.short(self.receivers[number]), (x, y), (6, 6), textcoords="offset points")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=extent[:2], ylim=extent[2:])
        ax.grid(visible=False)
        title = textwrap.fill(f"{self.sentence(shown)} Height {shown.height:.2f} m.", figures.LONGEST)
        ax.set_title(figures.plain(title), fontsize=8)
        if layer.label:
            figure.colorbar(drawn, ax=ax, label=layer.label, fraction=0.04, pad=0.02)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=150)
        return stream.getvalue()
