"""Parts that the pages share, the page of a followed run, which shows each measurement as it is learnt, and the server."""

from __future__ import annotations

import asyncio
import errno
import json
import socket
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from ipaddress import ip_address
from typing import Any

from markupsafe import escape
from nicegui import app, background_tasks, events, run, ui
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from swiftwrf import InputError
from tasks.environment import command
from tasks.page.maps import Corners
from tasks.records import rounded
from tasks.update.record import SURPRISE, FollowedView, Version, snapshot
from tasks.view.charts import Data, Option, axis, circle, crosses, lines, paths, points
from tasks.view.locating import Located

MAX_UPLOAD_BYTES, MAX_FRAME_BYTES = 2**25, 2**12  # of an image, and of the form around it
MEDIAN, TRUTH = "#ffffff", "#66ccee"
PERIOD_S = 1.0  # between two looks at the files
LAST_ROWS = 20
FOLLOWED_COLUMNS = {
    "index": "measurement",
    "x_m": "x [m]",
    "y_m": "y [m]",
    "z_m": "z [m]",
    "error": "error",
    "running_error": "running error",
    "innovation": SURPRISE,
    "alarm": "alarm",
}
SHOW = """{
    const component = getElement(%(id)d), option = %(option)s;
    if (component) {  // else removed meanwhile
        // the component draws its own options again when it is ready, which may be later
        for (const layer of option.series)
            Object.assign(component.options.series.find(({id}) => id === layer.id), layer);
        if (option.visualMap) component.options.visualMap = {...component.options.visualMap, ...option.visualMap};
        component.chart?.setOption(option);
    }
}"""
POINTER = """(event) => {
    const box = event.currentTarget.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    const found = getElement(%d).chart?.convertFromPixel({gridIndex: 0}, at);
    if (found) emit(event.type, event.buttons, ...found);
}"""
STYLE = """
.nicegui-content { padding: 12px 20px; }
.drag { touch-action: none; cursor: crosshair; user-select: none; }
.chart image { image-rendering: pixelated; }
.numbers { font-variant-numeric: tabular-nums; }
.quiet { opacity: 0.8; font-size: 0.85rem; overflow-wrap: anywhere; }
.extrapolated image { filter: grayscale(0.9); opacity: 0.6; }
.nicegui-content, .nicegui-content > * { min-width: 0; max-width: 100%; }
:root { --lines: #e4e8ef; --paper: #ffffff; }
.body--dark { --lines: #2b3340; --paper: #121212; }
.q-btn-group { flex-wrap: wrap; max-width: 100%; }
.figure svg { width: 100%; height: auto; }
@media (max-width: 700px) { .nicegui-content { padding: 8px 10px; } }
"""


class NewestOnly:
    """Queue of one: runs one request at a time, then the newest of those that arrived in the meantime.

    A slow model therefore follows the pointer instead of trailing behind it.
    """

    def __init__(self, handle: Callable[..., Awaitable[None]]) -> None:
        self._handle, self._busy = handle, False
        self._waiting: list[tuple[Any, ...]] = []

    def submit(self, *arguments: Any) -> None:
        """Submit a request, which replaces one that has not begun."""
        self._waiting = [arguments]
        self._begin()

    def _begin(self) -> None:
        if self._waiting and not self._busy:
            self._busy = True  # now, and not when the task begins: another request may come before
            background_tasks.create(self._work(*self._waiting.pop()))

    async def _work(self, *arguments: Any) -> None:
        try:
            await self._handle(*arguments)
        finally:
            self._busy = False
            self._begin()


def header(title: str, notes: list[str]) -> ui.row:
    """Build title, notes and the switch between light and dark; return the row for further controls."""
    ui.add_css(STYLE)
    dark = ui.dark_mode(None)
    with ui.row().classes("w-full items-center"):
        ui.label(title).classes("text-h6 ellipsis").style("max-width: 100%")
        row = ui.row().classes("items-center gap-x-6 gap-y-1 grow")
        modes = ui.toggle({None: "auto", False: "light", True: "dark"}, value=None).props("dense no-caps flat")
        modes.bind_value_to(dark)
    for note in notes:
        ui.label(note).classes("quiet")
    return row


class Chart:
    """A chart whose layers change one by one, in an element with an identifier and a size as CSS."""

    def __init__(self, name: str, options: Option, style: str) -> None:
        # SVG follows the colours of the page and keeps pixels sharp
        self.element = ui.echart(options, renderer="svg").props(f'id="{name}"').classes("chart").style(style)

    def show(self, layers: dict[str, Data], bar: Option | None = None) -> None:
        """Replace the data of layers by their names, and the colour bar."""
        option: Option = {"series": [{"id": name, "data": data} for name, data in layers.items()]}
        option |= {} if bar is None else {"visualMap": bar}
        code = SHOW % {"id": self.element.id, "option": json.dumps(option, allow_nan=False)}
        self.element.client.run_javascript(code)


class PlanChart(Chart):
    """A chart of positions, to scale, that calls `pointed` with kind of the event, pressed buttons, x and y [m]."""

    def __init__(
        self,
        name: str,
        corners: Corners,
        layers: list[Option],
        max_px: tuple[int, int],
        pointed: Callable[[str, int, float, float], None],
        has_bar: bool = False,
    ) -> None:
        self.corners, (x0, x1, y0, y1) = corners, corners
        left, right, top, bottom = 50, 12, 10, 80 if has_bar else 40  # pixels around the plan
        ratio = (y1 - y0) / (x1 - x0)
        width = min(max_px[0], max_px[1] / ratio)
        style = f"width: 100%; height: calc((100cqw - {left + right}px) * {ratio:.5f} + {top + bottom}px)"
        options = {
            "animation": False,
            "grid": {"left": left, "right": right, "top": top, "bottom": bottom, "outerBoundsMode": "none"},
            "xAxis": axis(x0, x1, "x [m]"),
            "yAxis": axis(y0, y1, "y [m]", gap=34),
            "series": [layer | {"z": 2 + number} for number, layer in enumerate(layers)],
        }
        with ui.element().style(f"width: {width:.0f}px; max-width: 100%; container-type: inline-size"):
            super().__init__(name, options, style)
        self.element.classes("drag")

        def inside(event: events.GenericEventArguments) -> None:
            kind, buttons, x, y = event.args
            pointed(kind, buttons, min(max(x, x0), x1), min(max(y, y0), y1))

        for kind in ("pointerdown", "pointermove", "pointerup", "pointerleave"):
            self.element.on(kind, inside, js_handler=POINTER % self.element.id)


def legend(entries: Iterable[tuple[str, str, str]]) -> str:
    """Return a legend of entries: colour, symbol and text."""
    parts = [f'<span style="color: {colour}">{symbol}</span> {escape(text)}' for colour, symbol, text in entries]
    return "".join(f'<div style="display: inline-block; margin-right: 1em">{part}</div>' for part in parts)


def located_layers() -> list[Option]:
    """Return the layers of a located observation."""
    return [lines("regions", MEDIAN, 2), crosses("median", MEDIAN), crosses("truth", TRUTH)]


def located_data(found: Located | None) -> dict[str, Data]:
    """Return credible regions, median and measured position of a located observation, nothing for None."""
    if found is None:
        return {"regions": [], "median": [], "truth": []}
    regions = paths(circle(found.median, radius) for radius in found.radius)
    return {"regions": regions, "median": points(found.median[None]), "truth": points(found.truth[None])}


def slider(
    name: str, low: float, high: float, value: float, unit: str, changed: Callable[..., Any], step: float = 1
) -> ui.slider:
    """Build a slider with its name on the left and its value with a unit on the right."""
    digits = 0 if step == 1 else 2
    with ui.row().classes("w-full items-center no-wrap"):
        ui.label(name).style("min-width: 4.5rem")
        made = ui.slider(min=low, max=high, step=step, value=value, on_change=changed).props(f'aria-label="{name}"')
        shown = ui.label().classes("numbers").style("min-width: 5rem")
        shown.bind_text_from(made, "value", lambda value: f"{value or 0:.{digits}f} {unit}")
    return made


class FollowedPage:
    """The page for one visitor."""

    def __init__(self, view: FollowedView) -> None:
        self._view, self._shown, self._requests = view, Version(), NewestOnly(self._show)
        header(view.title, [])
        self._sentences = ui.label().classes("numbers").props('id="sentence"').style("white-space: pre-line")
        self._figures = {}
        with ui.row().classes("w-full items-start gap-8"):
            for name in ("error", "changes"):
                box = ui.html("", sanitize=False).classes("figure").props(f'id="{name}"')
                self._figures[name] = box.style("width: 620px; max-width: 100%")
        columns = [
            {"name": key, "label": label, "field": key, "align": "left"} for key, label in FOLLOWED_COLUMNS.items()
        ]
        self._table = ui.table(rows=[], columns=columns, row_key="index", title="Last measurements")
        self._table.props('dense flat id="rows"').classes("w-full")
        ui.label(
            f"Maps and spectra of the newest model: {command('view', str(view.folder / 'model.safetensors'))}"
        ).classes("quiet")
        ui.timer(PERIOD_S, self._look)

    def _look(self) -> None:
        if self._view.version != self._shown:
            self._requests.submit()

    async def _show(self) -> None:
        version = self._view.version
        try:
            found = await run.io_bound(snapshot, self._view, version)
        except InputError as error:
            self._sentences.set_text(str(error))
            return
        if found is None:  # the server is being ended
            return
        (record, svg), self._shown = found, version
        self._sentences.set_text("\n".join(record.sentences()) if record.rows else "no measurement yet")
        for name, box in self._figures.items():
            box.set_content(svg.get(name, ""))
        self._table.rows = [
            {key: row[key] if isinstance(row[key], int | str) else f"{row[key]:.4g}" for key in FOLLOWED_COLUMNS}
            for row in rounded(record.rows[: -LAST_ROWS - 1 : -1])
        ]
        self._table.update()


def limited(app: ASGIApp) -> ASGIApp:
    """Return middleware that ends a request whose body exceeds that of the largest image."""

    async def handle(scope: Scope, receive: Receive, send: Send) -> None:
        left = MAX_UPLOAD_BYTES + MAX_FRAME_BYTES

        async def part() -> Message:
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:
                raise HTTPException(413, f"at most {MAX_UPLOAD_BYTES} bytes are taken")
            return message

        await app(scope, part if scope["type"] == "http" else receive, send)

    return handle


def local_names(host: str) -> list[str]:
    """Return the names under which a page of this machine alone may be asked for, none if others can reach the address.

    Example:
        >>> local_names("127.0.0.2")
        ['127.0.0.2', 'localhost']
        >>> local_names("0.0.0.0")
        []
    """
    address = str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
    if not ip_address(address).is_loopback:
        return []
    return list(dict.fromkeys((f"[{address}]" if ":" in address else address, host, "localhost")))


def free_port(host: str, port: int) -> int:
    """Return the port if it is free, or any free port for 0.

    Raises:
        InputError: The port is in use, or this process may not listen there.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port closed just now is free
            listener.bind(address)
            found: int = listener.getsockname()[1]
            return found
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise InputError(f"port {port} of {host} is in use; choose another with --port, or 0 for any") from None
        raise InputError(f"cannot listen on {host}, port {port} ({error}); choose another --host or --port") from None


def serve(title: str, build: Callable[[], object], host: str, port: int, show: bool = False) -> None:
    """Serve one page, built for each visitor, and nothing else of this machine, until the process is interrupted."""

    async def announce() -> None:
        """Print the address once the server answers."""
        while True:
            with suppress(OSError):
                _, writer = await asyncio.open_connection(host, port)
                writer.close()
                break
            await asyncio.sleep(0.05)
        name = f"[{host}]" if ":" in host else host
        print(f"page: http://{name}:{port} (Ctrl-C ends it)", flush=True)

    ui.page("/")(lambda: (build(), None)[1])  # the page must return nothing
    if names := local_names(host):  # pages of other sites must not reach this one under a name that they own
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=names)
    app.add_middleware(limited)
    app.on_startup(announce)
    # dark=None follows the browser's setting
    ui.run(host=host, port=port, title=title, dark=None, show=show, reload=False, show_welcome_message=False)
