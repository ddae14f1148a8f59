"""Parts that both pages share, and the server of one page."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from ipaddress import ip_address
from typing import Any

from matplotlib import colormaps
from matplotlib.colors import to_hex
from nicegui import app, background_tasks, ui
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from swiftwrf import InputError
from tasks.view.drawing import PlanProjection, ring, text
from tasks.view.locating import Located

MAX_UPLOAD_BYTES, MAX_FRAME_BYTES = 2**25, 2**12  # of an image, and of the form around it
MEDIAN, TRUTH = "#ffffff", "#66ccee"
STYLE = """
.nicegui-content { padding: 12px 20px; }
.outside svg { overflow: visible; }
.drag { touch-action: none; cursor: crosshair; user-select: none; }
.pixels img { image-rendering: pixelated; }
.numbers { font-variant-numeric: tabular-nums; }
.quiet { opacity: 0.8; font-size: 0.85rem; overflow-wrap: anywhere; }
.extrapolated img { filter: grayscale(0.9); opacity: 0.6; }
.nicegui-content, .nicegui-content > * { min-width: 0; max-width: 100%; }
:root { --lines: #e4e8ef; --paper: #ffffff; }
.body--dark { --lines: #2b3340; --paper: #121212; }
.figure svg { width: 100%; height: auto; }
@media (max-width: 700px) { .nicegui-content { padding: 8px 10px; } }
"""


class NewestOnly:
    """Queue of one: runs one request at a time, then the newest of those that arrived in the meantime.

    A slow model therefore follows the pointer instead of trailing behind it.

    Args:
        handle: Coroutine function of a request's arguments.
    """

    def __init__(self, handle: Callable[..., Awaitable[None]]) -> None:
        self._handle, self._busy = handle, False
        self._waiting: list[tuple[Any, ...]] = []

    def submit(self, *arguments: Any) -> None:
        """Submit a request, which replaces one that has not begun."""
        self._waiting = [arguments]
        if not self._busy:
            background_tasks.create(self._work())

    async def _work(self) -> None:
        self._busy = True
        try:
            while self._waiting:
                await self._handle(*self._waiting.pop())
        finally:
            self._busy = False


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


def plan_picture(plan: PlanProjection, name: str) -> ui.interactive_image:
    """Build a picture of the size of a plan that reports the position of the pointer."""
    events = ["pointerdown", "pointermove", "pointerup", "pointerleave"]
    picture = ui.interactive_image(size=plan.size, events=events, sanitize=False)
    picture.style(f"width: {plan.size[0]}px; max-width: calc(100% - 58px); margin: 24px 10px 34px 48px")
    return picture.classes("outside drag").props(f'id="{name}"')


def located_marks(plan: PlanProjection, found: Located) -> str:
    """Return median, credible radii and measured position of a located observation."""
    x, y = plan.pixel(found.median)
    rings = [ring(x, y, radius * plan.scale, MEDIAN, 6) for radius in found.radius]
    return "".join([*rings, plan.cross(found.median, MEDIAN), plan.cross(found.truth, TRUTH)])


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


def colour_bar(colours: str, low: float, high: float, label: str) -> str:
    """Return a legend of a colour map as SVG."""
    stops = "".join(f'<stop offset="{i / 8:g}" stop-color="{to_hex(colormaps[colours](i / 8))}"/>' for i in range(9))
    ends = ((0, "start", low), (130, "middle", (low + high) / 2), (260, "end", high))
    numbers = "".join(text(x, 30, f"{value:.3g}", anchor) for x, anchor, value in ends)
    return (
        '<svg viewBox="0 0 520 34" style="width: 520px; max-width: 100%">'
        f'<defs><linearGradient id="bar-{colours}">{stops}</linearGradient></defs>'
        f'<rect width="260" height="14" fill="url(#bar-{colours})"/>{numbers}{text(272, 12, label, size=13)}</svg>'
    )


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
    """Serve one page and nothing else of this machine, until the process is interrupted.

    Args:
        title: Title of the page.
        build: Builds the page for one visitor.
        host: Address to listen on.
        port: Port to listen on.
        show: Whether the browser opens the page.
    """

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
