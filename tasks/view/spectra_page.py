"""The page of spectra: a plan to drag the moving end in, and the spectrum there."""

from __future__ import annotations

import time

import numpy as np
from nicegui import events, run, ui
from numpy.typing import NDArray

from swiftwrf import AngularGrid, Spectra
from tasks.aoa.room import FIXED, MEASURED, in_plan
from tasks.aoa.synthesis import MAX_DIFFERENCE
from tasks.page.maps import colour_image
from tasks.view.charts import (
    Data,
    around,
    crosses,
    disc,
    dots,
    lines,
    named,
    paths,
    picture,
    pictures,
    points,
    rectangle,
    spectrum,
)
from tasks.view.page import Chart, NewestOnly, PlanChart, header, legend, located_data, located_layers, slider
from tasks.view.spectra import Direction, LoadedModel, PredictedSpectrum, SpectraView, angle_between, peak

UNSEEN, MOVING, PEAK, SIGHT = "#d1620f", "#cf4a4a", "#ffffff", "#ee6677"
KEY_STEP = 0.01  # of the plan; ten times as far with Shift
MAX_PLAN_PX = (500, 520)
MAX_LARGE_DOTS = 400
MIN_PATH_DB = -20.0  # of a path that is drawn, relative to the direct one, both without furniture
HIDDEN_DB = 6.0  # loss in furniture of paths that are drawn as hidden
MOVES = {
    "ArrowLeft": (0, -1),
    "ArrowRight": (0, 1),
    "ArrowDown": (1, -1),
    "ArrowUp": (1, 1),
    "PageDown": (2, -1),
    "PageUp": (2, 1),
}
KEYS = (
    f"(event) => {{ if ({list(MOVES)}.includes(event.key)) {{ event.preventDefault(); "
    "emit({key: event.key, shift: event.shiftKey}) } }"
)
HELP = "Drag in the plan, or click it and use the arrow keys (Shift: ten times as far); Page Up and Down: height."


class SpectrumChart:
    """One spectrum, coloured up to its highest value, and the directions marked in it."""

    def __init__(
        self, title: str, name: str, colours: str = "viridis", high: float = 1.0, extend: str = "neither"
    ) -> None:
        self._name, self._colours, self._high, self._extend = name, colours, high, extend
        with ui.column().classes("gap-0").style("max-width: 100%") as self.column:
            ui.label(title).classes("text-weight-medium")
            self.caption = ui.label().classes("quiet numbers")
            self._box = ui.element().classes("w-full")

    def lay_out(self, polar: bool) -> None:
        """Show spectra azimuth by elevation, or as seen along the normal of the array."""
        self._polar = polar
        self._box.clear()
        options = spectrum(polar, self._colours, self._high, self._extend, PEAK, SIGHT)
        size = "width: 330px; height: 300px" if polar else "width: 100%; height: 250px"
        self.column.style(f"width: {330 if polar else 850}px")
        with self._box:
            self._chart = Chart(self._name, options, f"{size}; max-width: 100%")

    def show(
        self,
        values: NDArray[np.floating],
        grid: AngularGrid,
        marks: tuple[Direction | None, Direction | None] = (None, None),
    ) -> None:
        """Show values (n_elevation, n_azimuth), a ring at the first direction and a cross at the second."""
        shown, corners = (disc(values, grid), (0, 1, 0, 1)) if self._polar else rectangle(values, grid)
        peak, sight = (self._mark(direction) for direction in marks)
        image = picture(colour_image(shown, self._colours, 0.0, self._high), corners)
        self._chart.show({"spectrum": image, "peak": peak, "sight": sight})

    def _mark(self, direction: Direction | None) -> Data:
        if direction is None:
            return []
        azimuth, elevation = direction[0] % 360, direction[1]
        return [[90 - elevation, azimuth]] if self._polar else [[azimuth, elevation]]


class SpectraPage:
    """The page for one visitor."""

    def __init__(self, view: SpectraView) -> None:
        self._view, self._model = view, view.models[0]
        self._position, self._shown_measurement = view.start.copy(), -1
        self._requests = NewestOnly(self._predict)
        self._low, self._high = view.box
        self._corners = around(self._low[None], self._high[None])
        with header(view.title, view.notes):
            self._build_controls()
        with ui.row().classes("w-full items-start gap-8 lg:flex-nowrap"):
            self._build_plan()
            with ui.row().classes("gap-x-8 gap-y-0 grow").style("max-width: 900px; min-width: min(100%, 20rem)"):
                self._predicted = SpectrumChart("Predicted", "synthesized")
                self._measured = SpectrumChart("Nearest measured", "measured")
                title = "Standard deviation of a measured spectrum"
                self._std = SpectrumChart(title, "deviation", "magma", MAX_DIFFERENCE, "max")
                ui.label("Ring: direction of the peak; cross: line of sight.").classes("quiet")
        self._lay_out()

    def _build_controls(self) -> None:
        titles = {number: loaded.title for number, loaded in enumerate(self._view.models)}
        if len(titles) > 1:
            choice = ui.select(titles, value=0, label="model", on_change=lambda e: self._choose(e.value))
            choice.props("dense options-dense outlined").style("min-width: 240px")
        else:
            ui.label(titles[0]).classes("quiet")
        self._locate = ui.switch("posterior", on_change=lambda: self._request(dragging=False)).props("id=locate")
        self._paths = ui.switch("paths", on_change=lambda: self._request(dragging=False)).props("id=paths")
        self._polar = ui.toggle({False: "rectangular", True: "polar"}, value=False, on_change=self._lay_out)
        self._polar.props("no-caps padding='2px 12px'")

    def _build_plan(self) -> None:
        with ui.column().classes("gap-1").style("width: 500px; max-width: 100%; flex: none"):
            size = 6 if self._view.data is None or len(self._view.data) < MAX_LARGE_DOTS else 4
            layers = [pictures("posterior"), dots("unseen", UNSEEN, size), dots("measured", MEASURED, size)]
            layers += [lines("walls"), lines("uncertain", kind="dashed"), crosses("fixed", FIXED), *located_layers()]
            layers += [lines("open", FIXED, 1.5), lines("hidden", FIXED, 1, "dotted")]
            layers += [lines("away", MOVING, 2), dots("moving", MOVING, 16)]
            self._plan = PlanChart("plan", self._corners, layers, MAX_PLAN_PX, self._on_pointer)
            self._plan.element.props("tabindex=0").on("keydown", self._on_key, js_handler=KEYS)
            low, middle, high = self._low[2].item(), self._position[2].item(), self._high[2].item()
            self._height = slider("height", low, high, middle, "m", self._on_height, step=0.01)
            self._where = ui.label().classes("numbers").props('id="where"')
            self._angles = ui.label().classes("numbers")
            self._located = ui.label().classes("numbers").props('id="located"')
            self._frame = ui.label().classes("quiet numbers").props('id="frame"')
            ui.html(legend(self._entries()), sanitize=False).classes("quiet")
            ui.label(HELP).classes("quiet")

    def _entries(self) -> list[tuple[str, str, str]]:
        """Return the entries of the legend: colour, symbol and text."""
        entries = [(MOVING, "●", self._view.moving)]
        if self._view.data is not None:
            entries += [(MEASURED, "●", "measured, in the training set")]
            entries += [(UNSEEN, "●", "measured, not in the training set")]
        if self._view.fixed is not None:
            entries.append((FIXED, "✕", "fixed end"))
        if any(loaded.planes for loaded in self._view.models):
            entries.append(("inherit", "━", "walls found, dashed where not identifiable"))
        if any(loaded.model.room is not None for loaded in self._view.models):
            entries.append((FIXED, "━", "strong paths, dotted where furniture hides them"))
        return entries

    def _choose(self, number: int) -> None:
        self._model = self._view.models[number]
        self._lay_out()

    def _lay_out(self) -> None:
        for chart in (self._predicted, self._measured, self._std):
            chart.lay_out(self._polar.value)
        self._shown_measurement = -1
        self._measured.column.set_visibility(self._view.data is not None)
        self._locate.set_visibility(self._view.data is not None and self._model.locator_file is not None)
        self._paths.set_visibility(self._model.model.room is not None)
        self._plan.show(self._background())
        self._request(dragging=False)

    def _background(self) -> dict[str, Data]:
        """Return the data of the layers that do not follow the moving end."""
        data, in_training = self._view.data, self._model.in_training
        found: dict[str, Data] = {"unseen": [], "measured": [], "fixed": [], "walls": [], "uncertain": []}
        if data is not None:
            trained = np.zeros(len(data), dtype=bool) if in_training is None else in_training
            found["unseen"], found["measured"] = points(data.position[~trained]), points(data.position[trained])
        for plane in self._model.planes:
            ends = in_plan(plane, self._low, self._high)
            if ends is not None and self._within(ends) == 0:
                found["walls" if plane["certain"] else "uncertain"] += paths([ends])
        if (fixed := self._view.fixed) is not None:  # at the edge with its distance if it lies outside of the plan
            x0, x1, y0, y1 = self._corners
            inside = np.clip(fixed[:2], (x0, y0), (x1, y1))
            beyond, side = self._within(fixed), "right" if inside[0] < (x0 + x1) / 2 else "left"
            found["fixed"] = [named(inside, f"{beyond:.1f} m beyond" if beyond else "", side, color=FIXED)]
        return found

    def _within(self, position: NDArray[np.floating]) -> float:
        """Return the distance [m] of positions (..., 2 or 3) from the plan, 0 inside."""
        x0, x1, y0, y1 = self._corners
        return float(np.linalg.norm(position[..., :2] - np.clip(position[..., :2], (x0, y0), (x1, y1))))

    def _on_pointer(self, kind: str, buttons: int, x: float, y: float) -> None:
        if kind == "pointerleave" or (kind == "pointermove" and not buttons & 1):
            return
        self._position[:2] = x, y
        self._request(dragging=kind != "pointerup")

    def _on_key(self, event: events.GenericEventArguments) -> None:
        x0, x1, y0, y1 = self._corners
        step = KEY_STEP * (10 if event.args["shift"] else 1) * max(x1 - x0, y1 - y0)
        axis, sign = MOVES[event.args["key"]]
        if axis == 2:
            self._height.value = float(np.clip(self._height.value + sign * step, self._low[2], self._high[2]))
            return
        self._position[axis] = np.clip(self._position[axis] + sign * step, (x0, y0)[axis], (x1, y1)[axis])
        self._request(dragging=False)

    def _on_height(self, event: events.ValueChangeEventArguments[float | None]) -> None:
        if event.value is not None:
            self._position[2] = event.value
            self._request(dragging=False)

    def _request(self, dragging: bool) -> None:
        self._requests.submit(self._position.copy(), dragging)

    async def _predict(self, position: NDArray[np.floating], dragging: bool) -> None:
        began, loaded = time.perf_counter(), self._model
        predicted = await run.io_bound(self._view.predict, loaded, position, dragging)
        if predicted is not None and loaded is self._model:  # None while the server is being ended
            self._show(predicted)
            self._describe(predicted, time.perf_counter() - began)
        await self._show_located(loaded, position, dragging)
        await self._show_paths(loaded, position, dragging)
        if not dragging:
            await run.io_bound(lambda: loaded.drag_grid)  # found before the pointer begins to drag

    async def _show_located(self, loaded: LoadedModel, position: NDArray[np.floating], dragging: bool) -> None:
        """Show the posterior of the nearest measured spectrum; while dragging, only its removal."""
        image: Data = []
        located, described = None, ""
        if not dragging and self._locate.value and self._view.data is not None and loaded.locator_file is not None:
            index, _ = self._view.nearest(position)
            self._located.set_text("The nearest measured spectrum is being located.")
            located = await run.io_bound(self._view.located, loaded, index)
            if located is None or loaded is not self._model:
                return
            image = picture(colour_image(located.density.values[::-1], "magma"), located.density.corners, 0.8)
            described = f"Posterior of spectrum {int(self._view.data.index[index])}: {located.describe()}"
        self._plan.show({"posterior": image} | located_data(located))
        self._located.set_text(described)

    async def _show_paths(self, loaded: LoadedModel, position: NDArray[np.floating], dragging: bool) -> None:
        """Show the strong paths between the ends of the link; while dragging, only their removal."""
        found: dict[str, Data] = {"open": [], "hidden": []}
        if not dragging and self._paths.value and loaded.model.room is not None:
            there = await run.io_bound(loaded.model.room.paths, position)
            if there is None or loaded is not self._model:
                return
            strong = there[there.level_db + there.hidden_db > MIN_PATH_DB]
            is_hidden = strong.hidden_db > HIDDEN_DB
            found = {"open": paths(strong.points[~is_hidden]), "hidden": paths(strong.points[is_hidden])}
        self._plan.show(found)

    def _show(self, predicted: PredictedSpectrum) -> None:
        grid = predicted.grid
        self._predicted.show(predicted.mean, grid, (predicted.peak, predicted.line_of_sight))
        outside = self._view.extrapolates(predicted.position)
        self._predicted.column.classes(**{"add" if outside else "remove": "extrapolated"})
        where = "outside the measured positions, extrapolated; " if outside else ""
        self._predicted.caption.set_text(f"{where}peak {_described(predicted.peak)}")
        self._std.column.set_visibility(predicted.std is not None)
        if predicted.std is not None:
            self._std.show(predicted.std, grid)
            self._std.caption.set_text(f"mean {predicted.std.mean():.3f}, largest {predicted.std.max():.2f}")
        away: Data = []
        if self._view.data is not None:
            index, away_m = self._view.nearest(predicted.position)
            self._show_measured(self._view.data, index, away_m)
            away = paths([[predicted.position, self._view.positions[index]]])
        self._plan.show({"moving": points(predicted.position[None]), "away": away})

    def _show_measured(self, data: Spectra, index: int, away_m: float) -> None:
        spectrum = data.store[index : index + 1][0]
        found, in_training = peak(spectrum, data.grid, data.array), self._model.in_training
        trained = "in the training set" if in_training is not None and in_training[index] else "not in the training set"
        self._measured.caption.set_text(f"{away_m:.2f} m away, {trained}; peak {_described(found)}")
        if index != self._shown_measurement:
            self._shown_measurement = index
            azimuth, elevation = data.label[index].rad2deg().tolist()
            sight = None if np.isnan(azimuth) else (azimuth, elevation)
            self._measured.show(spectrum.numpy(), data.grid, (found, sight))

    def _describe(self, predicted: PredictedSpectrum, seconds: float) -> None:
        x, y, z = predicted.position.tolist()
        self._where.set_text(f"{self._view.moving} at {x:.2f}, {y:.2f}, {z:.2f} m")
        sight = predicted.line_of_sight
        if sight is None:
            self._angles.set_text("line of sight unknown: neither measurements nor model contain the array's pose")
        else:
            between = angle_between(predicted.peak, sight)
            self._angles.set_text(f"line of sight {_described(sight)}; {between:.1f}° from the peak")
        rows, columns = predicted.grid.shape
        self._frame.set_text(
            f"frame {1e3 * seconds:.0f} ms, of which the model {1e3 * predicted.seconds:.1f} ms for {rows} x {columns} "
            "directions"
        )


def _described(direction: Direction) -> str:
    return f"azimuth {direction[0]:.0f}°, elevation {direction[1]:.0f}°"
