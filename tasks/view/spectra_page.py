"""The page of spectra: a plan to drag the moving end in, and the spectrum there."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from nicegui import events, run, ui
from numpy.typing import NDArray

from swiftwrf import AngularGrid, Spectra
from tasks.aoa.page.room import FIXED, MEASURED, in_plan
from tasks.page.polar import MAX_DIFFERENCE
from tasks.page.raster import colour_image
from tasks.view.drawing import HemisphereProjection, PlanProjection, cross, data_url, ring, text
from tasks.view.page import NewestOnly, colour_bar, header, located_marks, plan_picture, slider
from tasks.view.spectra import Direction, LoadedModel, PredictedSpectrum, SpectraView, angle_between, peak

UNSEEN, MOVING, PEAK, SIGHT = "#d1620f", "#cf4a4a", "#ffffff", "#ee6677"
KEY_STEP = 0.01  # of the plan; ten times as far with Shift
MAX_PLAN_PX = (430, 480)
MAX_LARGE_DOTS = 400
RATE_FRAMES = 20
MARK_PX = 7
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


class SpectrumPicture:
    """One spectrum with its axes and the directions marked in it.

    Args:
        title: Title above the picture.
        name: Identifier of the element on the page.
        colours: Name of a matplotlib colour map.
    """

    def __init__(self, title: str, name: str, colours: str = "viridis") -> None:
        self._colours = colours
        with ui.column().classes("gap-0") as self.column:
            ui.label(title).classes("text-weight-medium")
            self.caption = ui.label().classes("quiet numbers")
            self._picture = ui.interactive_image(sanitize=False).classes("outside pixels").props(f'id="{name}"')

    def lay_out(self, projection: HemisphereProjection) -> None:
        """Take the projection over and adapt the element's size."""
        self._projection = projection
        width, margin = (290, "24px 50px 28px 50px") if projection.polar else (750, "6px 24px 24px 40px")
        self._unit = projection.width / width  # pixels of the picture in one of the page
        self.column.style(f"width: {width + 100}px; max-width: 100%")
        self._picture.style(
            f"width: {width}px; max-width: calc(100% - {100 if projection.polar else 64}px); margin: {margin}"
        )
        self._picture._props["size"] = (projection.width, projection.height)

    def show(
        self,
        values: NDArray[np.floating],
        grid: AngularGrid,
        high: float,
        marks: tuple[Direction | None, Direction | None] = (None, None),
    ) -> None:
        """Show values (n_elevation, n_azimuth) from 0 to `high`, a ring at the first direction and a cross at the second."""
        image = colour_image(self._projection.project(values, grid), self._colours, 0.0, high)
        self._picture.set_source(data_url(image))
        shapes = [self._axes()]
        for direction, shape, colour in zip(marks, (ring, cross), (PEAK, SIGHT), strict=True):
            if direction is not None:
                shapes.append(shape(*self._projection.pixel(*direction), MARK_PX * self._unit, colour))
        self._picture.set_content("".join(shapes))

    def _axes(self) -> str:
        """Return the numbers around the picture [deg]."""
        projection, unit = self._projection, self._unit
        size = 12 * unit
        if not projection.polar:
            below, ticks = projection.height + 15 * unit, ((0, 90, 180, 270, 360), (0, 30, 60, 90))
            parts = [text(a / 360 * projection.width, below, f"{a}°", "middle", size) for a in ticks[0]]
            rows = [(e, projection.pixel(0, e)[1] + 4 * unit) for e in ticks[1]]
            return "".join([*parts, *(text(-6 * unit, y, f"{e}°", "end", size) for e, y in rows)])
        parts, middle = [], projection.width / 2
        for elevation in (0, 30, 60):
            radius, colour = (1 - elevation / 90) * middle, "white" if elevation else "currentColor"
            circle = f'<circle cx="{middle}" cy="{middle}" r="{radius:.1f}" fill="none" stroke-width="{unit:.2f}"'
            parts.append(f'{circle} stroke="{colour}" stroke-opacity="0.5"/>')
        for azimuth, anchor, down in ((0, "start", 4), (90, "middle", 0), (180, "end", 4), (270, "middle", 12)):
            x, y = projection.pixel(azimuth, -4)
            parts.append(text(x, y + down * unit, f"{azimuth}°", anchor, size))
        return "".join(parts)


class SpectraPage:
    """The page for one visitor."""

    def __init__(self, view: SpectraView) -> None:
        self._view, self._model = view, view.models[0]
        self._position, self._shown_measurement = view.start.copy(), -1
        self._frames: deque[float] = deque(maxlen=RATE_FRAMES)
        self._requests = NewestOnly(self._predict)
        self._low, self._high = view.box
        self._plan = PlanProjection.around(self._low, self._high, max_px=MAX_PLAN_PX)
        with header(view.title, view.notes):
            self._build_controls()
        with ui.row().classes("w-full items-start gap-8 lg:flex-nowrap"):
            self._build_plan()
            with ui.row().classes("gap-x-8 gap-y-0 grow").style("max-width: 900px; min-width: min(100%, 20rem)"):
                self._predicted = SpectrumPicture("Predicted", "synthesized")
                self._measured = SpectrumPicture("Nearest measured", "measured")
                self._std = SpectrumPicture("Standard deviation of a measured spectrum", "deviation", "magma")
                with ui.column().classes("gap-1"):
                    ui.html(colour_bar("viridis", 0, 1, "magnitude"), sanitize=False)
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
        self._polar = ui.toggle({False: "rectangular", True: "polar"}, value=False, on_change=self._lay_out)
        self._polar.props("no-caps padding='2px 12px'")

    def _build_plan(self) -> None:
        with ui.column().classes("gap-1").style("width: 500px; max-width: 100%; flex: none"):
            self._picture = plan_picture(self._plan, "plan")
            self._picture.on_mouse(self._on_pointer)
            self._picture.props("tabindex=0").on("keydown", self._on_key, js_handler=KEYS)
            self._overlay, self._posterior = self._picture.add_layer(), self._picture.add_layer()
            low, middle, high = self._low[2].item(), self._position[2].item(), self._high[2].item()
            self._height = slider("height", low, high, middle, "m", self._on_height, step=0.01)
            self._where = ui.label().classes("numbers").props('id="where"')
            self._angles = ui.label().classes("numbers")
            self._located = ui.label().classes("numbers").props('id="located"')
            self._frame = ui.label().classes("quiet numbers").props('id="frame"')
            ui.html(self._legend(), sanitize=False).classes("quiet")
            ui.label(HELP).classes("quiet")

    def _legend(self) -> str:
        parts = [f'<span style="color:{MOVING}">●</span> {self._view.moving}']
        if self._view.data is not None:
            parts.append(f'<span style="color:{MEASURED}">●</span> measured, in the training set')
            parts.append(f'<span style="color:{UNSEEN}">●</span> measured, not in the training set')
        if self._view.fixed is not None:
            parts.append(f'<span style="color:{FIXED}">✕</span> fixed end')
        if any(loaded.planes for loaded in self._view.models):
            parts.append("lines: walls found, dashed where uncertain")
        return "".join(f'<div style="display: inline-block; margin-right: 1em">{part}</div>' for part in parts)

    def _choose(self, number: int) -> None:
        self._model = self._view.models[number]
        self._lay_out()

    def _lay_out(self) -> None:
        grid = self._model.model.grid
        projection = HemisphereProjection.disc() if self._polar.value else HemisphereProjection.rectangular(grid)
        for picture in (self._predicted, self._measured, self._std):
            picture.lay_out(projection)
        self._shown_measurement = -1
        self._measured.column.set_visibility(self._view.data is not None)
        self._locate.set_visibility(self._view.data is not None and self._model.locating is not None)
        self._picture.set_content(self._background())
        self._request(dragging=False)

    def _background(self) -> str:
        plan, data, in_training = self._plan, self._view.data, self._model.in_training
        parts = [plan.axes()]
        if data is not None:
            trained = np.zeros(len(data), dtype=bool) if in_training is None else in_training
            radius = 3 if len(data) < MAX_LARGE_DOTS else 2
            parts.append(plan.dots(data.position[~trained], UNSEEN, radius))
            parts.append(plan.dots(data.position[trained], MEASURED, radius))
        for plane in self._model.planes:
            ends = in_plan(plane, self._low, self._high)
            if ends is not None and plan.contains(ends):
                parts.append(plan.line(ends, dashed=not plane["certain"]))
        if self._view.fixed is not None:
            parts.append(self._fixed_end(self._view.fixed))
        return "".join(parts)

    def _fixed_end(self, position: NDArray[np.floating]) -> str:
        """Return a cross at the fixed end, or at the edge with the distance if it lies outside of the plan."""
        plan = self._plan
        inside = np.clip(position[:2], plan.low, plan.high)
        beyond = float(np.linalg.norm(position[:2] - inside))
        mark = plan.cross(inside, FIXED)
        if beyond == 0:
            return mark
        x, y = plan.pixel(inside)
        dx, anchor = (12, "start") if x < plan.size[0] / 2 else (-12, "end")
        return mark + text(x + dx, y + 4, f"{beyond:.1f} m beyond", anchor)

    def _on_pointer(self, event: events.MouseEventArguments) -> None:
        if event.type == "pointerdown":
            self._frames.clear()
        if event.type == "pointerleave" or (event.type == "pointermove" and not event.buttons & 1):
            return
        self._position[:2] = self._plan.position(event.image_x, event.image_y)
        self._request(dragging=event.type != "pointerup")

    def _on_key(self, event: events.GenericEventArguments) -> None:
        step = KEY_STEP * (10 if event.args["shift"] else 1) * float((self._plan.high - self._plan.low).max())
        axis, sign = MOVES[event.args["key"]]
        if axis == 2:
            self._height.value = float(np.clip(self._height.value + sign * step, self._low[2], self._high[2]))
            return
        self._position[axis] = np.clip(self._position[axis] + sign * step, self._plan.low[axis], self._plan.high[axis])
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
        if not dragging:
            await run.io_bound(lambda: loaded.drag_grid)  # found before the pointer begins to drag

    async def _show_located(self, loaded: LoadedModel, position: NDArray[np.floating], dragging: bool) -> None:
        """Show the posterior of the nearest measured spectrum; while dragging, only its removal."""
        marks = described = ""
        if not dragging and self._locate.value and self._view.data is not None and loaded.locating is not None:
            index, _ = self._view.nearest(position)
            self._located.set_text("The nearest measured spectrum is being located.")
            found = await run.io_bound(self._view.located, loaded, index)
            if found is None or loaded is not self._model:
                return
            image = colour_image(found.density.values[::-1], "magma")
            marks = self._plan.picture(image, found.density.corners, 0.8) + located_marks(self._plan, found)
            described = f"Posterior of spectrum {int(self._view.data.index[index])}: {found.describe()}"
        self._posterior.set_content(marks)
        self._located.set_text(described)

    def _show(self, predicted: PredictedSpectrum) -> None:
        grid = predicted.grid
        self._predicted.show(predicted.mean, grid, 1.0, (predicted.peak, predicted.line_of_sight))
        outside = self._view.extrapolates(predicted.position)
        self._predicted.column.classes(**{"add" if outside else "remove": "extrapolated"})
        where = "outside the measured positions, extrapolated; " if outside else ""
        self._predicted.caption.set_text(f"{where}peak {_described(predicted.peak)}")
        self._std.column.set_visibility(predicted.std is not None)
        if predicted.std is not None:
            self._std.show(predicted.std, grid, MAX_DIFFERENCE)
            self._std.caption.set_text(
                f"black 0, white {MAX_DIFFERENCE:g} and more; mean {predicted.std.mean():.3f}, "
                f"largest {predicted.std.max():.2f}"
            )
        shapes = [self._plan.dots(predicted.position[None], MOVING, 8)]
        if self._view.data is not None:
            index, away_m = self._view.nearest(predicted.position)
            self._show_measured(self._view.data, index, away_m)
            ends = [predicted.position, self._view.positions[index]]
            shapes.insert(0, self._plan.line(ends, MOVING, width=2))
        self._overlay.set_content("".join(shapes))

    def _show_measured(self, data: Spectra, index: int, away_m: float) -> None:
        spectrum = data.store[index : index + 1][0]
        found, in_training = peak(spectrum, data.grid, data.array), self._model.in_training
        trained = "in the training set" if in_training is not None and in_training[index] else "not in the training set"
        self._measured.caption.set_text(f"{away_m:.2f} m away, {trained}; peak {_described(found)}")
        if index != self._shown_measurement:
            self._shown_measurement = index
            azimuth, elevation = data.label[index].rad2deg().tolist()
            sight = None if np.isnan(azimuth) else (azimuth, elevation)
            self._measured.show(spectrum.numpy(), data.grid, 1.0, (found, sight))

    def _describe(self, predicted: PredictedSpectrum, seconds: float) -> None:
        x, y, z = predicted.position.tolist()
        self._where.set_text(f"{self._view.moving} at {x:.2f}, {y:.2f}, {z:.2f} m")
        sight = predicted.line_of_sight
        if sight is None:
            self._angles.set_text("line of sight unknown: neither measurements nor model contain the array's pose")
        else:
            between = angle_between(predicted.peak, sight)
            self._angles.set_text(f"line of sight {_described(sight)}; {between:.1f}° from the peak")
        self._frames.append(time.perf_counter())
        span = self._frames[-1] - self._frames[0]
        full = len(self._frames) == RATE_FRAMES and span > 0
        rate = f", {(RATE_FRAMES - 1) / span:.0f} frames a second" if full else ""
        rows, columns = predicted.grid.shape
        self._frame.set_text(
            f"frame {1e3 * seconds:.0f} ms, of which the model {1e3 * predicted.seconds:.1f} ms for {rows} x {columns} "
            f"directions{rate}"
        )


def _described(direction: Direction) -> str:
    return f"azimuth {direction[0]:.0f}°, elevation {direction[1]:.0f}°"
