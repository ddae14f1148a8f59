"""Serves one page on one address, and nothing else of this machine."""

from __future__ import annotations

import asyncio
import errno
import socket
from contextlib import suppress

from nicegui import app, ui
from starlette.middleware.trustedhost import TrustedHostMiddleware

from swiftwrf import InputError
from tasks.view import rssi_page, spectra_page
from tasks.view.rssi import RssiScene
from tasks.view.spectra import SpectraScene

HERE = ("127.0.0.1", "localhost")


def free_port(host: str, port: int) -> int:
    """The port, or any free one for 0.

    Raises:
        InputError: it is in use, or one may not listen there.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that was closed just now is free
            listener.bind(address)
            found: int = listener.getsockname()[1]
            return found
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise InputError(f"port {port} of {host} is in use; choose another with --port, or 0 for any") from None
        raise InputError(f"cannot listen on {host}, port {port} ({error}); choose another --host or --port") from None


def serve(scene: SpectraScene | RssiScene, host: str, port: int) -> None:
    """Serves the page of what was opened, until it is interrupted."""

    @ui.page("/")
    def page() -> None:
        if isinstance(scene, SpectraScene):
            spectra_page.show(scene)
        else:
            rssi_page.show(scene)

    async def tell() -> None:
        """Says where the page is, once somebody answers there."""
        while True:
            with suppress(OSError):
                _, writer = await asyncio.open_connection(host, port)
                writer.close()
                break
            await asyncio.sleep(0.05)
        name = f"[{host}]" if ":" in host else host
        print(f"page: http://{name}:{port} (Ctrl-C ends it)", flush=True)

    if host in HERE:  # pages of others must not reach this one under a name that they own
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(HERE))
    app.on_startup(tell)
    ui.run(
        host=host,
        port=port,
        title=scene.title,
        dark=None,  # as the browser is set
        show=False,
        reload=False,
        show_welcome_message=False,
    )
