"""Maps of the RSSI report: prediction and uncertainty of a receiver, and of the best server."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from swiftwrf.plotting import corners_of
from swiftwrf.rssi import LEVEL
from tasks.page import figures, maps
from tasks.page.page import Plot
from tasks.rssi.page.summary import RssiRecords

MAX_MAPS = 24  # receivers with a map in the report; all are in the tables
MAX_VECTOR_DOTS = 300  # more dots become an image: the page would grow to megabytes
MAX_WIDTH_DB = 30.0  # end of the scale of interval widths, the same in all reports
COVERED_DBM, CERTAINTY = -75.0, 0.9  # coverage of the summary
RECEIVER = "#cf4a4a"
WIDTH_PER_STD = 2 * NormalDist().inv_cdf((1 + LEVEL) / 2)
CAPTION = (
    "Left: predicted RSSI. Right: width of the {level:.0%} interval of a measurement, on a scale from 0 to {most:g} dB that "
    "is the same in all reports. Hatched: outside the measured positions, where predictions are extrapolated."
)


@dataclass(frozen=True)
class Maps:
    """Maps of one run.

    Args:
        run: Records of the run.
    """

    run: RssiRecords

    @cached_property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Content of `maps.npz`."""
        return self.run.arrays("maps")

    @property
    def names(self) -> list[str]:
        """Names of the receivers."""
        return [str(name) for name in self.arrays["receiver_names"]]

    @cached_property
    def best(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Prediction [dBm] and width of its interval [dB] of the receiver with the highest prediction in each cell."""
        server = self.arrays["predicted"].argmax(axis=0)[None]
        predicted, width = (np.take_along_axis(self.arrays[kind], server, 0)[0] for kind in ("predicted", "width"))
        return predicted, width

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """True for each cell inside the measured positions, (H, W)."""
        at = np.stack(np.meshgrid(self.arrays["x"], self.arrays["y"]), axis=-1)
        return maps.inside(at, self.arrays["measured_position"])

    @property
    def covered(self) -> float:
        """Fraction of the cells inside where a measurement at the best server is above `COVERED_DBM` with `CERTAINTY`."""
        predicted, width = self.best
        lower = predicted - NormalDist().inv_cdf(CERTAINTY) * width / WIDTH_PER_STD
        return float((lower >= COVERED_DBM)[self.inside].mean()) if self.inside.any() else float("nan")

    @property
    def most_detected(self) -> list[int]:
        """Receivers with a map, those that detected most rows, ascending."""
        detected = (~np.isnan(self.arrays["measured"])).sum(axis=0)
        return sorted(np.argsort(-detected, kind="stable")[:MAX_MAPS].tolist())

    def summary(self) -> Plot:
        """Return map and uncertainty of the only receiver, or of the best server."""
        several = len(self.names) > 1
        predicted, width = self.best
        receiver = None if several else 0
        title = "best server" if several else self.names[0]
        panels = [self._panel(predicted, "predicted", title, receiver), self._panel(width, "width", title, receiver)]
        caption = CAPTION.format(level=LEVEL, most=MAX_WIDTH_DB) + (
            " The best server is the receiver with the highest prediction; crosses mark receivers."
            if several
            else " Dots: training measurements in the colours of the map; the cross marks the receiver."
        )
        data = self._cells({"predicted_dbm": predicted[None], "width_db": width[None]}, [title])
        return Plot("summary", panels, caption, data)

    def by_receiver(self) -> list[Plot]:
        """Return maps of the receivers that detected most rows: predictions, and widths of intervals."""
        shown = self.most_detected
        names = [self.names[i] for i in shown]
        data = self._cells(
            {"predicted_dbm": self.arrays["predicted"][shown], "width_db": self.arrays["width"][shown]}, names
        )
        plots = []
        for kind, what in (("predicted", "Predicted RSSI"), ("width", f"Width of the {LEVEL:.0%} interval")):
            panels = [self._panel(self.arrays[kind][i], kind, self.names[i], i, 3.6) for i in shown]
            caption = f"{what} at each receiver. Hatched: outside the measured positions. A cross marks the receiver."
            name = "map" if kind == "predicted" else "width"
            plots.append(Plot(f"{name}-{self.run.file_name}", panels, caption, data))
        return plots

    def _panel(self, values: NDArray[Any], kind: str, title: str, receiver: int | None, width: float = 4.6) -> Figure:
        """Draw one map, with the measurements of a receiver, or with all receivers for None."""
        a = self.arrays
        x0, x1, y0, y1 = corners_of(a["x"], a["y"])
        shape = (y1 - y0) / (x1 - x0)
        figure, ax = figures.panel(width, 0.8 + (width - 1.2) * float(np.clip(shape, 0.4, 1.6)))
        limits, colours = ((0.0, MAX_WIDTH_DB), "magma") if kind == "width" else (self._limits, "viridis")
        if kind == "predicted" and receiver is None:
            limits = (float(values.min()), float(values.max()))
        plan = (a["plan"], tuple(a["plan_extent"].tolist())) if "plan" in a else None
        known = a["measured_position"]
        drawn = maps.draw(ax, a["x"], a["y"], values, colours=colours, limits=limits, known=known, plan=plan)
        if receiver is not None and kind == "predicted":
            detected = ~np.isnan(a["measured"][:, receiver])
            style: dict[str, Any] = {"cmap": colours, "vmin": limits[0], "vmax": limits[1], "zorder": 3}
            style |= {"edgecolors": "white", "linewidths": 0.4, "rasterized": detected.sum() >= MAX_VECTOR_DOTS}
            ax.scatter(known[detected, 0], known[detected, 1], s=9, c=a["measured"][detected, receiver], **style)
        for number, at in enumerate(a["receiver"]):
            if receiver in (None, number) and np.isfinite(at).all():
                for size, colour in ((4.5, "#fffffd"), (2.0, RECEIVER)):
                    ax.plot(*at[:2], "x", color=colour, markersize=8, markeredgewidth=size, zorder=4)
        ax.set_title(figures.short(title), fontsize=9)
        label = "interval width [dB]" if kind == "width" else "predicted RSSI [dBm]"
        extend = "max" if kind == "width" else "both"
        figures.colour_bar(ax, drawn, label, extend)
        return figure

    @cached_property
    def _limits(self) -> tuple[float, float]:
        low, high = np.nanpercentile(self.arrays["measured"], (1, 99)).tolist()
        return low, high

    def _cells(self, fields: dict[str, NDArray[Any]], receivers: list[str]) -> DataFrame:
        """Return one row for each cell and receiver."""
        a = self.arrays
        names, ys, xs = (each.ravel() for each in np.meshgrid(receivers, a["y"], a["x"], indexing="ij"))
        origin = GeodeticOrigin(*a["origin"].tolist()) if "origin" in a else None
        degrees = {name: value.round(7) for name, value in degree_columns(origin, np.stack([xs, ys], axis=1)).items()}
        columns = {"receiver": names, "x_m": xs.round(3), "y_m": ys.round(3)} | degrees
        columns |= {name: values.ravel().round(2) for name, values in fields.items()}
        columns["inside"] = np.tile(self.inside.ravel(), len(receivers))
        return DataFrame(columns)
