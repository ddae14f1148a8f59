"""The page of RSSI maps."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from nicegui import events, run, ui
from numpy.typing import NDArray
from PIL import Image

from swiftwrf import InputError
from tasks.page.floor_plan import FloorPlan, read_pixels
from tasks.page.raster import colour_image
from tasks.view.drawing import text
from tasks.view.page import MAX_UPLOAD_BYTES, NewestOnly, colour_bar, header, located_marks, plan_picture, slider
from tasks.view.rssi import (
    LOCATING,
    N_RECEIVER_COLOURS,
    RECEIVER_COLOURS,
    RECEIVER_MARK,
    ColouredMap,
    MapSelection,
    RssiView,
)

N_DOT_COLOURS = 33
MAX_MAP_PX = (880, 700)
KIND_LABELS = {"interval": "uncertainty"}  # of the kinds that the page calls by another word
HINT = "Hover over the map."
ROW = "#999999"  # of the measured rows under a posterior


class RssiPage:
    """The page for one visitor."""

    def __init__(self, view: RssiView) -> None:
        self._view, self._plan = view, view.plan(MAX_MAP_PX)
        self._placing: dict[str, ui.number] = {}
        self._maps, self._points = NewestOnly(self._show_map), NewestOnly(self._show_point)
        with header(view.title, view.notes):
            kinds = {kind: KIND_LABELS.get(kind, kind) for kind in view.kinds}
            self._kind = ui.toggle(kinds, value="RSSI", on_change=self._update).props("no-caps padding='2px 12px'")
        with ui.row().classes("w-full items-start gap-8 lg:flex-nowrap"):
            with ui.column().classes("gap-1").style("flex: none; max-width: 100%"):
                self._picture = plan_picture(self._plan, "map")
                self._picture.on_mouse(self._on_pointer)
                self._bar = ui.html("", sanitize=False).style(
                    "min-height: 34px; margin-left: 48px; max-width: calc(100% - 48px)"
                )
            with ui.column().classes("gap-3 grow").style("max-width: 420px; min-width: min(100%, 18rem)"):
                self._build_controls()
        self._update()

    def _build_controls(self) -> None:
        names = dict(enumerate(self._view.receivers))
        self._receiver = ui.select(names, value=0, label="receiver", with_input=len(names) > 20, on_change=self._update)
        self._receiver.props("outlined dense options-dense").classes("w-full")
        low, middle, high = self._view.heights
        with ui.column().classes("w-full") as column:
            self._height = slider("height", low, high, round(middle, 2), "m", self._update, step=0.01)
        column.set_visibility(high > low)
        with ui.column().classes("w-full gap-0") as self._limits:
            self._threshold = slider("above", -110, -30, -75, "dBm", self._update)
            self._certainty = slider("certainty", 50, 99, 90, "%", self._update)
            numbers = {0: "at this receiver", 1: "at any receiver"}
            numbers |= {number: f"at {number} receivers or more" for number in range(2, len(names) + 1)}
            self._at_least = ui.select(numbers if len(names) > 1 else {0: numbers[0]}, value=0, on_change=self._update)
            self._at_least.props("outlined dense options-dense").classes("w-full").set_visibility(len(names) > 1)
        with ui.column().classes("w-full gap-0") as self._choice:
            self._row = ui.number("row", format="%d", on_change=self._update).props("outlined dense")
            ui.label("Click the map: the measured row nearest to it.").classes("quiet")
        if (locating := self._view.locating) is not None:
            self._row.value = int(locating.rows.index[locating.first])
        self._sentence = ui.label().props('id="sentence"')
        ui.separator()
        self._point = ui.label(HINT).classes("numbers").props('id="here"').style("white-space: pre-line")
        ui.separator()
        with ui.row():
            ui.button("PNG", icon="download", on_click=self._save_picture).props("outline no-caps")
            ui.button("CSV", icon="download", on_click=self._save_table).props("outline no-caps")
        self._build_floor_plan()

    def _build_floor_plan(self) -> None:
        with ui.expansion("Floor plan").classes("w-full").props('id="floor-plan" dense'):
            ui.label("Give scale and origin, then drop an image (PNG, JPEG). It is saved with the run.").classes(
                "quiet"
            )
            with ui.row().classes("w-full gap-2"):
                for name, value in (("scale", 0.05), ("right", 0.0), ("down", 0.0)):
                    label = {"scale": "metres a pixel", "right": "origin, pixels right", "down": "origin, pixels down"}
                    self._placing[name] = ui.number(label[name], value=value).props("outlined dense")
            upload = ui.upload(on_upload=self._place, auto_upload=True, max_file_size=MAX_UPLOAD_BYTES, max_files=1)
            upload.props('accept=".png,.jpg,.jpeg" flat bordered').classes("w-full")

    async def _place(self, event: events.UploadEventArguments) -> None:
        scale, right, down = (float("nan") if box.value is None else box.value for box in self._placing.values())
        try:
            pixels = read_pixels(io.BytesIO(await event.file.read()), event.file.name)
            await run.io_bound(self._view.place, FloorPlan.scaled(pixels, scale, (right, down)))
        except InputError as error:
            ui.notify(str(error), type="negative")
        else:
            ui.navigate.reload()

    @property
    def _selection(self) -> MapSelection:
        height, certainty = round(self._height.value, 3), self._certainty.value / 100
        locating, number = self._view.locating, self._row.value
        row = 0 if locating is None or number is None else locating.numbered(number)
        return MapSelection(
            self._kind.value, self._receiver.value, height, self._threshold.value, certainty, row, self._at_least.value
        )

    def _update(self) -> None:
        if self._kind.value == "expected error":
            self._sentence.set_text("The expected error is being computed, once.")
        self._maps.submit(self._selection)

    async def _show_map(self, selection: MapSelection) -> None:
        coloured = await run.io_bound(self._view.coloured, selection)
        if coloured is None:  # the server is being ended
            return
        self._limits.set_visibility(selection.kind == "coverage")
        self._receiver.set_enabled(selection.kind not in ("best receiver", *LOCATING))
        self._height.set_enabled(selection.kind not in LOCATING)
        self._choice.set_visibility(selection.kind == "posterior")
        self._sentence.set_text(self._view.sentence(selection))
        bar = colour_bar(coloured.colours, coloured.low, coloured.high, coloured.label) if coloured.label else ""
        self._bar.set_content(bar)
        self._picture.set_content(self._map_svg(selection, coloured))

    def _map_svg(self, selection: MapSelection, coloured: ColouredMap) -> str:
        plan, floor = self._plan, self._view.floor
        parts = [plan.picture(Image.fromarray(floor.plan.pixels), floor.plan.corners)] if floor.plan else []
        image = colour_image(coloured.values[::-1], coloured.colours, coloured.low, coloured.high)
        parts.append(plan.picture(image, coloured.corners or self._view.chart.corners, 0.7 if floor.plan else 1.0))
        if selection.kind not in LOCATING:
            parts.append(plan.picture(colour_image(self._outside, "gray"), self._view.chart.corners, 0.55))
        if selection.kind == "RSSI":
            parts.append(self._measured_svg(selection.receiver, coloured))
        if selection.kind == "posterior":
            parts.append(self._located_svg(selection.row))
        every = selection.kind in ("best receiver", *LOCATING)
        for number, position in enumerate(floor.receiver):
            if np.isfinite(position).all() and (every or number == selection.receiver):
                x, y = plan.pixel(position)
                if selection.kind == "best receiver":
                    colour = to_hex(colormaps[RECEIVER_COLOURS](number % N_RECEIVER_COLOURS))
                    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{colour}" stroke="black"/>')
                else:
                    parts.append(plan.cross(position, RECEIVER_MARK))
                parts.append(text(x + 11, y + 5, self._view.receivers[number], haloed=True))
        return "".join([*parts, plan.axes()])

    @property
    def _outside(self) -> NDArray[np.floating]:
        """Grey where the map is extrapolated, transparent elsewhere, the first row on top."""
        return np.where(self._view.inside, np.nan, 0.5)[::-1]

    def _measured_svg(self, receiver: int, coloured: ColouredMap) -> str:
        """Return the measurements as dots in the colours of the map, with a white rim."""
        values = self._view.floor.rssi_dbm[:, receiver]
        detected = np.isfinite(values)
        position = self._view.floor.position[detected]
        scaled = np.clip((values[detected] - coloured.low) / (coloured.high - coloured.low), 0, 1)
        step = np.rint(scaled * (N_DOT_COLOURS - 1)).astype(int)
        # one path for each colour: one for each dot would be too many for a browser
        colour = colormaps[coloured.colours].resampled(N_DOT_COLOURS)
        dots = [self._plan.dots(position[step == number], to_hex(colour(int(number))), 4) for number in np.unique(step)]
        return "".join([self._plan.dots(position, "white", 4.7), *dots])

    def _located_svg(self, row: int) -> str:
        """Return the measured rows, and the median, credible regions and measured position of one of them."""
        assert self._view.locating is not None
        dots = self._plan.dots(self._view.floor.position, ROW, 1.5)
        return dots + located_marks(self._plan, self._view.locating.located(row))

    def _on_pointer(self, event: events.MouseEventArguments) -> None:
        if event.type == "pointerdown" and self._view.locating is not None and self._kind.value == "posterior":
            row = self._view.locating.nearest(*self._plan.position(event.image_x, event.image_y))
            self._row.value = int(self._view.locating.rows.index[row])
        if event.type == "pointerleave":
            self._point.set_text(HINT)
        else:
            self._points.submit(*self._plan.position(event.image_x, event.image_y))

    async def _show_point(self, x: float, y: float) -> None:
        described = await run.io_bound(self._view.describe, self._selection, x, y)
        if described is not None:
            self._point.set_text(described)

    async def _save_picture(self) -> None:
        selection = self._selection
        content = await run.io_bound(self._view.picture, selection)
        if content is not None:
            ui.download.content(content, f"{_file_name(selection)}.png", "image/png")

    def _save_table(self) -> None:
        selection = self._selection
        ui.download.content(self._view.table(selection), f"{_file_name(selection)}.csv", "text/csv")


def _file_name(selection: MapSelection) -> str:
    return f"{selection.kind.replace(' ', '-')}-{selection.receiver + 1}-{selection.height:.2f}m"
