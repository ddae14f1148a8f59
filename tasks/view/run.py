"""A page to explore a fitted model in the browser, served on this machine."""

from __future__ import annotations

from pathlib import Path

from swiftwrf import InputError
from tasks.view.options import ViewConfig
from tasks.view.sources import open_source
from tasks.view.spectra import SpectraView


def run(config: ViewConfig) -> None:
    """Serve the page until the process is interrupted.

    Raises:
        InputError: The source holds no model, the port is in use, or the optional extra is not installed.
    """
    try:
        from tasks.view.page import free_port, serve
        from tasks.view.rssi_page import RssiPage
        from tasks.view.spectra_page import SpectraPage
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise InputError("tasks.view needs the optional extra: pip install 'swiftwrf-tasks[view]'") from None
    port = free_port(config.host, config.port)
    view = open_source(Path(config.source))
    build = (lambda: SpectraPage(view)) if isinstance(view, SpectraView) else (lambda: RssiPage(view))
    serve(view.title, build, config.host, port, config.open)
