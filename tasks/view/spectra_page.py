"""The page of spectra: a plan to drag the moving end in, and what the array sees from there."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from nicegui import events, run, ui
from numpy.typing import NDArray

from tasks.aoa.page.room import FIXED, MEASURED, in_plan
from tasks.view.pictures import View
from tasks.view.plan import Plan, text
from tasks.view.spectra import Direction, Drawn, Measured, SpectraScene, angle_between
from tasks.view.spectrum_picture import SpectrumPicture
from tasks.view.widgets import Latest, canvas, colour_bar, header

UNSEEN, HERE, STRONGEST, SIGHT = "#bb8833", "#ee6677", "#ffffff", "#ee6677"
STEP = 0.01  # of the plan, that an arrow key moves; ten times with Shift
MOST_PLAN = (430, 480)  # pixels
MANY = 400  # measured positions from which on their dots are smaller
RATE = 20  # frames over which frames a second are told


@dataclass(frozen=True)
class Asked:
    """Where the moving end shall stand, and whether it is still on the way."""

    position: NDArray[np.floating]
    dragging: bool


class SpectraPage:
    """The page for one visitor."""

    def __init__(self, scene: SpectraScene) -> None:
        self._scene, self._fitted = scene, scene.fitted[0]
        self._position, self._nearest_row = scene.start.copy(), -1
        self._times: deque[float] = deque(maxlen=RATE)
        self._most_deviation = 1e-3
        self._latest = Latest(self._draw)
        self._low, self._high = scene.box
        self._plan = Plan.around(self._low, self._high, most=MOST_PLAN)
        with header(scene.title, scene.notes):
            self._choices()
        with ui.row().classes("w-full no-wrap items-start gap-8"):
            self._left()
            with ui.row().classes("gap-x-8 gap-y-0 grow").style("max-width: 900px"):
                self._spectrum = SpectrumPicture("Synthesized", "synthesized")
                self._measured = SpectrumPicture("Nearest measured", "measured")
                self._deviation = SpectrumPicture("Expected deviation of a measured spectrum", "deviation", "magma")
                with ui.column().classes("gap-1"):
                    ui.html(colour_bar("viridis", 0, 1, "magnitude"), sanitize=False)
                    ui.label("Ring: strongest direction; cross: line of sight.").classes("quiet")
        self._lay_out()

    def _choices(self) -> None:
        titles = {number: fitted.title for number, fitted in enumerate(self._scene.fitted)}
        if len(titles) > 1:
            choice = ui.select(titles, value=0, label="model", on_change=lambda e: self._choose(e.value))
            choice.props("dense options-dense outlined").style("min-width: 240px")
        else:
            ui.label(titles[0]).classes("quiet")
        self._polar = ui.toggle({False: "rectangular", True: "polar"}, value=False, on_change=self._lay_out)
        self._polar.props("no-caps padding='2px 12px'")

    def _left(self) -> None:
        with ui.column().classes("gap-1").style("width: 500px; flex: none"):
            self._picture = canvas(self._plan, "plan")
            self._picture.on_mouse(self._pointed)
            self._picture.props("tabindex=0").on("keydown", self._pressed, js_handler=KEYS)
            self._end = self._picture.add_layer()
            middle = self._position[2].item()
            with ui.row().classes("w-full items-center no-wrap"):
                ui.label("height")
                low, high = self._low[2].item(), self._high[2].item()
                self._height = ui.slider(min=low, max=high, step=0.01, value=middle, on_change=self._raised)
                self._height.props('aria-label="height"')
                self._metres = ui.label().classes("numbers").style("min-width: 4rem")
            self._where = ui.label().classes("numbers").props('id="where"')
            self._angles = ui.label().classes("numbers")
            self._frame = ui.label().classes("quiet numbers").props('id="frame"')
            ui.html(self._legend(), sanitize=False).classes("quiet")
            ui.label(
                "Drag in the plan, or click it and use the arrow keys (Shift: ten times as far); Page Up and Down: height."
            ).classes("quiet")

    def _legend(self) -> str:
        parts = [f'<span style="color:{HERE}">●</span> {self._scene.moving}']
        if self._scene.data is not None:
            parts.append(f'<span style="color:{MEASURED}">●</span> measured, learnt from')
            parts.append(f'<span style="color:{UNSEEN}">●</span> measured, not seen by the model')
        if self._scene.fixed is not None:
            parts.append(f'<span style="color:{FIXED}">✕</span> fixed end')
        if any(fitted.planes for fitted in self._scene.fitted):
            parts.append("lines: walls found, dashed where uncertain")
        return "".join(f'<div style="display: inline-block; margin-right: 1em">{part}</div>' for part in parts)

    def _choose(self, number: int) -> None:
        self._fitted = self._scene.fitted[number]
        self._most_deviation = 1e-3
        self._lay_out()

    def _lay_out(self) -> None:
        view = View.disc() if self._polar.value else View.rectangular(self._fitted.grid)
        for picture in (self._spectrum, self._measured, self._deviation):
            picture.lay_out(view)
        self._nearest_row = -1  # its picture is drawn anew
        self._measured.column.set_visibility(self._scene.data is not None)
        self._picture.set_content(self._background())
        self._ask(dragging=False)

    def _background(self) -> str:
        plan, data, learnt = self._plan, self._scene.data, self._fitted.learnt
        parts = [plan.axes()]
        if data is not None:
            seen = np.zeros(len(data), dtype=bool) if learnt is None else learnt
            radius = 3 if len(data) < MANY else 2
            parts += [plan.dots(data.position[~seen], UNSEEN, radius), plan.dots(data.position[seen], MEASURED, radius)]
        for plane in self._fitted.planes:
            ends = in_plan(plane, self._low, self._high)
            if ends is not None and plan.shows(ends):
                parts.append(plan.line(ends, plane["certain"]))
        if self._scene.fixed is not None:
            parts.append(self._fixed_end(self._scene.fixed))
        return "".join(parts)

    def _fixed_end(self, at: NDArray[np.floating]) -> str:
        """A cross, at the edge where it lies beyond."""
        shown = np.clip(at[:2], self._plan.low, self._plan.high)
        beyond = float(np.linalg.norm(at[:2] - shown))
        if beyond == 0:
            return self._plan.cross(at, FIXED)
        x, y = self._plan.place(shown)
        left = x < self._plan.size[0] / 2
        label = text(x + (12 if left else -12), y + 4, f"{beyond:.1f} m beyond", "start" if left else "end")
        return self._plan.cross(shown, FIXED) + label

    def _pointed(self, event: events.MouseEventArguments) -> None:
        if event.type == "pointerdown":
            self._times.clear()
        if event.type == "pointerleave" or (event.type == "pointermove" and not event.buttons & 1):
            return
        self._position[:2] = self._plan.position(event.image_x, event.image_y)
        self._ask(dragging=event.type != "pointerup")

    def _pressed(self, event: events.GenericEventArguments) -> None:
        step = STEP * (10 if event.args["shift"] else 1) * float((self._plan.high - self._plan.low).max())
        axis, sign = MOVES[event.args["key"]]
        if axis == 2:
            self._height.value = float(np.clip(self._height.value + sign * step, self._low[2], self._high[2]))
            return
        self._position[axis] = np.clip(self._position[axis] + sign * step, self._plan.low[axis], self._plan.high[axis])
        self._ask(dragging=False)

    def _raised(self, event: events.ValueChangeEventArguments[float | None]) -> None:
        if event.value is not None:
            self._position[2] = event.value
            self._ask(dragging=False)

    def _ask(self, dragging: bool) -> None:
        self._latest.ask(Asked(self._position.copy(), dragging))

    async def _draw(self, asked: Asked) -> None:
        began = time.perf_counter()
        fitted = self._fitted
        drawn = await run.io_bound(self._scene.draw, fitted, asked.position, asked.dragging)
        if drawn is not None and fitted is self._fitted:  # None where the server is being ended
            self._show(drawn, self._scene.nearest(fitted, asked.position))
            self._tell(drawn, time.perf_counter() - began)
        if not asked.dragging:
            await run.io_bound(lambda: fitted.quick)  # found before the pointer begins to drag

    def _show(self, drawn: Drawn, nearest: Measured | None) -> None:
        self._spectrum.show(
            drawn.spectrum, drawn.grid, 1.0, [(drawn.strongest, STRONGEST), (drawn.line_of_sight, SIGHT)]
        )
        self._spectrum.caption.set_text(f"strongest {_told(drawn.strongest)}")
        self._deviation.column.set_visibility(drawn.deviation is not None)
        if drawn.deviation is not None:
            self._most_deviation = max(self._most_deviation, float(drawn.deviation.max()))
            self._deviation.show(drawn.deviation, drawn.grid, self._most_deviation, [])
            self._deviation.caption.set_text(
                f"black 0, white {self._most_deviation:.2f}; mean {drawn.deviation.mean():.3f}"
            )
        shapes = []
        if nearest is not None and self._scene.data is not None:
            self._show_measured(nearest)
            ends = self._plan.place([drawn.position, self._scene.places[nearest.number]])
            (x0, y0), (x1, y1) = ends
            shapes.append(f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{HERE}" stroke-width="2"/>')
        shapes.append(self._plan.dots(drawn.position[None], HERE, 8))
        self._end.set_content("".join(shapes))

    def _show_measured(self, nearest: Measured) -> None:
        data = self._scene.data
        assert data is not None
        learnt = "learnt from" if nearest.learnt else "not seen by the model"
        self._measured.caption.set_text(f"{nearest.away_m:.2f} m away, {learnt}; strongest {_told(nearest.strongest)}")
        if nearest.number != self._nearest_row:
            self._nearest_row = nearest.number
            azimuth, elevation = data.label[nearest.number].rad2deg().tolist()
            marks: list[tuple[Direction | None, str]] = [(nearest.strongest, STRONGEST), ((azimuth, elevation), SIGHT)]
            self._measured.show(nearest.spectrum, data.grid, 1.0, marks)

    def _tell(self, drawn: Drawn, seconds: float) -> None:
        x, y, z = drawn.position.tolist()
        self._where.set_text(f"{self._scene.moving} at {x:.2f}, {y:.2f}, {z:.2f} m")
        self._metres.set_text(f"{z:.2f} m")
        sight = drawn.line_of_sight
        if sight is None:
            self._angles.set_text(
                "line of sight unknown: neither the measurements nor the model tell where the array is"
            )
        else:
            between = angle_between(drawn.strongest, sight)
            self._angles.set_text(f"line of sight {_told(sight)}; {between:.1f}° from the strongest direction")
        self._times.append(time.perf_counter())
        span = self._times[-1] - self._times[0]
        rate = f", {(len(self._times) - 1) / span:.0f} frames a second" if len(self._times) == RATE and span > 0 else ""
        rows, columns = drawn.grid.shape
        self._frame.set_text(
            f"frame {1e3 * seconds:.0f} ms, of which the model {1e3 * drawn.seconds:.1f} ms for {rows} x {columns} "
            f"directions{rate}"
        )


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


def _told(direction: Direction) -> str:
    return f"azimuth {direction[0]:.0f}°, elevation {direction[1]:.0f}°"


def show(scene: SpectraScene) -> None:
    """Builds the page."""
    SpectraPage(scene)
