"""The page of RSSI: maps to hover over, where it is above a threshold, and who hears best."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from nicegui import events, run, ui

from swiftwrf.rssi import LEVEL
from tasks.view.pictures import address, as_png, png
from tasks.view.plan import text
from tasks.view.rssi import MOST_COLOURS, RECEIVER_COLOURS, Heard, Layer, RssiScene, Shown
from tasks.view.widgets import Latest, canvas, colour_bar, header

CROSS = "#ee6677"
DOT_COLOURS = 32
MOST_MAP = (880, 700)  # pixels
KINDS = {
    "RSSI": "RSSI",
    "interval": "uncertainty",
    "coverage": "coverage",
    "best receiver": "best receiver",
}


class RssiPage:
    """The page for one visitor."""

    def __init__(self, scene: RssiScene) -> None:
        self._scene, self._plan = scene, scene.plan(MOST_MAP)
        self._drawing, self._hovering = Latest(self._draw), Latest(self._hover)
        with header(scene.title, []):
            kinds = {kind: KINDS[kind] for kind in scene.kinds}
            self._kind = ui.toggle(kinds, value="RSSI", on_change=self._ask).props("no-caps padding='2px 12px'")
        with ui.row().classes("w-full no-wrap items-start gap-8"):
            self._map()
            with ui.column().classes("gap-3 grow").style("max-width: 420px"):
                self._choices()
        self._ask()

    def _map(self) -> None:
        with ui.column().classes("gap-1").style("flex: none"):
            self._picture = canvas(self._plan, "map")
            self._picture.on_mouse(self._pointed)
            self._bar = ui.html("", sanitize=False).style("min-height: 34px; margin-left: 48px")

    def _choices(self) -> None:
        names = dict(enumerate(self._scene.receivers))
        self._receiver = ui.select(names, value=0, label="receiver", with_input=len(names) > 20, on_change=self._ask)
        self._receiver.props("outlined dense options-dense").classes("w-full")
        low, middle, high = self._scene.heights
        with ui.row().classes("w-full items-center no-wrap") as row:
            ui.label("height")
            self._height = ui.slider(min=low, max=high, step=0.01, value=round(middle, 2), on_change=self._ask)
            self._height.props('aria-label="height"')
            ui.label().classes("numbers").style("min-width: 4rem").bind_text_from(
                self._height, "value", lambda value: f"{value:.2f} m"
            )
        row.set_visibility(high > low)
        with ui.column().classes("w-full gap-0") as self._limits:
            self._threshold = _slider("above", -110, -30, -75, "{:.0f} dBm", self._ask)
            self._certainty = _slider("certainty", 50, 99, 90, "{:.0f} %", self._ask)
        self._sentence = ui.label().props('id="sentence"')
        ui.separator()
        self._here = (
            ui.label("Hover over the map.").classes("numbers").props('id="here"').style("white-space: pre-line")
        )
        ui.separator()
        with ui.row():
            ui.button("PNG", icon="download", on_click=self._save_picture).props("outline no-caps")
            ui.button("CSV", icon="download", on_click=self._save_table).props("outline no-caps")

    @property
    def _shown(self) -> Shown:
        return Shown(
            self._kind.value,
            self._receiver.value,
            round(self._height.value, 3),
            self._threshold.value,
            self._certainty.value / 100,
        )

    def _ask(self) -> None:
        self._drawing.ask(self._shown)

    async def _draw(self, shown: Shown) -> None:
        layer = await run.io_bound(self._scene.layer, shown)
        if layer is None:  # the server is being ended
            return
        self._limits.set_visibility(shown.kind == "coverage")
        self._receiver.set_enabled(shown.kind != "best receiver")
        self._sentence.set_text(self._scene.sentence(shown))
        bar = colour_bar(layer.colours, layer.low, layer.high, layer.label) if layer.label else ""
        self._bar.set_content(bar)
        self._picture.set_content(self._drawn(shown, layer))

    def _drawn(self, shown: Shown, layer: Layer) -> str:
        floor, maps = self._scene.floor, self._scene.maps(shown.height)
        picture = address(png(layer.values[::-1], layer.colours, layer.low, layer.high))
        parts = [self._plan.picture(address(as_png(floor.plan[0])), floor.plan[1])] if floor.plan else []
        parts.append(self._plan.picture(picture, maps.corners, 0.7 if floor.plan else 1.0))
        if shown.kind == "RSSI":
            parts.append(self._measured(shown.receiver, layer))
        every = shown.kind == "best receiver"
        for number, at in enumerate(floor.receiver):
            if np.isfinite(at).all() and (every or number == shown.receiver):
                x, y = self._plan.place(at)
                name = self._scene.receivers[number]
                if every:
                    colour = to_hex(colormaps[RECEIVER_COLOURS](number % MOST_COLOURS))
                    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{colour}" stroke="black"/>')
                else:
                    parts.append(self._plan.cross(at, CROSS))
                parts.append(text(x + 11, y + 5, name, haloed=True))
        return "".join([*parts, self._plan.axes()])

    def _measured(self, receiver: int, layer: Layer) -> str:
        """Measurements as dots in the colours of the map, with a white rim."""
        values = self._scene.floor.rssi_dbm[:, receiver]
        heard = np.isfinite(values)
        at = self._scene.floor.measured[heard]
        scaled = (values[heard] - layer.low) / (layer.high - layer.low)
        step = np.rint(np.clip(scaled, 0, 1) * DOT_COLOURS).astype(int)
        colours = [to_hex(colormaps[layer.colours](number / DOT_COLOURS)) for number in range(DOT_COLOURS + 1)]
        # a path for each colour, not one for each dot, of which there may be very many
        dots = [self._plan.dots(at[step == number], colours[number], 4) for number in np.unique(step)]
        return "".join([self._plan.dots(at, "white", 4.7), *dots])

    def _pointed(self, event: events.MouseEventArguments) -> None:
        if event.type == "pointerleave":
            self._here.set_text("Hover over the map.")
        else:
            self._hovering.ask(self._plan.position(event.image_x, event.image_y))

    async def _hover(self, at: tuple[float, float]) -> None:
        shown = self._shown
        heard = await run.io_bound(self._scene.heard, shown, *at)
        if heard is not None:
            self._here.set_text(self._told(shown, at, heard))

    def _told(self, shown: Shown, at: tuple[float, float], heard: Heard) -> str:
        names = self._scene.receivers
        lines = [
            f"at {at[0]:.2f}, {at[1]:.2f} m",
            f"{names[shown.receiver]}: {heard.middle:.1f} dBm, {LEVEL:.0%} of measurements in "
            f"[{heard.low:.1f}, {heard.high:.1f}] dBm",
        ]
        if shown.kind == "coverage":
            lines.append(f"above {shown.threshold:g} dBm with {heard.above:.0%}")
        if len(names) > 1:
            lines.append(f"best receiver: {names[heard.best[0]]}, {heard.best[1]:.1f} dBm")
        return "\n".join(lines)

    async def _save_picture(self) -> None:
        shown = self._shown
        content = await run.io_bound(self._scene.picture, shown)
        if content is not None:
            ui.download.content(content, f"{self._file(shown)}.png", "image/png")

    def _save_table(self) -> None:
        shown = self._shown
        ui.download.content(self._scene.table(shown), f"{self._file(shown)}.csv", "text/csv")

    def _file(self, shown: Shown) -> str:
        kind = shown.kind.replace(" ", "-")
        return f"{kind}-{shown.receiver + 1}-{shown.height:.2f}m"


def _slider(name: str, low: float, high: float, value: float, told: str, changed: Callable[[], None]) -> ui.slider:
    """A slider with its name on the left and its value on the right."""
    with ui.row().classes("w-full items-center no-wrap"):
        ui.label(name).style("min-width: 4.5rem")
        slider = ui.slider(min=low, max=high, step=1, value=value, on_change=changed).props(f'aria-label="{name}"')
        ui.label().classes("numbers").style("min-width: 5rem").bind_text_from(slider, "value", told.format)
    return slider


def show(scene: RssiScene) -> None:
    """Builds the page."""
    RssiPage(scene)
