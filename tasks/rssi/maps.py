"""Maps of the RSSI report: prediction and uncertainty of a receiver, and of the best receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf.data.coordinates import GeodeticOrigin, degree_columns
from swiftwrf.metrics import HALF_WIDTH, LEVEL
from swiftwrf.models.prediction import difference_unit
from swiftwrf.plotting import corners_of, hatch
from swiftwrf.rssi.coverage import CLASSES, classified
from tasks.labels import COVERAGE
from tasks.page import figures, maps
from tasks.page.page import Plot
from tasks.records import Records, Row, file_columns

MAX_MAPS = 30  # of receivers, in a report of several floors; all are in the tables, and on the page of swiftwrf view
FIRST_MAPS = 6  # of the receivers of a floor that are not folded
MAX_SPOTS = 5  # weak spots of a floor with a number on its map
MAX_WIDTH_DB = 30.0  # end of the scale of interval widths of the page
MAX_RATIO = 12.0  # of the sides of a map that is to scale; one of a corridor would be a line
MIN_RATIO = 1.2  # of the widest interval inside to the median one, for which the widths are drawn
RECEIVER = "#cf4a4a"
WIDTH_PER_STD = 2 * HALF_WIDTH  # of the interval of a normal variable


@dataclass(frozen=True)
class Maps:
    """Maps of one floor of a run, by its number; 0 in data without floors."""

    run: Records
    floor: int = 0

    @classmethod
    def of_floors(cls, run: Records) -> list[Maps]:
        """Return the maps of each floor that was measured, from below."""
        return [cls(run, int(floor)) for floor in np.unique(run.arrays("maps")["floor_of_row"])]

    @cached_property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Content of `maps.npz` for this floor."""
        found = dict(self.run.arrays("maps"))
        rows = found["floor_of_row"] == self.floor
        of_floor = ("predicted", "width", "detection", "above", "inside", "known")
        found |= {name: found[name][self.floor] for name in of_floor}
        return found | {name: found[name][rows] for name in ("measured_position", "measured")}

    @cached_property
    def plan(self) -> maps.FloorPlan | None:
        """Image of the floor. None if the run has none."""
        return maps.FloorPlan.load(self.run.folder)

    def titled(self, title: str) -> str:
        """Return a title with the name of the floor, if there are several."""
        return f"{title}, {self.arrays['floor_names'][self.floor]}" if self.suffix else title

    @property
    def name(self) -> str:
        """Name of the floor, in sentences."""
        name = str(self.arrays["floor_names"][self.floor])
        return name if "floor" in name.lower() else f"floor {name}"

    @property
    def place(self) -> str:
        """Name of the measured area, in sentences."""
        return f"the measured area of {self.name}" if self.suffix else "the measured area"

    @property
    def coverage(self) -> Row:
        """Result of `Coverage.values` for this floor."""
        found: Row = self.run.metrics["coverage"][self.floor]
        return found

    @property
    def has_coverage(self) -> bool:
        """True if receivers stay where they are, so that a scan may have one of them."""
        return self.coverage["n_scans"] is not None

    @property
    def suffix(self) -> str:
        """End of the names of files of this floor, if there are several."""
        return "" if len(self.arrays["floor_names"]) == 1 else f"-{self.floor}"

    @property
    def quantity(self) -> str:
        """Predicted quantity: RSSI, or another one."""
        return str(self.run.metrics.get("quantity", "RSSI"))

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return str(self.run.metrics.get("unit", "dBm"))

    @property
    def direction(self) -> str:
        """Side of the threshold that is covered: "above", or "below" where smaller is better."""
        return str(self.coverage.get("direction", "above"))

    @property
    def is_below(self) -> bool:
        """True where smaller is better."""
        return self.direction == "below"

    @property
    def limit(self) -> str:
        """First threshold with its direction, in sentences."""
        return f"{self.direction} {self.coverage['threshold_dbm']:g} {self.unit}"

    @property
    def who(self) -> str:
        """Receivers that count for the coverage, in sentences."""
        return f"one of {len(self.names)} receivers" if len(self.names) > 1 else self.names[0]

    @property
    def measurement(self) -> str:
        """Name of the values that the coverage counts."""
        return "detected packet" if self.unit == "dBm" else "measurement"

    @property
    def error_unit(self) -> str:
        """Unit of differences of the values."""
        return difference_unit(self.unit)

    def amount(self, difference: float) -> str:
        """Return a difference of values with its unit, in dB without decimals."""
        return f"{difference:.0f} dB" if self.error_unit == "dB" else f"{difference:.2g} {self.error_unit}"

    @property
    def names(self) -> list[str]:
        """Names of the receivers."""
        return [str(name) for name in self.arrays["receiver_names"]]

    @cached_property
    def best(self) -> dict[str, NDArray[Any]]:
        """Prediction [dBm], width of its interval [dB] and detection at the best receiver in each cell."""
        predicted = self.arrays["predicted"]
        server = (predicted.argmin(axis=0) if self.is_below else predicted.argmax(axis=0))[None]
        kinds = ("predicted", "width", "detection")
        return {kind: np.take_along_axis(self.arrays[kind], server, 0)[0] for kind in kinds}

    @property
    def hatched(self) -> str:
        """Legend of the hatches."""
        reach = self.coverage["reach_m"]
        far = "" if reach is None else f" or more than {reach:.1f} m from any scan"
        if self.unit != "dBm":
            return f"Hatched: not measured, outside the scans{far}."
        return f"Hatched like /: not measured, outside the scans{far}; like \\: a packet is more likely lost than received."

    @property
    def classes(self) -> NDArray[np.int64]:
        """Number in `CLASSES` of each cell, at the first threshold."""
        return classified(self.arrays["above"], self.arrays["known"], self.coverage["certainty"])

    @property
    def spots(self) -> list[Row]:
        """Weak spots of this floor at the first threshold, the first ones those without any coverage."""
        here = str(self.arrays["floor_names"][self.floor]) if self.suffix else None
        return [
            spot
            for spot in self.run.table("weak_spots").to_dict("records")
            if spot["threshold_dbm"] == self.coverage["threshold_dbm"] and here in (None, spot["floor"])
        ]

    def covered(self, width: float = 4.6) -> Figure:
        """Draw the classes of coverage, the scans and the first weak spots by their numbers."""
        a, classes = self.arrays, self.classes
        figure, ax, (extent, aspect) = self._axes(width, legend=0.45)
        style: dict[str, Any] = {"cmap": maps.CLASS_COLOURS, "vmin": 0, "vmax": len(CLASSES) - 1}
        style |= {"alpha": 1.0 if self.plan is None else 0.75, "interpolation": "none", "zorder": 1}
        ax.imshow(classes, origin="lower", extent=extent, aspect=aspect, **style)
        many = len(a["measured_position"]) >= figures.MAX_VECTOR_MARKS
        ax.plot(*a["measured_position"][:, :2].T, ".", color="#000001", markersize=1.2, rasterized=many, zorder=2)
        self._mark_receivers(ax, None)
        style = {"fontsize": 8, "color": "#000001", "ha": "center", "va": "center", "zorder": 5}
        style["bbox"] = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "linewidth": 0.6}
        for rank, spot in enumerate(self.spots[:MAX_SPOTS], start=1):
            ax.text(spot["x_m"], spot["y_m"], str(rank), **style)
        shares = {name: self.coverage[name.replace(" ", "_")] for name in reversed(CLASSES)}
        patches = [
            Patch(color=COVERAGE[name], label=name if share is None or name == CLASSES[0] else f"{name} {share:.0%}")
            for name, share in shares.items()
        ]
        figure.legend(handles=patches, loc="outside lower center", ncols=2, frameon=False)
        if self.suffix:
            ax.set_title(figures.short(self.name), fontsize=10)
        return figure

    @classmethod
    def coverage_plot(cls, floors: Sequence[Maps]) -> Plot:
        """Return the map of coverage of each floor of a run."""
        first = floors[0]
        found = first.coverage
        far = "" if found["reach_m"] is None else f", or farther than {found['reach_m']:.1f} m from any"
        caption = (
            f"Coverage: a {first.measurement.split()[-1]} at {first.who} is {first.limit} with a probability of at least "
            f"{found['certainty']:.0%} (covered), of at most {1 - found['certainty']:.0%} (not covered), or between them "
            f"(uncertain). Percentages are of the measured area. Grey: not between the scans (dots){far}. Numbers: weak "
            "spots of the table. Crosses: receivers."
        )
        names = np.array(CLASSES)
        data = [
            maps._cells({"above": maps.arrays["above"][None]}, [maps.titled("coverage")]).assign(
                coverage=names[maps.classes.ravel()]
            )
            for maps in floors
        ]
        width = 4.6 if len(floors) > 1 else 5.8
        return Plot("coverage", [maps.covered(width) for maps in floors], caption, concat(data, ignore_index=True))

    def summary(self) -> Plot:
        """Return map and uncertainty of the only receiver, or of the best receiver."""
        several = len(self.names) > 1
        receiver = None if several else 0
        title = self.titled("best receiver" if several else self.names[0])
        kinds = ("predicted", "width") if self.varies else ("predicted",)
        panels = [self._panel(self.best, kind, title, receiver, 4.6 if self.varies else 5.4) for kind in kinds]
        widths = f"width of the {LEVEL:.0%} interval of a measurement"
        same = f"; the {widths} is about {self.amount(self.widest[3])} in the whole measured area"
        widths = f", and the {widths}" if self.varies else same
        caption = f"Predicted {self.quantity}{widths}. {self.hatched}" + (
            f" The best receiver has the {'lowest' if self.is_below else 'highest'} prediction; crosses mark receivers."
            if several
            else " Dots: training measurements in the colours of the map, hollow where nothing was received; the cross "
            "marks the receiver."
        )
        fields = self.best | {"above": self.arrays["above"]}
        data = self._cells({kind: values[None] for kind, values in fields.items()}, [title])
        return Plot(f"summary{self.suffix}", panels, caption, data)

    def by_receiver(self, kind: str, first: bool = True) -> Plot | None:
        """Return maps of the receivers that are strongest in the measured area: "predicted", or "width" of the intervals.

        The `first` ones are those that are not folded. Widths are drawn where they vary. None if nothing is drawn.
        """
        a = self.arrays
        strength = a["predicted"][:, a["known"] if a["known"].any() else ...].reshape(len(self.names), -1).mean(axis=1)
        strongest = np.argsort(strength if self.is_below else -strength, kind="stable").tolist()
        most = max(FIRST_MAPS, MAX_MAPS // len(a["floor_names"]))
        shown = strongest[:FIRST_MAPS] if first else strongest[FIRST_MAPS:most]
        if kind == "width":
            shown = [i for i in shown if self._varies(a["width"][i])]
        if not shown:
            return None
        names, fields = [self.names[i] for i in shown], ("predicted", "width", "detection")
        data = self._cells({name: a[name][shown] for name in fields}, names)
        values = [{name: a[name][i] for name in fields} for i in shown]
        panels = [self._panel(each, kind, self.names[i], i, 3.6) for each, i in zip(values, shown, strict=True)]
        figures.align(panels)
        what = f"Predicted {self.quantity}" if kind == "predicted" else f"Width of the {LEVEL:.0%} interval"
        best = "strongest" if self.unit == "dBm" else "best"
        which = f"the {len(shown)} {best} of {len(self.names)} receivers" if first else "the next ones"
        if kind == "width":
            which = f"those of the {min(FIRST_MAPS, len(self.names))} {best} receivers whose width varies"
        caption = f"{what} at {which}. {self.hatched} Hollow dots: nothing was received. A cross marks the receiver."
        name = ("map" if kind == "predicted" else "width") + ("" if first else "-more")
        return Plot(f"{name}-{self.run.file_name}{self.suffix}", panels, caption, data)

    def _axes(self, width: float, legend: float = 0.0) -> tuple[Figure, Axes, tuple[Any, Literal["equal", "auto"]]]:
        """Return a figure and axes of the floor above its plan, with the edges of the map and its aspect."""
        x0, x1, y0, y1 = extent = corners_of(self.arrays["x"], self.arrays["y"])
        shape = (y1 - y0) / (x1 - x0)
        aspect: Literal["equal", "auto"] = "equal" if 1 / MAX_RATIO <= shape <= MAX_RATIO else "auto"
        figure, ax = figures.panel(width, 0.8 + legend + (width - 1.2) * float(np.clip(shape, 0.4, 1.6)))
        if (plan := self.plan) is not None:
            plan.draw(ax)
        ax.set(xlabel="x [m]", ylabel="y [m]")
        ax.grid(visible=False)
        return figure, ax, (extent, aspect)

    def _mark_receivers(self, ax: Axes, receiver: int | None) -> None:
        for number, at in enumerate(self.arrays["receiver"]):
            if receiver in (None, number) and np.isfinite(at).all():
                for size, colour in ((4.5, "#fffffd"), (2.0, RECEIVER)):
                    ax.plot(*at[:2], "x", color=colour, markersize=8, markeredgewidth=size, zorder=4)

    def _panel(
        self, fields: dict[str, NDArray[Any]], kind: str, title: str, receiver: int | None, width: float = 4.6
    ) -> Figure:
        """Draw one map, with the measurements of a receiver, or with all receivers for None."""
        a, values = self.arrays, fields[kind]
        figure, ax, (extent, aspect) = self._axes(width)
        limits, colours = (self._widths, "magma") if kind == "width" else (self._limits, "viridis")
        if kind == "predicted" and receiver is None:
            limits = (float(values.min()), float(values.max()))
        style: dict[str, Any] = {"cmap": colours, "vmin": limits[0], "vmax": limits[1]}
        opacity = 1.0 if self.plan is None else 0.75
        drawn = ax.imshow(values, origin="lower", extent=extent, alpha=opacity, zorder=1, aspect=aspect, **style)
        hatch(ax, a["x"], a["y"], ~a["known"])
        hatch(ax, a["x"], a["y"], fields["detection"] < 0.5, "\\\\\\\\")
        known = a["measured_position"]
        if receiver is not None and kind == "predicted":
            detected = ~np.isnan(a["measured"][:, receiver])
            ax.plot(*known[~detected, :2].T, "o", markersize=3, markerfacecolor="none", color="white", rasterized=True)
            style |= {"zorder": 3, "edgecolors": "white", "linewidths": 0.4, "rasterized": True}
            ax.scatter(known[detected, 0], known[detected, 1], s=9, c=a["measured"][detected, receiver], **style)
        self._mark_receivers(ax, receiver)
        ax.set_title(figures.short(title), fontsize=9)
        label = f"interval width [{self.error_unit}]" if kind == "width" else f"predicted {self.quantity} [{self.unit}]"
        figures.colour_bar(ax, drawn, label, "both")
        return figure

    @property
    def widest(self) -> tuple[float, float, float, float]:
        """Cell between the scans where the interval at the best receiver is widest: x, y [m], width, and median width [dB].

        The median is that of the measured cells, or of all if there are none.
        """
        return self._widest(self.best["width"])

    def _widest(self, width: NDArray[Any]) -> tuple[float, float, float, float]:
        a = self.arrays
        row, column = np.unravel_index(np.where(a["inside"], width, -np.inf).argmax(), width.shape)
        typical = np.median(width[a["known"] if a["known"].any() else ...])
        return float(a["x"][column]), float(a["y"][row]), float(width[row, column]), float(typical)

    @property
    def varies(self) -> bool:
        """True if the widths of the intervals inside the scans differ so much that a map shows it."""
        return self._varies(self.best["width"])

    def _varies(self, width: NDArray[Any]) -> bool:
        *_, widest, typical = self._widest(width)
        return widest >= MIN_RATIO * typical

    @cached_property
    def _widths(self) -> tuple[float, float]:
        low, high = np.quantile(self.arrays["width"], (0.01, 0.99)).tolist()
        return (float(np.floor(low)), float(np.ceil(high))) if high > 1 else (low, high)

    @cached_property
    def _limits(self) -> tuple[float, float]:
        measured = self.arrays["measured"]
        shown = self.arrays["predicted"] if np.isnan(measured).all() else measured  # nothing may be received on a floor
        low, high = np.nanpercentile(shown, (1, 99)).tolist()
        return low, high

    def _cells(self, fields: dict[str, NDArray[Any]], receivers: list[str]) -> DataFrame:
        """Return one row for each cell and receiver."""
        a = self.arrays
        names, ys, xs = (each.ravel() for each in np.meshgrid(receivers, a["y"], a["x"], indexing="ij"))
        origin = GeodeticOrigin(*a["origin"].tolist()) if "origin" in a else None
        degrees = {name: value.round(7) for name, value in degree_columns(origin, np.stack([xs, ys], axis=1)).items()}
        columns = {"receiver": names, "x_m": xs.round(3), "y_m": ys.round(3)} | degrees
        named = {"predicted": "predicted_dbm", "width": "width_db", "detection": "detection", "above": "above"}
        columns |= {named[name]: values.ravel().round(2) for name, values in fields.items()}
        columns["measured"] = np.tile(a["known"].ravel(), len(receivers))
        return DataFrame(columns).rename(columns=file_columns(self.run.metrics))
