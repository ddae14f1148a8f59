"""The page of RSSI maps."""

from __future__ import annotations

import io
from urllib.parse import unquote

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.colors import to_hex
from nicegui import events, run, ui
from PIL import Image

from swiftwrf import InputError
from swiftwrf.rssi.coverage import CLASSES
from tasks.labels import COVERAGE
from tasks.page.maps import FloorPlan, colour_image, read_pixels
from tasks.view.charts import (
    BAR,
    Data,
    around,
    circle,
    colour_bar,
    crosses,
    dots,
    lines,
    named,
    paths,
    picture,
    pictures,
    points,
    stripes,
)
from tasks.view.page import (
    MAX_UPLOAD_BYTES,
    NewestOnly,
    PlanChart,
    header,
    legend,
    located_data,
    located_layers,
    slider,
)
from tasks.view.rssi import LOCATING, N_RECEIVER_COLOURS, RECEIVER_COLOURS, ColouredMap, MapSelection, RssiView

MAX_MAP_PX = (880, 700)
KIND_LABELS = {"interval": "uncertainty"}  # of the kinds that the page calls by another word
HINT = "Hover over the map."
RECEIVER_MARK = "#cf4a4a"
ROW = "#999999"  # of the measured rows under a posterior


class RssiPage:
    """The page for one visitor."""

    def __init__(self, view: RssiView) -> None:
        self._view = view
        self._placing: dict[str, ui.number] = {}
        self._maps, self._points = NewestOnly(self._show_map), NewestOnly(self._show_point)
        with header(view.title, view.notes):
            kinds = {kind: {**KIND_LABELS, "RSSI": view.model.quantity}.get(kind, kind) for kind in view.kinds}
            self._kind = ui.toggle(kinds, value=view.kinds[0], on_change=self._update).props(
                "no-caps padding='2px 12px'"
            )
        layers = [pictures(name) for name in ("floor", "map", "silent", "outside")] + [dots("rows", ROW, 3)]
        layers += [dots("nothing", "transparent", 6, borderColor="white", borderWidth=1)]
        layers += [dots("measured", ROW, 8, borderColor="white", borderWidth=0.7), *located_layers()]
        layers += [lines("around", RECEIVER_MARK, 1, "dashed"), crosses("receivers", RECEIVER_MARK)]
        with ui.row().classes("w-full items-start gap-8 lg:flex-nowrap"):
            with ui.column().classes("gap-1").style("flex: 0 1 880px; max-width: 100%; min-width: 0"):
                self._plan = PlanChart("map", around(view.region), layers, MAX_MAP_PX, self._on_pointer, has_bar=True)
                self._best = ui.html("", sanitize=False).props('id="best"').classes("quiet")
            with ui.column().classes("gap-3").style("flex: 1 1 300px; max-width: 420px"):
                self._build_controls()
        self._update()

    def _build_controls(self) -> None:
        names = dict(enumerate(self._view.receivers))
        self._receiver = ui.select(names, value=0, label="receiver", with_input=len(names) > 20, on_change=self._update)
        self._receiver.props("outlined dense options-dense").classes("w-full")
        low, middle, high = self._view.heights
        if (floors := self._view.floors) is not None:
            heights = dict(zip(floors.height_m, floors.names, strict=True))
            first = floors.height_m[int(floors.number(torch.tensor([[0.0, 0.0, middle]])))]
            self._height: ui.select | ui.slider = ui.select(heights, value=first, label="floor", on_change=self._update)
            self._height.props("outlined dense options-dense").classes("w-full")
        else:
            with ui.column().classes("w-full") as column:
                self._height = slider("height", low, high, round(middle, 2), "m", self._update, step=0.01)
            column.set_visibility(high > low)
        with ui.column().classes("w-full gap-0") as self._limits:
            low, high, step = self._view.limits
            name, value, unit = self._view.direction, self._view.threshold, self._view.unit
            self._threshold = slider(name, low, high, value, unit, self._update, step)
            self._certainty = slider("certainty", 50, 99, 90, "%", self._update)
            numbers: dict[int | str, str] = {0: "at this receiver", 1: "at any receiver"}
            numbers |= {band: f"at any receiver of {band}" for band in self._view.rows.receivers_by_band}
            numbers |= {number: f"at {number} receivers or more" for number in range(2, len(names) + 1)}
            numbers = numbers if len(names) > 1 else {0: numbers[0]}
            self._at_least = ui.select(numbers, value=int(len(names) > 1), on_change=self._update)
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
            ui.button("SVG", icon="download", on_click=self._save_picture).props("outline no-caps")
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
        chosen = self._at_least.value  # a number of receivers, or a band
        number, band = (1, chosen) if isinstance(chosen, str) else (chosen, "")
        return MapSelection(
            self._kind.value, self._receiver.value, height, self._threshold.value, certainty, row, number, band
        )

    def _update(self) -> None:
        if self._kind.value == "expected error":
            self._sentence.set_text("The expected error is being computed, once.")
        self._maps.submit(self._selection)

    async def _show_map(self, selection: MapSelection) -> None:
        found = await run.io_bound(self._computed, selection)
        if found is None:  # the server is being ended
            return
        coloured, data, best = found
        self._limits.set_visibility(selection.kind == "coverage")
        self._receiver.set_enabled(selection.kind not in ("best receiver", *LOCATING) and not _at_any(selection))
        self._height.set_enabled(selection.kind not in LOCATING)
        self._choice.set_visibility(selection.kind == "posterior")
        self._sentence.set_text(coloured.sentence)
        entries = [(_colour(r), "■", f"{self._view.receivers[r]} {part:.0%}") for r, part in best.items()]
        if selection.kind == "coverage":
            entries = [(COVERAGE[name], "■", name) for name in reversed(CLASSES)]
        self._best.set_content(legend(entries[:N_RECEIVER_COLOURS]))
        limits = coloured.low, coloured.high
        bar = colour_bar(coloured.colours, limits, coloured.label, "measured", coloured.extend)
        self._plan.show(data, bar if coloured.label else {"id": BAR, "show": False})

    def _computed(self, selection: MapSelection) -> tuple[ColouredMap, dict[str, Data], dict[int, float]]:
        """Return colours and layers of a map, and the receivers that are best somewhere."""
        view, coloured = self._view, self._view.coloured(selection)
        best = view.best(selection.height) if selection.kind == "best receiver" else {}
        return coloured, self._data(selection, coloured), best

    def _data(self, selection: MapSelection, coloured: ColouredMap) -> dict[str, Data]:
        """Return the data of all layers of the plan."""
        view, rows, corners = self._view, self._view.rows, self._view.map(selection.height).corners
        image = colour_image(coloured.values[::-1], coloured.colours, coloured.low, coloured.high)
        hidden = ("floor", "silent", "outside", "rows", "nothing", "measured", "around", "receivers")
        data: dict[str, Data] = {name: [] for name in hidden}
        data["map"] = picture(image, coloured.corners or corners, 0.7 if view.plan else 1.0)
        if view.plan:
            data["floor"] = picture(Image.fromarray(view.plan.pixels), view.plan.corners)
        if selection.kind not in ("coverage", *LOCATING):  # grey where no scan determines the map
            data["outside"] = picture(
                colour_image(np.where(view.known(selection.height), np.nan, 0.5)[::-1], "gray"), corners, 0.55
            )
            data["silent"] = picture(colour_image(stripes(view.silent(selection))[::-1], "gray"), corners, 0.6)
        if selection.kind == "RSSI":
            detected, here = rows.detected[:, selection.receiver].numpy(), view.on_floor(selection.height)
            values = rows.rssi_dbm[detected & here, selection.receiver].numpy()
            data["measured"] = points(view.position[detected & here], values)
            if detected.any():  # a saved model does not hold what was received
                data["nothing"] = points(view.position[~detected & here])
        found = None
        if selection.kind == "posterior" and view.locating is not None:
            data["rows"], found = points(view.position), view.locating.located(selection.row)
        every = selection.kind in ("best receiver", *LOCATING) or _at_any(selection)
        for number, (name, place) in enumerate(zip(view.receivers, rows.receiver_position.numpy(), strict=True)):
            if not (every or number == selection.receiver):
                continue
            position, radius = (place, 0.0) if np.isfinite(place).all() else view.estimated.get(name, (place, 0.0))
            if np.isfinite(position).all():
                colour = _colour(number) if selection.kind == "best receiver" else RECEIVER_MARK
                data["receivers"].append(named(position, name, color=colour))
                data["around"] += paths([circle(position, radius)]) if radius else []
        return data | located_data(found)

    def _on_pointer(self, kind: str, buttons: int, x: float, y: float) -> None:
        if kind == "pointerdown" and self._view.locating is not None and self._kind.value == "posterior":
            self._row.value = int(self._view.locating.rows.index[self._view.locating.nearest(x, y)])
        if kind == "pointerleave":
            self._point.set_text(HINT)
        else:
            self._points.submit(x, y)

    async def _show_point(self, x: float, y: float) -> None:
        described = await run.io_bound(self._view.describe, self._selection, x, y)
        if described is not None:
            self._point.set_text(described)

    async def _save_picture(self) -> None:
        name = f"{_file_name(self._selection)}.svg"
        address = await self._plan.element.run_chart_method("getDataURL", timeout=10)
        ui.download.content(unquote(address.partition(",")[2]), name, "image/svg+xml")

    def _save_table(self) -> None:
        selection = self._selection
        ui.download.content(self._view.table(selection), f"{_file_name(selection)}.csv", "text/csv")


def _at_any(selection: MapSelection) -> bool:
    """Return True if the map is of all receivers together."""
    return selection.kind == "coverage" and selection.at_least > 0


def _colour(receiver: int) -> str:
    return to_hex(colormaps[RECEIVER_COLOURS](receiver % N_RECEIVER_COLOURS))


def _file_name(selection: MapSelection) -> str:
    return f"{selection.kind.replace(' ', '-')}-{selection.receiver + 1}-{selection.height:.2f}m"
